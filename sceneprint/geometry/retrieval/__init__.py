"""Rank signatures, and select diverse matches."""
