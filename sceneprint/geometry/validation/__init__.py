"""Decisions on transforms: acceptance, ambiguity, and verification in the map."""
