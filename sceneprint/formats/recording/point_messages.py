"""Point clouds of ROS, as the bytes of a frame.

PointCloud2  --cloud_file-->  bytes of an NPY file (N, 3)
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sceneprint.errors import UnreadableCloud
from sceneprint.formats.recording.image_messages import npy_file
from sceneprint.types import Floats32

#: Types of fields, by the number that sensor_msgs/PointField has for them.
_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
#: Most points of a message.
MOST_POINTS = 20_000_000


def cloud_file(message: Any) -> bytes:
    """Return the bytes of an NPY file with the points of a message.

    Points that are not finite, or exactly at the sensor as some drivers write what they missed, are
    left out.

    Parameters
    ----------
    message : sensor_msgs PointCloud2, of any fields with x, y and z, organised or not

    Raises
    ------
    UnreadableCloud : it has no x, y and z, or its sizes contradict each other.
    """
    points = cloud_points(message)
    present = np.isfinite(points).all(axis=1) & points.any(axis=1)
    return npy_file(points[present].astype("<f4"))


def cloud_points(message: Any) -> Floats32:
    """Points (N, 3) float32 of a PointCloud2, missing ones too; raises as `cloud_file`."""
    width, height = int(message.width), int(message.height)
    step, row = int(message.point_step), int(message.row_step)
    data = np.frombuffer(memoryview(message.data), np.uint8)
    if width * height > MOST_POINTS:
        raise UnreadableCloud(
            f"The cloud announces {width} x {height} points; at most {MOST_POINTS} are read. "
            "Thin it out."
        )
    if height == 1 or row == 0:  # some drivers leave it out
        row = width * step
    if step < 1 or row < width * step or len(data) < row * height:
        raise UnreadableCloud(
            f"The cloud has {len(data)} bytes, and {height} rows of {width} points of {step} bytes "
            "are announced. Record it again."
        )
    kind = _point_type(message, step)
    rows = data[: row * height].reshape(height, row)[:, : width * step]
    packed: NDArray[Any] = np.ascontiguousarray(rows).reshape(-1).view(kind)
    points = np.empty((len(packed), 3), np.float32)
    with np.errstate(all="ignore"):  # what overflows is no number, and so missing
        for axis, name in enumerate("xyz"):
            points[:, axis] = packed[name]
    return points


def _point_type(message: Any, step: int) -> np.dtype[Any]:
    """x, y and z of a point of so many bytes."""
    order = ">" if message.is_bigendian else "<"
    found = {}
    for field in message.fields:
        kind = _TYPES.get(int(field.datatype))
        if field.name in ("x", "y", "z") and kind is not None and int(field.count) in (0, 1):
            found[str(field.name)] = (order + kind, int(field.offset))
    if len(found) != 3:
        names = ", ".join(str(field.name) for field in message.fields[:20])
        raise UnreadableCloud(
            f"The cloud has the fields {names[:120] or 'none'}, and x, y and z are needed. "
            "Name the topic of the points."
        )
    if any(offset + np.dtype(kind).itemsize > step for kind, offset in found.values()):
        raise UnreadableCloud(
            f"The fields of the cloud do not fit into its points of {step} bytes. Record it again."
        )
    return np.dtype(
        {
            "names": list(found),
            "formats": [kind for kind, _ in found.values()],
            "offsets": [offset for _, offset in found.values()],
            "itemsize": step,
        }
    )
