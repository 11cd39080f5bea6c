"""Uploads and imports of frames."""
