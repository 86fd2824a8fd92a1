"""Identity: what spectra and polarization say of who a vehicle is."""
