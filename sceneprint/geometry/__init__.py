"""Compute with arrays: pure functions, a file per section of the paper."""
