"""Tasks of workers between jobs: publication of indexes, purges and repairs."""
