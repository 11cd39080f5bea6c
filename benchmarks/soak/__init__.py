"""Soak tests: robots use a disturbed service, and lost data is counted. `make soak|fleet|siege`."""
