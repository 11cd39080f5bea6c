"""What jobs compute from maps: coverage, associations and differences of sessions, surfaces."""
