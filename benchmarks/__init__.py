"""Benchmarks of speed and cost beside references that run in the same process."""
