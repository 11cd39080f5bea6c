"""A store copied to one archive while it works, and restored from it."""
