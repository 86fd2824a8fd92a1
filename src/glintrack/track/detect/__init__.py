"""Detection of what moves in a frame."""
