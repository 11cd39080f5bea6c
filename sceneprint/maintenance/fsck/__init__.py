"""The database, blobs and indexes checked against each other, and repaired."""
