"""Answers and maps as scenes that Foxglove and Rerun draw."""
