"""Readers and writers of external data: images, clouds, archives, datasets."""
