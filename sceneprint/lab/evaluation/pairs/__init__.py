"""Pairs of frames, drawn by overlap and judged."""
