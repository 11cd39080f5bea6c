"""Two frames to a transform, and whether to believe it."""
