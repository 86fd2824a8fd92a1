"""Devices over the detector's elements, solved from their physics: etalon and micromirror."""
