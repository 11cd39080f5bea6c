"""Ranking of signatures and selection of diverse matches."""
