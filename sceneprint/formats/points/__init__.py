"""Readers of untrusted point clouds: PLY, PCD, KITTI, NPY, LAS, LAZ and E57.

bytes  --decode_cloud-->  Cloud
"""

from sceneprint.formats.points.cloud import (
    Scan,
    decode_cloud,
    decode_scan,
)
from sceneprint_client.formats import format_of
from sceneprint_client.sidecars import UNSAID, Unsaid

__all__ = [
    "UNSAID",
    "Scan",
    "Unsaid",
    "decode_cloud",
    "decode_scan",
    "format_of",
]
