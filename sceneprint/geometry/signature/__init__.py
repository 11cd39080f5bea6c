"""Convert surfaces to patches, pairs of patches and signatures."""
