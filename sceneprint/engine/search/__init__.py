"""A query from its body to its answer."""
