"""Queries: retrieval, verification and answers."""
