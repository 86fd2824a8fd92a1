"""Shading: reflection, scattering and path light of what rays met."""
