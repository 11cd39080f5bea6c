"""Whether to believe a transform: acceptance, ambiguity, validation in the map."""
