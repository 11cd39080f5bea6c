"""Files and bytes that come from outside: images, clouds, archives, datasets."""
