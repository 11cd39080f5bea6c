"""Decisions about transforms: acceptance, ambiguity, verification in the map."""
