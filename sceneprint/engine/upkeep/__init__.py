"""Upkeep: tasks of workers between jobs, such as publishing indexes, purges and repairs."""
