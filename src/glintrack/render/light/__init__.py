"""Light of sky and surroundings: sky, probes, and the surfaces that they light."""
