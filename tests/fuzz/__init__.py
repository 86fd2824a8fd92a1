"""Damaged, hostile and nonsensical files for every reader."""
