"""Storage of content-addressed bytes in a folder or an object store."""
