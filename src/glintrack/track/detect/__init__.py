"""Detectors, one file each, and what they take and give (``detector``); by name in `detector.DETECTORS`."""
