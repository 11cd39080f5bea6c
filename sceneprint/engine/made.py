"""Something that can be made of a frame, and how it is told.

patches --level_of--> JSON;  signature --npy_of--> NPY file;  upload --upload_type--> media type
"""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from sceneprint.schemas.outputs import PatchLevel
from sceneprint.types import Patches

T = TypeVar("T")

PLY, PNG, NPY, BYTES, JSON = (
    "application/ply", "image/png", "application/x-npy", "application/octet-stream",
    "application/json",
)  # fmt: skip
#: How uploads begin, their media types, and what their names end with.
_UPLOADS = (
    (b"\x89PNG", PNG, "png"), (b"\x93NUMPY", NPY, "npy"), (b"ply", PLY, "ply"),
    (b"# .PCD", BYTES, "pcd"), (b"VERSION", BYTES, "pcd"), (b"LASF", BYTES, "las"),
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Output(Generic[T]):
    """Something that can be made of a frame.

    Parameters
    ----------
    tag : the same as long as what is made is the same, and another otherwise
    make : makes it; takes some 100 ms at most
    blob : that it is, where it is not made but lies in the store
    """

    tag: str
    make: Callable[[], T]
    blob: str | None = None


def upload_type(data: bytes) -> tuple[str, str]:
    """Media type of an upload, and what its name ends with."""
    for magic, media_type, suffix in _UPLOADS:
        if data.startswith(magic):
            return media_type, suffix
    return BYTES, "bin"


def level_of(patches: Patches) -> PatchLevel:
    """Patches as JSON tells them."""
    return PatchLevel(
        mean=[(x, y, z) for x, y, z in patches.means.round(4).tolist()],
        normal=[(x, y, z) for x, y, z in patches.normals.round(4).tolist()],
        area_m2=patches.areas.round(5).tolist(),
        size=patches.sizes.tolist(),
    )


def npy_of(vector: bytes) -> bytes:
    """Bytes as an NPY file of uint8."""
    buffer = io.BytesIO()
    np.save(buffer, np.frombuffer(vector, np.uint8), allow_pickle=False)
    return buffer.getvalue()
