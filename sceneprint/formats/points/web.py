"""Points as bytes that a web page draws as they are: 12 of them each.

points, normals, patches, residuals  --encode_points-->  bytes

Little-endian. A header of 48 bytes:

    0  4 x u8   "SPPT"
    4  u16      version, 1
    6  u16      flags: 1 normals, 2 patches, 4 residuals are told
    8  u32      points that follow
    12 u32      bytes of a point, 12
    16 3 x f32  origin, metres
    28 3 x f32  extent, metres
    40 u32      points that there are, before thinning
    44 f32      metres that a residual of 250 stands for near by, as the model's validation allows
                (with distance it grows); 0 where none is told

Then, of each point:

    0  3 x u16  position: origin + value / 65535 * extent
    6  u16      index of its validation patch; 65535 for none
    8  3 x i8   normal, times 127
    11 u8       residual, from the surface that another frame saw: 1 to 250; 253 where the other
                did not look, or beside or behind what it saw; 254 where it saw through; 255 where
                nothing was compared
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sceneprint.types import Bytes, Floats, Floats32, Ints32
from sceneprint_client.api.results import MOST_DRAWN
from sceneprint_client.surface_encoding import (
    HEADER,
    MAGIC,
    NO_PATCH,
    NORMALS,
    PATCHES,
    POINT,
    RESIDUALS,
    VERSION,
)

MEDIA_TYPE = "application/vnd.sceneprint.points"
NOT_COMPARED = 255
#: Points that are told by default, and at most.
LIMIT, MOST = MOST_DRAWN, 100_000

Indices = NDArray[np.intp]


def encode_points(
    points: Floats | Floats32,
    normals: Floats | Floats32 | None = None,
    patches: Ints32 | None = None,
    residuals: Bytes | None = None,
    *,
    total: int | None = None,
    scale: float = 0.0,
) -> bytes:
    """Points as the module's text says; the same bytes for the same arrays.

    Parameters
    ----------
    points : (N, 3) metres
    normals : (N, 3) unit length
    patches : (N,) indices; -1, or NO_PATCH or more, for none
    residuals : (N,) see above
    total : points before thinning; default: N
    scale : metres of a residual of 250
    """
    n = len(points)
    at = np.asarray(points, np.float64)
    low, high = (at.min(axis=0), at.max(axis=0)) if n else (np.zeros(3), np.zeros(3))
    origin = low.astype(np.float32)
    extent = (high - origin).clip(0).astype(np.float32)
    unit = np.where(extent > 0, extent, 1.0).astype(np.float64)
    rows = np.empty(n, POINT)
    rows["position"] = np.rint((at - origin) / unit * 65535.0).clip(0, 65535)
    rows["patch"] = NO_PATCH
    if patches is not None:
        rows["patch"] = np.where((patches >= 0) & (patches < NO_PATCH), patches, NO_PATCH)
    rows["normal"] = 0 if normals is None else np.rint(normals * 127.0).clip(-127, 127)
    rows["residual"] = NOT_COMPARED if residuals is None else residuals
    told = ((NORMALS, normals), (PATCHES, patches), (RESIDUALS, residuals))
    flags = sum(flag for flag, values in told if values is not None)
    head = HEADER.pack(
        MAGIC, VERSION, flags, n, POINT.itemsize, *origin.tolist(), *extent.tolist(),
        n if total is None else total, scale,
    )  # fmt: skip
    return head + rows.tobytes()


def thinned(count: int, limit: int) -> Indices:
    """Indices of at most `limit` of so many points, rising: always the same, and in no pattern
    that rows of an image could show.
    """
    if count <= limit:
        return np.arange(count)
    keys = np.arange(1, count + 1, dtype=np.uint64)  # SplitMix64
    keys *= np.uint64(0x9E3779B97F4A7C15)
    keys = (keys ^ (keys >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    keys = (keys ^ (keys >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return np.sort(np.argsort(keys, kind="stable")[:limit])
