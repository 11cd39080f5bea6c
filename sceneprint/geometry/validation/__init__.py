"""Decide whether a transform is right: acceptance, ambiguity, validation in the map."""
