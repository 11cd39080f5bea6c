"""Consistency checks and repairs of the database, blobs and indexes."""
