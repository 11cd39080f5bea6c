"""Points as the service packs them for viewers: docs/reference.md, Points.

bytes  --decode_points-->  SurfacePoints
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneprint_client.errors import Refused

MAGIC, VERSION = b"SPPT", 1
HEADER = struct.Struct("<4sHHII3f3fIf")
POINT = np.dtype(
    [("position", "<u2", 3), ("patch", "<u2"), ("normal", "i1", 3), ("residual", "u1")]
)
#: Flags of the header: what is told of each point.
NORMALS, PATCHES, RESIDUALS = 1, 2, 4
#: Index of the validation patch of a point that lies on none.
NO_PATCH = 65535
#: Largest coordinate of a point; the shares of the box that they lie in.
_STEPS = 65535.0


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """The surface that a frame saw.

    Parameters
    ----------
    points : (N, 3) metres, in the coordinates that were asked for
    normals : (N, 3) to 1/127; None where not told
    patches : (N,) index of the validation patch, -1 for none; None where not told
    residuals : (N,) bytes, see docs/reference.md; None where not told
    tolerance_m : metres that a residual of 250 stands for; 0 where none is told
    total : points that there are, of which these were chosen
    """

    points: NDArray[np.float64]
    normals: NDArray[np.float64] | None
    patches: NDArray[np.int32] | None
    residuals: NDArray[np.uint8] | None
    tolerance_m: float
    total: int


def decode_points(data: bytes) -> SurfacePoints:
    """The points of an answer of type `application/vnd.sceneprint.points`.

    Raises
    ------
    Refused : the bytes are not of this version, or their number is not what they say.
    """
    if len(data) < HEADER.size or data[:4] != MAGIC:
        raise _refusal("they do not begin as points do")
    _, version, flags, count, stride, *box, total, tolerance = HEADER.unpack_from(data)
    if (version, stride) != (VERSION, POINT.itemsize):
        raise _refusal(f"they are of version {version} with {stride} bytes a point")
    if len(data) != HEADER.size + count * POINT.itemsize:
        raise _refusal(f"{len(data)} bytes are not those of {count} points")
    rows = np.frombuffer(data, POINT, count, HEADER.size)
    origin, extent = np.array(box[:3]), np.array(box[3:])
    patches = rows["patch"].astype(np.int32)
    return SurfacePoints(
        points=origin + rows["position"] / _STEPS * extent,
        normals=rows["normal"] / 127.0 if flags & NORMALS else None,
        patches=np.where(patches == NO_PATCH, -1, patches) if flags & PATCHES else None,
        residuals=rows["residual"].copy() if flags & RESIDUALS else None,
        tolerance_m=tolerance,
        total=total,
    )


def _refusal(why: str) -> Refused:
    return Refused(
        f"The service sent bytes that are not points: {why}. Install a client of the service's "
        "version: `sceneprint doctor` tells it.",
        200,
        {},
    )
