"""Files of points in: PLY, PCD, KITTI, NPY, LAS and LAZ, read without trusting them.

bytes  --decode_cloud-->  Cloud
"""

from sceneprint.scans.formats import SUFFIXES, CloudFormat, format_of
from sceneprint.scans.raw import MAXIMUM_BYTES, Position
from sceneprint.scans.reading import UNSAID, Scan, Unsaid, decode_cloud, decode_scan

__all__ = [
    "MAXIMUM_BYTES",
    "SUFFIXES",
    "UNSAID",
    "CloudFormat",
    "Position",
    "Scan",
    "Unsaid",
    "decode_cloud",
    "decode_scan",
    "format_of",
]
