"""Decision whether a transform is right: acceptance, ambiguity, verification in the map."""
