"""Content-addressed bytes in a folder or an object store."""
