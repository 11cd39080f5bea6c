"""What a worker does between jobs: publish, purge, repair."""
