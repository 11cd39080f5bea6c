"""Readers for files of a whole map, such as the cloud of a SLAM system or the mesh of a scanner.

bytes, name, options  --read_surface-->  ReadSurface: points, triangles, units, up, offset
"""

from sceneprint.formats.surface_file.reading import (
    ReadSurface,
    SurfaceOptions,
    read_surface,
    surface_format,
)

__all__ = ["ReadSurface", "SurfaceOptions", "read_surface", "surface_format"]
