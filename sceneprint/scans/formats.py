"""Which format a file of points has: by its first bytes, or by its name.

bytes  --format_of-->  CloudFormat
"""

from __future__ import annotations

from typing import Literal

from sceneprint.errors import UnreadableCloud
from sceneprint.scans import las, npy_headers, pcd, ply

CloudFormat = Literal["ply", "pcd", "kitti", "npy", "las"]

#: Suffixes of file names, in lower case. A .npy may be a depth image as well: its shape tells.
SUFFIXES: dict[str, CloudFormat] = {
    ".ply": "ply", ".pcd": "pcd", ".bin": "kitti", ".npy": "npy", ".las": "las", ".laz": "las",
}  # fmt: skip


def format_of(data: bytes) -> CloudFormat | None:
    """What the first bytes of a file tell, or None; a KITTI scan has nothing that tells it.

    Parameters
    ----------
    data : the file, or its first 10,016 bytes
    """
    if data.startswith(npy_headers.SIGNATURE):
        try:
            header = npy_headers.npy_header(data, UnreadableCloud, "", "")
        except UnreadableCloud:
            return None
        return "npy" if header.shape[1] in (3, 4) else None
    if data[: len(ply.SIGNATURE) + 1] in (b"ply\n", b"ply\r", b"ply "):
        return "ply"
    if data.startswith(las.SIGNATURE):
        return "las"
    return "pcd" if pcd.is_pcd(data) else None
