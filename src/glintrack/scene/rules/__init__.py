"""Rules that fill in what data do not have."""
