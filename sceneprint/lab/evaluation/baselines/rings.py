"""A ring descriptor of a scan, as Scan Context: how high the world is about the sensor.

points (N, 3)  --ring_descriptor-->  (rings, sectors)      two of them  --ring_distance-->  distance

Kim and Kim, Scan Context: egocentric spatial descriptor for place recognition within 3D point
cloud map, IROS 2018. The ground about the sensor is divided into rings and sectors; each cell has
the height of its highest point. Turning the sensor about the upright axis by a sector moves the
columns on by one, so that two scans are compared at every shift, and the best counts.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from sceneprint.errors import UselessFrame
from sceneprint.geometry.kernel import kernel
from sceneprint.types import AnyFrame, Cloud, Floats, Floats32

#: The paper's numbers: rings, sectors, metres that the rings reach, and what is added to heights
#: so that what lies about the wheels is not nought, metres.
RINGS, SECTORS, RADIUS, LIFT = 20, 60, 80.0, 2.0


def ring_descriptor(
    points: Floats32 | Floats,
    *,
    rings: int = RINGS,
    sectors: int = SECTORS,
    radius: float = RADIUS,
    lift: float = LIFT,
    pole: int = 2,
) -> Floats32:
    """The greatest height in each ring and sector about the sensor.

    Parameters
    ----------
    points : (N, 3) metres, the sensor at the origin
    rings, sectors : how many; a sector is 2 pi / sectors of azimuth
    radius : metres in the ground plane; points beyond are left out
    lift : added to every height, metres
    pole : axis that points up, 0, 1 or 2; azimuth counts from the next axis towards the one after

    Returns
    -------
    (rings, sectors) float32, the height and `lift`; 0 where a cell holds no point
    """
    p = np.asarray(points, np.float64)
    a, b, c = (p[:, (pole + k) % 3] for k in (1, 2, 0))
    flat = np.hypot(a, b)
    inside = flat < radius
    ring = (flat[inside] / radius * rings).astype(np.intp)
    azimuth = np.mod(np.arctan2(b[inside], a[inside]), 2 * np.pi)
    # an azimuth a rounding below 2 pi is of the last sector, not of one more
    sector = np.minimum((azimuth / (2 * np.pi) * sectors).astype(np.intp), sectors - 1)
    highest = np.full((rings, sectors), -np.inf)
    np.maximum.at(highest, (ring, sector), c[inside] + lift)
    return np.where(np.isfinite(highest), highest, 0.0).astype(np.float32)


@kernel
def _unit_columns(descriptor: Floats, unit: Floats, filled: NDArray[np.bool_]) -> None:
    rings, sectors = descriptor.shape
    for s in range(sectors):
        square = 0.0
        for r in range(rings):
            square += descriptor[r, s] ** 2
        filled[s] = square > 0.0
        for r in range(rings):
            unit[s, r] = descriptor[r, s] / np.sqrt(square) if square > 0.0 else 0.0


@kernel
def _best_shift(
    a: Floats, a_filled: NDArray[np.bool_], b: Floats, b_filled: NDArray[np.bool_]
) -> tuple[float, int]:
    """Least distance over shifts, and the shift: column s of `a` against s + shift of `b`."""
    sectors, rings = a.shape
    best, at = 2.0, 0
    for shift in range(sectors):
        total, count = 0.0, 0
        for s in range(sectors):
            t = (s + shift) % sectors
            if a_filled[s] and b_filled[t]:
                cosine = 0.0
                for r in range(rings):
                    cosine += a[s, r] * b[t, r]
                total += 1.0 - cosine
                count += 1
        if count and total / count < best:
            best, at = total / count, shift
    return best, at


def _columns(descriptor: Floats32) -> tuple[Floats, NDArray[np.bool_]]:
    unit = np.empty(descriptor.shape[::-1])
    filled = np.empty(descriptor.shape[1], np.bool_)
    _unit_columns(np.ascontiguousarray(descriptor, np.float64), unit, filled)
    return unit, filled


def ring_distance(a: Floats32, b: Floats32) -> tuple[float, int]:
    """How unlike two scans are, whichever way they are turned about the upright axis.

    Parameters
    ----------
    a, b : (rings, sectors) each

    Returns
    -------
    distance : mean of 1 - cosine over columns that both have filled, at the best shift; 0 to 2
    shift : sectors by which the columns of `a` lie further on in `b`
    """
    distance, shift = _best_shift(*_columns(a), *_columns(b))
    return float(distance), int(shift)


def ring_distances(query: Floats32, database: Floats32) -> Floats:
    """Distance of one descriptor (rings, sectors) to each of (N, rings, sectors): (N,)."""
    own = _columns(query)
    return np.array([_best_shift(*own, *_columns(other))[0] for other in database], float)


class Rings:
    """The ring descriptor as a baseline: for clouds with a viewpoint."""

    name = "rings"

    def __init__(self, radius: float = RADIUS) -> None:
        self.radius = radius

    def takes(self, frame: AnyFrame) -> bool:
        """Whether the baseline is made for such a frame."""
        return isinstance(frame, Cloud) and frame.has_viewpoint

    def read(self, frame: AnyFrame) -> Floats32:
        """The descriptor of a cloud, its z axis taken as upright."""
        if not isinstance(frame, Cloud):
            raise UselessFrame(f"{frame.name}: A ring descriptor is of a point cloud. Send one.")
        return ring_descriptor(frame.points, radius=self.radius)

    def check(self) -> None:
        """Nothing is needed."""

    def learn(self, database: Iterable[Floats32], count: int, seed: int) -> None:
        """Nothing is learnt."""

    def finish(self, kept: Floats32) -> Floats32:
        """The descriptor itself."""
        return kept

    def distances(self, query: Floats32, database: Floats32) -> Floats:
        """See `ring_distances`."""
        return ring_distances(query, database)
