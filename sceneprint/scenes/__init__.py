"""Answers and maps as scenes that Rerun and Foxglove draw."""
