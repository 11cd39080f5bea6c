"""PostgreSQL: connections and locks."""
