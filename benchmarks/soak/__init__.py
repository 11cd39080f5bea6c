"""Robots that use a disturbed service, with a count of lost data: `make soak|fleet|siege`."""
