"""Sources of cities and of their traffic."""
