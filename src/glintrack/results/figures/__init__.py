"""Figures of frames, tracks, skies, sensors and devices."""
