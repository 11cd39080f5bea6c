"""Conversion of surfaces to patches, patch pairs and signatures."""
