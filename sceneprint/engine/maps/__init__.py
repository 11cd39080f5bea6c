"""Maps, their frames and their model."""
