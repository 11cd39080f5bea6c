"""Depth images: PNG and NPY."""
