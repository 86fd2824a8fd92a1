"""Objects of a city: buildings, trees, ground and their meshes, from plan data."""
