"""Messages of ROS as the bytes of a frame.

Image | CompressedImage  --depth_file-->  bytes of a PNG or NPY file
PointCloud2  --cloud_file-->  bytes of an NPY file (N, 3)
"""

from __future__ import annotations

import io
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sceneprint.formats.image.depth_file import decode_png, encode_png, inverse_depth
from sceneprint_client.ros_messages import cloud_points, compressed_depth, depth_samples


def depth_file(message: Any, *, compressed: bool) -> bytes:
    """Return the bytes of a PNG or NPY file with the samples of a depth image.

    Parameters
    ----------
    message : sensor_msgs Image, or CompressedImage of compressed_depth_image_transport
    compressed : which of them

    Returns
    -------
    data : a 16-bit PNG of millimetres, or an NPY array of float32 metres

    Raises
    ------
    UnreadableFrame : the message is of another encoding, or its sizes contradict each other.
    """
    if compressed:
        found = compressed_depth(message)
        if found.inverse is None:
            return found.png
        return _npy_file(inverse_depth(decode_png(found.png), *found.inverse))
    samples = depth_samples(message)
    return _npy_file(samples) if samples.dtype.kind == "f" else encode_png(samples)


def cloud_file(message: Any) -> bytes:
    """Return the bytes of an NPY file with the points of a PointCloud2; see `cloud_points`."""
    return _npy_file(cloud_points(message))


def _npy_file(samples: NDArray[Any]) -> bytes:
    """Bytes of an NPY file."""
    file = io.BytesIO()
    np.save(file, np.ascontiguousarray(samples))
    return file.getvalue()
