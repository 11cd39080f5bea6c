"""Maintenance of a data folder: checks and repairs."""
