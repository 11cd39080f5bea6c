"""Answers and maps as scenes in MCAP files, which Foxglove and Rerun draw."""
