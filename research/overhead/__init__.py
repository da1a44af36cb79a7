"""The cost of the context plane by fleet size."""
