"""Products that jobs compute: coverage, associations, session differences, reconstructions."""
