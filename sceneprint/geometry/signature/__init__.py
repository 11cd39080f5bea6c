"""Conversion of surfaces to patches, pairs of patches and signatures."""
