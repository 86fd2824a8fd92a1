"""Queries: which spectra the tracker asks for."""
