"""Frames in tar and zip files."""
