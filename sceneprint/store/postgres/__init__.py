"""What only a PostgreSQL server has: locks, notifications, replicas, vectors."""
