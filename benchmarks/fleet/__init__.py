"""`make fleet`: real PostgreSQL, service processes and workers, and what breaks among them."""
