"""A fault at every call of an operation that changes files or the database, one after another."""
