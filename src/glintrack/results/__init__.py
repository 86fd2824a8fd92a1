"""Results of a flight: collect them, write them, read them."""
