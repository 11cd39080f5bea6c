"""Which way is up in a surface that is given whole, and in which units it is.

points, triangles  --estimate_up-->  Upright: direction, and whether the surface shows it clearly
points, up  --estimate_units-->  units per metre

A floor is the largest level plane of a place, and a place is lower than it is wide. What stands on
the floor shows which end is the lower one: there the place is fuller.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneprint.types import Floats, Floats32, Ints32

Integers = NDArray[np.integer]

#: Points and triangles that take part, evenly spread over the surface.
_MOST_POINTS, _MOST_TRIANGLES = 1_000_000, 1_000_000
#: Edges of the cells that planes are fitted in, shares of the extent; the finest whose cells have
#: so many points in the mean is taken.
_EDGES, _CELL_POINTS = (1 / 256, 1 / 128, 1 / 64, 1 / 32, 1 / 16), 12.0
#: Fewest points of a cell; least spread along the second axis over that along the first, and most
#: along the third over that along the second, variances, for a plane.
_FEWEST, _NO_LINE, _FLAT = 6, 0.05, 0.1
#: Directions of the hemisphere and pieces that vote on them; cosines of pieces that speak for a
#: direction, and of those that cannot speak for another one any more.
_DIRECTIONS, _VOTERS = 1500, 6000
_NEAR, _TAKEN = math.cos(math.radians(12.0)), math.cos(math.radians(25.0))
#: Most dominant directions, and the least share of the surface that each must have.
_MOST_PEAKS, _LEAST_SHARE = 5, 0.03
#: The usual axis, and another axis of the file, that are so near to the estimate are taken as they
#: are, cosines: ground may slope.
_SNAP_USUAL, _SNAP = math.cos(math.radians(7.0)), math.cos(math.radians(3.0))
#: Thickness of a floor, share of the extent.
_LAYER = 0.02
#: Quantiles that the extent is measured between: a few stray points are no walls.
_LOW, _HIGH = 0.01, 0.99
#: How much more likely the usual axis is than any other, and its usual end than the other end.
_USUAL, _USUAL_SIGN = 1.8, 0.6
#: How much a place that is fuller at one end speaks for this direction, and for that end.
_LEAN_GAIN, _LEAN_WEIGHT = 8.0, 3.0
#: Cosines to up of level surfaces, at most of walls; the ends of a place, shares of its height.
_LEVEL, _UPRIGHT, _END = 0.97, 0.3, 0.08
#: Least evidence for an end, and ratio of scores, for a clear answer.
_CLEAR_SIGN, _CLEAR = 0.4, 1.3


@dataclass(frozen=True, eq=False)
class Pieces:
    """Flat pieces of a surface.

    Parameters
    ----------
    centres, normals : (n, 3)
    areas : (n,) in any unit
    oriented : whether normals point to the side that was seen
    """

    centres: Floats
    normals: Floats
    areas: Floats
    oriented: bool


@dataclass(frozen=True, eq=False)
class Upright:
    """Return value of `estimate_up`.

    Parameters
    ----------
    up : (3,) unit vector
    is_clear : whether no other direction is nearly as likely
    """

    up: Floats
    is_clear: bool


def estimate_up(points: Floats32, triangles: Ints32 | None, usual: Floats) -> Upright:
    """Return which way is up in a surface.

    Parameters
    ----------
    points : (N, 3), finite, N >= 1, any unit
    triangles : (M, 3) indices into them; None for a cloud
    usual : (3,) unit vector, the direction that is up in most files of this format; it decides
        where the surface does not, as in an empty cube
    """
    pieces = pieces_of(points, triangles)
    candidates = list(dominant_directions(pieces))
    if not any(abs(float(one @ usual)) > _SNAP_USUAL for one in candidates):
        candidates.append(usual)
    candidates = [_snapped(one, usual) for one in candidates]
    ends = [_ends(points, one) for one in candidates]
    widest = max(high - low for low, high in ends) or 1.0
    sample, areas = _mass(points, pieces)
    scores, leans = [], []
    for one, (low, high) in zip(candidates, ends, strict=True):
        height = max(high - low, 1e-3 * widest)
        places = (sample @ one - low) / height
        lean = 0.5 - float(np.average(np.clip(places, 0.0, 1.0), weights=areas))
        score = _layers(pieces, one, _LAYER * widest) * widest / height
        score *= 1.0 + _LEAN_GAIN * abs(lean)
        scores.append(score)
        leans.append(_LEAN_WEIGHT * lean + _furniture(pieces, one, low, height))
    likely = [
        score * (_USUAL if abs(float(one @ usual)) > _TAKEN else 1.0)
        for one, score in zip(candidates, scores, strict=True)
    ]
    best = int(np.argmax(likely))
    others = [score for k, score in enumerate(scores) if k != best]
    total = leans[best] + _USUAL_SIGN * float(np.round(candidates[best] @ usual))
    sign = 1.0 if total >= 0 else -1.0
    clear = sign * leans[best] > _CLEAR_SIGN and scores[best] > _CLEAR * max(others, default=0.0)
    return Upright(sign * candidates[best], bool(clear))


#: Heights that a place has in metres at most, and in centimetres; and extents over the height, at
#: most, of a place in centimetres: maps of hills in metres are flatter.
_TALLEST_M, _TALLEST_CM, _FLATTEST = 150.0, 1000.0, 12.0
#: Extent of a place in metres, at most.
_WIDEST_M = 20_000.0


def estimate_units(points: Floats32, up: Floats) -> float:
    """Return how many units of a surface are a metre: 1, 100 or 1000.

    Millimetres and centimetres are only returned where the place would be too high in metres.

    Parameters
    ----------
    points : (N, 3), finite, N >= 1, in the units
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


def _snapped(direction: Floats, usual: Floats) -> Floats:
    """The axis of the file that is near the direction, or the direction itself."""
    if abs(float(direction @ usual)) > _SNAP_USUAL:
        return usual
    k = int(np.abs(direction).argmax())
    if abs(direction[k]) < _SNAP:
        return direction
    axis = np.zeros(3)
    axis[k] = math.copysign(1.0, direction[k])
    return axis


def _ends(points: Floats32, direction: Floats) -> tuple[float, float]:
    """How far the surface reaches along a direction, without its last hundredths."""
    step = -(-len(points) // _MOST_POINTS)
    low, high = np.quantile(points[::step] @ direction, (_LOW, _HIGH))
    return float(low), float(high)


def _mass(points: Floats32, pieces: Pieces) -> tuple[Floats, Floats]:
    """Places of the surface and their weights."""
    if pieces.oriented and len(pieces.areas):
        return pieces.centres, pieces.areas
    sample = points[:: -(-len(points) // _MOST_POINTS)].astype(np.float64)
    return sample, np.ones(len(sample))


def _layers(pieces: Pieces, direction: Floats, thickness: float) -> float:
    """The share of the surface in the two fullest layers across a direction, half of the second."""
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
    """How much more lies in the lower half, [-1.75, 1.75].

    Counted are pieces that are no wall, once more those that are level, and floor and ceiling a
    little: furniture hides more of the floor, and cameras look down.
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
    """Lower less upper half, as a share of both; 0 where there is hardly anything."""
    lower = float(areas[chosen & (places < 0.5)].sum())
    upper = float(areas[chosen & (places >= 0.5)].sum())
    return (lower - upper) / (lower + upper + 0.005 * float(areas.sum()) or 1.0)


def pieces_of(points: Floats32, triangles: Ints32 | None) -> Pieces:
    """Return the flat pieces of a surface.

    Parameters
    ----------
    points : (N, 3), finite, any unit
    triangles : (M, 3) indices, counter-clockwise from the side that was seen; None for a cloud
    """
    if triangles is not None:
        chosen = triangles[:: -(-len(triangles) // _MOST_TRIANGLES)]
        a, b, c = (points[chosen[:, k]].astype(np.float64) for k in range(3))
        across = np.cross(b - a, c - a)
        doubled = np.linalg.norm(across, axis=1)
        real = doubled > 0
        normals = across[real] / doubled[real, None]
        return Pieces(((a + b + c) / 3)[real], normals, doubled[real] / 2, oriented=True)
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
    return _fitted((sample - low) / edge - index, sample, cells, counts)


def _fitted(inside: Floats, sample: Floats, cells: Integers, counts: Integers) -> Pieces:
    """A plane for each cell whose points lie in one."""
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
    """Return the directions (k, 3) that most pieces face, either way, the strongest first.

    Each has a place of its own: none lies within 25 degrees of another.
    """
    normals, areas = pieces.normals, pieces.areas
    total = float(areas.sum())
    if total <= 0:
        return np.empty((0, 3))
    # evenly spaced in the sum of areas: large pieces are drawn more often, always the same ones
    ranks = np.searchsorted(np.cumsum(areas), (np.arange(_VOTERS) + 0.5) * total / _VOTERS)
    voters = normals[np.minimum(ranks, len(areas) - 1)]
    directions = _hemisphere(_DIRECTIONS)
    near = np.abs(voters @ directions.T) > _NEAR
    free, found = np.ones(len(voters), np.bool_), list[Floats]()
    for _ in range(_MOST_PEAKS):
        votes = near[free].sum(axis=0) if free.any() else np.zeros(1)
        if votes.max() < _LEAST_SHARE * _VOTERS:
            break
        peak = directions[int(votes.argmax())]
        for _ in range(5):
            close = voters[np.abs(voters @ peak) > _NEAR]
            peak = np.linalg.eigh(close.T @ close)[1][:, -1]
        free &= np.abs(voters @ peak) <= _TAKEN
        found.append(peak)
    return np.array(found).reshape(-1, 3)


def _hemisphere(count: int) -> Floats:
    """Evenly spread directions (count, 3) with z > 0."""
    z = (np.arange(count) + 0.5) / count
    angle = np.arange(count) * math.pi * (3.0 - math.sqrt(5.0))
    r = np.sqrt(1.0 - z * z)
    return np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1)
