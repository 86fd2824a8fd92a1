"""Lens prescriptions (extra ``optics``)."""
