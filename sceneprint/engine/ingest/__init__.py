"""Uploads: decoded, checked for duplicates, stored and queued."""
