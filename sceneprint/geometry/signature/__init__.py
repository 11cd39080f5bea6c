"""Surfaces to patches, pairs of patches and signatures."""
