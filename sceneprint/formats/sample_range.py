"""The depth range of a frame. Uploads report it, so that users notice wrong units.

Frame | Cloud  --sample_range-->  SampleRange
"""

from __future__ import annotations

import numpy as np

from sceneprint.types import AnyFrame, Cloud, Floats32
from sceneprint_client.api.frames import SampleRange

#: Approximate number of samples that estimate the percentiles of a larger frame in a millisecond.
_SAMPLES = 20_000


def sample_range(frame: AnyFrame) -> SampleRange:
    """Return estimated percentiles of a frame's depths or distances, and its sample count."""
    if isinstance(frame, Cloud):
        points = frame.points[:: max(1, len(frame.points) // _SAMPLES)]
        return _range_of(np.linalg.norm(points, axis=1), len(frame.points), None)
    depth = frame.depth
    step = max(1, int((depth.size / _SAMPLES) ** 0.5))
    subset, count = depth[::step, ::step], int(np.count_nonzero(depth))
    valid = subset[subset > 0]
    return _range_of(valid if len(valid) else depth[depth > 0], count, count / depth.size)


def _range_of(distances: Floats32, count: int, valid: float | None) -> SampleRange:
    near, median, far = np.percentile(distances, (5, 50, 95)).round(4).tolist()
    share = None if valid is None else round(valid, 4)
    return SampleRange(near=near, median=median, far=far, count=count, valid=share)
