"""What only a PostgreSQL server has: locks, replicas."""
