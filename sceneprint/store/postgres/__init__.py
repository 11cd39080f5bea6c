"""Connections and locks of PostgreSQL servers."""
