"""Robots that use a disturbed service, and a count of all that it lost: `make soak|fleet|siege`."""
