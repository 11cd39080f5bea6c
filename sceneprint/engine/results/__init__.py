"""The query log, and views of stored answers."""
