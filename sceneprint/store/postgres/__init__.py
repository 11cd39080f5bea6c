"""What only a PostgreSQL server has: connections and locks."""
