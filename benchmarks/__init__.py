"""Benchmarks of speed and cost, with references measured in the same process."""
