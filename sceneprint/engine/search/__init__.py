"""Queries: retrieval, validation, and answers."""
