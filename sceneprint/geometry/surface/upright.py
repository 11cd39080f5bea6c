"""Estimation of the up direction and the units of an imported surface.

The floor is the largest level plane of a place, and places are wider than high. Furniture indicates
the lower end, because most of its surface is near the floor.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneprint.types import Floats, Floats32, Ints32

Integers = NDArray[np.integer]

#: Maximum number of points, and of triangles; larger surfaces are sampled evenly.
_MOST_POINTS, _MOST_TRIANGLES = 1_000_000, 1_000_000
#: Edge lengths of the cells in which planes are fitted, as shares of the extent, and minimum mean
#: number of points per cell; the smallest cells that reach this number are used.
_EDGES, _CELL_POINTS = (1 / 256, 1 / 128, 1 / 64, 1 / 32, 1 / 16), 12.0
#: Conditions for a plane: minimum number of points, minimum ratio of the second variance to the
#: first, and maximum ratio of the third variance to the second.
_FEWEST, _NO_LINE, _FLAT = 6, 0.05, 0.1
#: Number of directions on the hemisphere, and of pieces that vote for them.
_DIRECTIONS, _VOTERS = 1500, 6000
#: Minimum cosine between a piece's normal and a direction for the piece to vote for it, and for the
#: piece to vote for no other direction.
_NEAR, _EXCLUSIVE = math.cos(math.radians(12.0)), math.cos(math.radians(25.0))
#: Maximum number of dominant directions, and minimum share of the votes for each.
_MOST_PEAKS, _LEAST_SHARE = 5, 0.03
#: Minimum cosine for an estimate to snap to the usual axis, and to another axis of the file. The
#: tolerances allow for sloping ground.
_SNAP_USUAL, _SNAP = math.cos(math.radians(7.0)), math.cos(math.radians(3.0))
#: Thickness of a floor, as a share of the extent.
_LAYER = 0.02
#: Quantiles that bound the extent, so that stray points do not widen it.
_LOW, _HIGH = 0.01, 0.99
#: Weights of the usual axis relative to other axes, and of its usual end relative to its other end.
_USUAL, _USUAL_SIGN = 1.8, 0.6
#: Weights of an uneven distribution of mass along a direction: in favour of that direction, and of
#: its heavier end as the lower end.
_LEAN_GAIN, _LEAN_WEIGHT = 8.0, 3.0
#: Minimum cosine between up and the normals of level surfaces, maximum cosine for walls, and share
#: of the height of a place that counts as its end.
_LEVEL, _UPRIGHT, _END = 0.97, 0.3, 0.08
#: Minimum evidence for an end, and minimum ratio of the two best scores, for a result to be clear.
_CLEAR_SIGN, _CLEAR = 0.4, 1.3


@dataclass(frozen=True, eq=False)
class Pieces:
    """Flat pieces of a surface.

    Parameters
    ----------
    centres, normals : (n, 3) centres and unit normals
    areas : (n,) in any unit
    oriented : whether the normals point to the observed side
    """

    centres: Floats
    normals: Floats
    areas: Floats
    oriented: bool


@dataclass(frozen=True, eq=False)
class Upright:
    """The estimated up direction of a surface.

    Parameters
    ----------
    up : (3,) unit vector
    is_clear : whether all other directions are much less likely
    """

    up: Floats
    is_clear: bool


def estimate_up(points: Floats32, triangles: Ints32 | None, usual: Floats) -> Upright:
    """Estimate the up direction of a surface.

    Parameters
    ----------
    points : (N, 3), finite, N >= 1, any unit
    triangles : (M, 3) indices of points; None for a cloud
    usual : (3,) unit vector, the up direction of most files of this format; it is selected for
        symmetric surfaces such as an empty cube
    """
    pieces = flat_pieces(points, triangles)
    candidates = list(dominant_directions(pieces))
    if not any(abs(float(candidate @ usual)) > _SNAP_USUAL for candidate in candidates):
        candidates.append(usual)
    candidates = [_snap(candidate, usual) for candidate in candidates]
    ends = [_ends(points, candidate) for candidate in candidates]
    widest = max(high - low for low, high in ends) or 1.0
    sample, areas = _mass(points, pieces)
    scores, leans = [], []
    for candidate, (low, high) in zip(candidates, ends, strict=True):
        height = max(high - low, 1e-3 * widest)
        places = (sample @ candidate - low) / height
        lean = 0.5 - float(np.average(np.clip(places, 0.0, 1.0), weights=areas))
        score = _layers(pieces, candidate, _LAYER * widest) * widest / height
        score *= 1.0 + _LEAN_GAIN * abs(lean)
        scores.append(score)
        leans.append(_LEAN_WEIGHT * lean + _furniture(pieces, candidate, low, height))
    likely = [
        score * (_USUAL if abs(float(candidate @ usual)) > _EXCLUSIVE else 1.0)
        for candidate, score in zip(candidates, scores, strict=True)
    ]
    best = int(np.argmax(likely))
    others = [score for k, score in enumerate(scores) if k != best]
    total = leans[best] + _USUAL_SIGN * float(np.round(candidates[best] @ usual))
    sign = 1.0 if total >= 0 else -1.0
    clear = sign * leans[best] > _CLEAR_SIGN and scores[best] > _CLEAR * max(others, default=0.0)
    return Upright(sign * candidates[best], bool(clear))


#: Maximum height, in units, of a place in metres and of a place in centimetres; and maximum ratio
#: of extent to height of a place in centimetres: maps of hills in metres are flatter.
_TALLEST_M, _TALLEST_CM, _FLATTEST = 150.0, 1000.0, 12.0
#: Maximum extent of a place, metres.
_WIDEST_M = 20_000.0


def estimate_units(points: Floats32, up: Floats) -> float:
    """Estimate the units of a surface per metre: 1, 100 or 1000.

    Return 1 unless the place would be too high or too wide in metres.

    Parameters
    ----------
    points : (N, 3), finite, N >= 1, in the unknown unit
    up : (3,) unit vector
    """
    low, high = _ends(points, up)
    height = high - low
    step = -(-len(points) // _MOST_POINTS)
    lows, highs = np.quantile(points[::step], (_LOW, _HIGH), axis=0)
    widest = float((highs - lows).max())
    if widest > _WIDEST_M or height >= _TALLEST_CM:
        return 1000.0
    if height >= _TALLEST_M and widest <= _FLATTEST * height:
        return 100.0
    return 1.0


def _snap(direction: Floats, usual: Floats) -> Floats:
    """Return the axis of the file that is near a direction, or else the direction itself."""
    if abs(float(direction @ usual)) > _SNAP_USUAL:
        return usual
    k = int(np.abs(direction).argmax())
    if abs(direction[k]) < _SNAP:
        return direction
    axis = np.zeros(3)
    axis[k] = math.copysign(1.0, direction[k])
    return axis


def _ends(points: Floats32, direction: Floats) -> tuple[float, float]:
    """Return the ends of the surface along a direction, ignoring 1 % of the points at each end."""
    step = -(-len(points) // _MOST_POINTS)
    low, high = np.quantile(points[::step] @ direction, (_LOW, _HIGH))
    return float(low), float(high)


def _mass(points: Floats32, pieces: Pieces) -> tuple[Floats, Floats]:
    """Return points that represent the surface, and their weights."""
    if pieces.oriented and len(pieces.areas):
        return pieces.centres, pieces.areas
    sample = points[:: -(-len(points) // _MOST_POINTS)].astype(np.float64)
    return sample, np.ones(len(sample))


def _layers(pieces: Pieces, direction: Floats, thickness: float) -> float:
    """Return the share of the largest layer across a direction, plus half that of the second."""
    across = np.abs(pieces.normals @ direction) > _NEAR
    if not across.any():
        return 0.0
    heights = pieces.centres[across] @ direction
    bins = np.floor((heights - heights.min()) / (thickness / 2)).astype(np.int64)
    layers = np.convolve(np.bincount(bins, pieces.areas[across]), np.ones(3), "same")
    first = int(layers.argmax())
    full = float(layers[first])
    layers[max(first - 3, 0) : first + 4] = 0.0
    return (full + 0.5 * float(layers.max())) / float(pieces.areas.sum())


def _furniture(pieces: Pieces, direction: Floats, low: float, height: float) -> float:
    """Return the excess of furniture in the lower half, within [-1.75, 1.75].

    Walls do not count. Level pieces have an additional weight of one half. Floor and ceiling have a
    small weight, because furniture hides the floor, but cameras look down.
    """
    places = (pieces.centres @ direction - low) / height
    cosines = np.abs(pieces.normals @ direction)
    level, other = cosines > _LEVEL, cosines > _UPRIGHT
    inside = np.abs(places - 0.5) < 0.5 - _END
    return (
        _balance(pieces.areas, other & inside, places)
        + 0.5 * _balance(pieces.areas, level & inside, places)
        + 0.25 * _balance(pieces.areas, level & ~inside, places)
    )


def _balance(areas: Floats, chosen: NDArray[np.bool_], places: Floats) -> float:
    """Return the area in the lower half minus that in the upper half, over their sum."""
    lower = float(areas[chosen & (places < 0.5)].sum())
    upper = float(areas[chosen & (places >= 0.5)].sum())
    return (lower - upper) / (lower + upper + 0.005 * float(areas.sum()) or 1.0)


def flat_pieces(points: Floats32, triangles: Ints32 | None) -> Pieces:
    """Divide a surface into flat pieces.

    Parameters
    ----------
    points : (N, 3), finite, any unit
    triangles : (M, 3) indices, counter-clockwise from the observed side; None for a cloud
    """
    if triangles is not None:
        chosen = triangles[:: -(-len(triangles) // _MOST_TRIANGLES)]
        a, b, c = (points[chosen[:, k]].astype(np.float64) for k in range(3))
        across = np.cross(b - a, c - a)
        lengths = np.linalg.norm(across, axis=1)
        real = lengths > 0
        normals = across[real] / lengths[real, None]
        return Pieces(((a + b + c) / 3)[real], normals, lengths[real] / 2, oriented=True)
    sample = points[:: -(-len(points) // _MOST_POINTS)].astype(np.float64)
    low, high = np.quantile(sample, (_LOW, _HIGH), axis=0)
    extent = float((high - low).max()) or 1.0
    for share in _EDGES:
        edge = share * extent
        index = np.clip(np.floor((sample - low) / edge), -(1 << 20), (1 << 20) - 1)
        keys = (index.astype(np.int64) + (1 << 20)) @ np.array([1 << 42, 1 << 21, 1])
        _, cells, counts = np.unique(keys, return_inverse=True, return_counts=True)
        if len(sample) >= _CELL_POINTS * len(counts):
            break
    return _fit_planes((sample - low) / edge - index, sample, cells, counts)


def _fit_planes(inside: Floats, sample: Floats, cells: Integers, counts: Integers) -> Pieces:
    """Fit planes to the points of cells; return the planes of cells with flat surfaces."""
    n = len(counts)

    def mean(values: Floats) -> Floats:
        return np.bincount(cells, values, n) / counts

    centre = np.stack([mean(inside[:, k]) for k in range(3)], axis=1)
    spread = np.empty((n, 3, 3))
    for i in range(3):
        for j in range(i, 3):
            product = mean(inside[:, i] * inside[:, j]) - centre[:, i] * centre[:, j]
            spread[:, i, j] = spread[:, j, i] = product
    flat = np.flatnonzero(counts >= _FEWEST)
    values, vectors = np.linalg.eigh(spread[flat])
    plane = (values[:, 0] < _FLAT * values[:, 1]) & (values[:, 1] > _NO_LINE * values[:, 2])
    centres = np.stack([mean(sample[:, k]) for k in range(3)], axis=1)[flat[plane]]
    return Pieces(centres, vectors[plane, :, 0], np.ones(int(plane.sum())), oriented=False)


def dominant_directions(pieces: Pieces) -> Floats:
    """Return the directions (k, 3) that most pieces face with either side, most frequent first.

    The directions differ by at least 25 degrees.
    """
    normals, areas = pieces.normals, pieces.areas
    total = float(areas.sum())
    if total <= 0:
        return np.empty((0, 3))
    # equal steps of the cumulative area give a deterministic sample, weighted by area
    ranks = np.searchsorted(np.cumsum(areas), (np.arange(_VOTERS) + 0.5) * total / _VOTERS)
    voters = normals[np.minimum(ranks, len(areas) - 1)]
    directions = _hemisphere(_DIRECTIONS)
    near = np.abs(voters @ directions.T) > _NEAR
    free, peaks = np.ones(len(voters), np.bool_), list[Floats]()
    for _ in range(_MOST_PEAKS):
        votes = near[free].sum(axis=0) if free.any() else np.zeros(1)
        if votes.max() < _LEAST_SHARE * _VOTERS:
            break
        peak = directions[int(votes.argmax())]
        for _ in range(5):
            close = voters[np.abs(voters @ peak) > _NEAR]
            peak = np.linalg.eigh(close.T @ close)[1][:, -1]
        free &= np.abs(voters @ peak) <= _EXCLUSIVE
        peaks.append(peak)
    return np.array(peaks).reshape(-1, 3)


def _hemisphere(count: int) -> Floats:
    """Return evenly distributed directions (count, 3) with z > 0."""
    z = (np.arange(count) + 0.5) / count
    angle = np.arange(count) * math.pi * (3.0 - math.sqrt(5.0))
    r = np.sqrt(1.0 - z * z)
    return np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1)
