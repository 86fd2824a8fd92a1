"""A case: its design, the scenario built from it, and whether it is feasible."""
