"""Products of jobs: coverage, associations and differences of sessions, and reconstructions."""
