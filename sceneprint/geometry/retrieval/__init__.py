"""Signatures to rankings and diverse selections."""
