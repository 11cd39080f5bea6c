"""Histograms of the surroundings of patches, and correspondences from them (Sec. III-E).

    Patches (P)  --patch_descriptors-->  (P, D) float32  --compress-->  (P, d) uint8
    descriptors (S, d), (P, d)  --correspondences-->  pairs (M, 2)

The properties resemble Eq. (1), on the same scale. The properties of a neighbour
within reach are its distance in the plane of the patch, its height over that plane, and the angles
of its normal to the patch's normal and to the in-plane direction of the neighbour. All are
invariant under rigid motion.

Reading R10 (docs/paper.md): only the idea of the paper's patch matching is public. A random sample
of the source's patches is compared with all patches of the target; a patch corresponds to the
nearest patches.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from sceneprint.geometry.kernel import disjoint_kernel, kernel
from sceneprint.types import Bytes, Floats, Floats32, Ints32, Patches

#: Number of bins of an angle at every scale.
ANGLES = 3


@dataclass(frozen=True)
class PatchDescriptorParameters:
    """Parameters of the histograms: reaches in metres, and numbers of distance and height bins."""

    near_radius: float = 0.4
    near_distances: int = 4
    near_heights: int = 5
    middle_radius: float = 0.8
    middle_distances: int = 5
    middle_heights: int = 7
    far_radius: float = 1.6
    far_distances: int = 6
    far_heights: int = 8

    @property
    def scales(self) -> Floats:
        """Return the radius and the numbers of distance and height bins of each scale, (3, 3)."""
        return np.array(
            [
                (self.near_radius, self.near_distances, self.near_heights),
                (self.middle_radius, self.middle_distances, self.middle_heights),
                (self.far_radius, self.far_distances, self.far_heights),
            ],
            float,
        )

    @property
    def dimension(self) -> int:
        """Return D, the total number of bins."""
        return int((self.scales[:, 1] * self.scales[:, 2]).sum()) * ANGLES * ANGLES


@dataclass(frozen=True, eq=False)
class Compression:
    """The principal components of histograms, fitted once.

    Parameters
    ----------
    mean : (D,) float32
    matrix : (d, D) float32, with orthonormal rows
    """

    mean: Floats32
    matrix: Floats32

    @cached_property
    def offset(self) -> Floats32:
        """Return the components of the mean, (d,)."""
        result: Floats32 = (self.matrix.astype(float) @ self.mean).astype(np.float32)
        return result

    @cached_property
    def columns(self) -> Floats32:
        """Return the matrix, transposed to (D, d)."""
        return np.ascontiguousarray(self.matrix.T)


#: Maximum absolute value of the components of a unit vector; few of 128 components reach it.
#: Clipping prevents one component, such as for floors, from outweighing all others.
RANGE = 0.25


@disjoint_kernel
def _squared_distances(x: Floats, y: Floats, z: Floats, i: int, out: Floats) -> None:
    """Write the squared distances of patch i from all patches."""
    ix, iy, iz = x[i], y[i], z[i]
    for j in range(len(out)):
        dx, dy, dz = x[j] - ix, y[j] - iy, z[j] - iz
        out[j] = dx * dx + dy * dy + dz * dz


@disjoint_kernel
def _select_near(squares: Floats, count: int, excluded: int, limit: float, places: Ints32) -> int:
    """Write the indices of squares below a limit, except index `excluded`; return their number."""
    selected = 0
    for j in range(count):
        places[selected] = j
        selected += 1 if (squares[j] < limit) & (j != excluded) else 0
    return selected


@disjoint_kernel
def _locate(
    points: Floats, normals: Floats, areas: Floats, squares: Floats, i: int, places: Ints32,
    count: int, angles: int, lies: Floats, bins: Ints32,
) -> None:  # fmt: skip
    """Write the positions of other patches relative to patch i.

    `lies` (6, n): squared distance, distance in the plane, height, the share that falls into the
    upper bin of each angle, and area. `bins` (4, n): the four pairs of angle bins, the second angle
    varying fastest.
    """
    x, y, z, nx, ny, nz = points[0], points[1], points[2], normals[0], normals[1], normals[2]
    ix, iy, iz, ax, ay, az = x[i], y[i], z[i], nx[i], ny[i], nz[i]
    for k in range(count):
        j = np.uint64(places[k])
        dx, dy, dz = x[j] - ix, y[j] - iy, z[j] - iz
        bx, by, bz = nx[j], ny[j], nz[j]
        height = dx * ax + dy * ay + dz * az
        cosine = ax * bx + ay * by + az * bz
        flat = np.sqrt(max(squares[j] - height * height, 0.0))
        # the component of the other normal along the in-plane direction to the other patch
        radial = (bx * dx + by * dy + bz * dz - height * cosine) / flat
        radial = radial if flat > 1e-3 else 0.0
        e = min(max((cosine + 1.0) * 0.5, 0.0), 1.0) * angles - 0.5
        g = min(max((radial + 1.0) * 0.5, 0.0), 1.0) * angles - 0.5
        ie: Any = np.int32(np.floor(e))
        ig: Any = np.int32(np.floor(g))
        lies[0, k], lies[1, k], lies[2, k] = squares[j], flat, height
        lies[3, k], lies[4, k], lies[5, k] = e - ie, g - ig, areas[j]
        e0, e1 = max(ie, 0) * angles, min(ie + 1, angles - 1) * angles
        g0, g1 = max(ig, 0), min(ig + 1, angles - 1)
        bins[0, k], bins[1, k], bins[2, k], bins[3, k] = e0 + g0, e0 + g1, e1 + g0, e1 + g1


@disjoint_kernel
def _spread(
    lies: Floats, places: Ints32, count: int, radius: float, n_flat: int, n_high: int,
    n_angles: int, weights: Floats, starts: Ints32,
) -> None:  # fmt: skip
    """Write the weights (4, n) of patches in their distance and height bins, and bin offsets."""
    flat, height, area = lies[1], lies[2], lies[5]
    for k in range(count):
        i = np.uint64(places[k])
        a = flat[i] / radius * n_flat - 0.5
        b = (height[i] / radius + 1.0) * 0.5 * n_high - 0.5
        ia: Any = np.int32(np.floor(a))
        ib: Any = np.int32(np.floor(b))
        fa, fb = a - ia, b - ib
        a0, a1 = min(max(ia, 0), n_flat - 1), min(max(ia + 1, 0), n_flat - 1)
        b0, b1 = min(max(ib, 0), n_high - 1), min(max(ib + 1, 0), n_high - 1)
        w0, w1 = area[i] * (1.0 - fa), area[i] * fa
        weights[0, k], weights[1, k] = w0 * (1.0 - fb), w0 * fb
        weights[2, k], weights[3, k] = w1 * (1.0 - fb), w1 * fb
        starts[0, k], starts[1, k] = (a0 * n_high + b0) * n_angles, (a0 * n_high + b1) * n_angles
        starts[2, k], starts[3, k] = (a1 * n_high + b0) * n_angles, (a1 * n_high + b1) * n_angles


@disjoint_kernel
def _add_shares(
    lies: Floats, bins: Ints32, places: Ints32, count: int, weights: Floats, starts: Ints32,
    histogram: Floats32,
) -> None:  # fmt: skip
    """Add the 16 weighted shares of each patch's area to its bins of the histogram."""
    for k in range(count):
        i = np.uint64(places[k])
        fe, fg = lies[3, i], lies[4, i]
        for c in range(4):
            low, high = weights[c, k] * (1.0 - fe), weights[c, k] * fe
            start = starts[c, k]
            histogram[np.uint64(start + bins[0, i])] += low * (1.0 - fg)
            histogram[np.uint64(start + bins[1, i])] += low * fg
            histogram[np.uint64(start + bins[2, i])] += high * (1.0 - fg)
            histogram[np.uint64(start + bins[3, i])] += high * fg


@kernel
def _accumulate(
    points: Floats, normals: Floats, areas: Floats, scales: Floats, angles: int, out: Floats32
) -> None:
    """Add the area of each pair to the 16 nearest bins at each scale that reaches it.

    `points` and `normals` are (3, P).
    """
    count, n_angles = len(areas), angles * angles
    reach = 0.0
    for s in range(len(scales)):
        reach = max(reach, scales[s, 0])
    squares, lies, weights = np.empty(count), np.empty((6, count)), np.empty((4, count))
    within, near = np.empty(count, np.int32), np.empty(count, np.int32)
    bins, starts = np.empty((4, count), np.int32), np.empty((4, count), np.int32)
    for i in range(count):
        _squared_distances(points[0], points[1], points[2], i, squares)
        reached = _select_near(squares, count, i, reach * reach, within)
        _locate(points, normals, areas, squares, i, within, reached, angles, lies, bins)
        start = 0
        for s in range(len(scales)):
            radius, n_flat, n_high = scales[s, 0], int(scales[s, 1]), int(scales[s, 2])
            n_near = _select_near(lies[0], reached, -1, radius * radius, near)
            _spread(lies, near, n_near, radius, n_flat, n_high, n_angles, weights, starts)
            end = start + n_flat * n_high * n_angles
            _add_shares(lies, bins, near, n_near, weights, starts, out[i, start:end])
            start = end


@disjoint_kernel
def _occupied_bins(row: Floats32, first: int, last: int, places: Ints32) -> int:
    """Write the indices of a row's occupied bins; return how many there are."""
    count = 0
    for k in range(first, last):
        places[count] = k
        count += 1 if row[k] > 0 else 0
    return count


@kernel
def _normalise(scales: Floats, angles: int, out: Floats32) -> None:
    """Replace bins by their square roots; normalise each scale to 1 / sqrt(scales) (Hellinger).

    Empty bins, two thirds of all, are skipped.
    """
    places = np.empty(out.shape[1], np.int32)
    for i in range(len(out)):
        start, row = 0, out[i]
        for s in range(len(scales)):
            end = start + int(scales[s, 1]) * int(scales[s, 2]) * angles * angles
            count, total = _occupied_bins(row, start, end, places), 0.0
            for n in range(count):
                total += row[places[n]]
            if count > 0:  # the sum of the bins is the squared length of their roots
                factor = 1.0 / np.sqrt(total * len(scales))
                for n in range(count):
                    k = places[n]
                    row[k] = np.sqrt(row[k]) * factor
            start = end


def patch_descriptors(patches: Patches, p: PatchDescriptorParameters) -> Floats32:
    """Compute a histogram of the macro-scale surroundings of each patch.

    Returns
    -------
    (P, D) float32; a row has unit length if there is another patch within the smallest reach
    """
    out = np.zeros((len(patches), p.dimension), np.float32)
    points, normals = (np.ascontiguousarray(x.T) for x in (patches.means, patches.normals))
    _accumulate(points, normals, patches.areas, p.scales, ANGLES, out)
    _normalise(p.scales, ANGLES, out)
    return out


#: Number of bins per block of a multiplication: the block's matrix rows fit into the cache.
_BINS = 256


@disjoint_kernel
def _project(histograms: Floats32, matrix: Floats32, offset: Floats32, out: Floats32) -> None:
    """Write `histograms` @ `matrix` (D, d), minus the offset; most bins of a histogram are empty.

    Bins are added in order, four at a time, to reduce reads and writes of a row by 75 %.
    """
    places = np.empty(_BINS, np.int32)
    for i in range(len(histograms)):
        for k in range(len(offset)):
            out[i, k] = -offset[k]
    for start in range(0, histograms.shape[1], _BINS):
        end = min(start + _BINS, histograms.shape[1])
        for i in range(len(histograms)):
            histogram, row = histograms[i], out[i]
            count = _occupied_bins(histogram, start, end, places)
            fours = count - count % 4
            for at in range(0, fours, 4):
                b0, b1, b2, b3 = places[at], places[at + 1], places[at + 2], places[at + 3]
                h0, h1, h2, h3 = histogram[b0], histogram[b1], histogram[b2], histogram[b3]
                m0, m1, m2, m3 = matrix[b0], matrix[b1], matrix[b2], matrix[b3]
                for k in range(len(row)):
                    row[k] = (((row[k] + h0 * m0[k]) + h1 * m1[k]) + h2 * m2[k]) + h3 * m3[k]
            for at in range(fours, count):
                value, component = histogram[places[at]], matrix[places[at]]
                for k in range(len(row)):
                    row[k] += value * component[k]


def compress(histograms: Floats32, by: Compression) -> Bytes:
    """Compress histograms to descriptors.

    The bytes encode the principal components, normalised to unit length, in steps of 1/255 of the
    interval [-RANGE, RANGE].

    Parameters
    ----------
    histograms : (P, D) result of `patch_descriptors`
    by : compression that was fitted to histograms of the same layout

    Returns
    -------
    (P, d) uint8, 128 for 0
    """
    out = np.empty((len(histograms), len(by.matrix)), np.float32)
    _project(histograms, by.columns, by.offset, out)
    length = np.sqrt((out * out).sum(axis=1, keepdims=True))
    unit = out / np.maximum(length, 1e-6)
    stored: Bytes = np.clip(np.rint(unit * (127.0 / RANGE)) + 128, 0, 255).astype(np.uint8)
    return stored


def fit_compression(histograms: Floats32, dimension: int) -> Compression:
    """Compute the principal components of histograms.

    Parameters
    ----------
    histograms : (N, D), N > D
    dimension : d, number of components

    Raises
    ------
    ValueError : If there are fewer histograms than bins, or more components than bins
    """
    count, bins = histograms.shape
    if count <= bins or not 1 <= dimension <= bins:
        raise ValueError(
            f"Histograms of shape {histograms.shape} cannot determine {dimension} components. "
            "Train on more frames."
        )
    mean = histograms.mean(axis=0, dtype=float)
    covariance = histograms.T.astype(float) @ histograms / count - np.outer(mean, mean)
    _, vectors = np.linalg.eigh(covariance)
    rows = vectors.T[::-1][:dimension]
    signs = np.sign(rows[np.arange(dimension), np.abs(rows).argmax(axis=1)])  # signs are arbitrary
    return Compression(mean.astype(np.float32), (rows * signs[:, None]).astype(np.float32))


@dataclass(frozen=True)
class MatchingParameters:
    """Parameters of matching by descriptors."""

    n_sources: int = 100  #: number of sampled patches of the source
    n_nearest: int = 3  #: number of correspondences per patch


@kernel
def _match_nearest(
    source: Bytes, target: Bytes, drawn: Ints32, n_nearest: int, slopes: Floats, onto: Floats,
    gate: float, pairs: Ints32,
) -> int:  # fmt: skip
    """Write pairs of each sampled source patch and its nearest target patches; return the count."""
    count, length = target.shape
    farthest = np.int32(2147483647)
    squares = np.empty(count, np.int32)
    n_pairs = 0
    for row in range(len(drawn)):
        query = source[drawn[row]]
        for j in range(count):
            if abs(slopes[drawn[row]] - onto[j]) > gate:
                squares[j] = farthest
                continue
            other = target[j]
            total = np.int32(0)
            for k in range(length):
                gap = np.int32(query[k]) - np.int32(other[k])
                total += gap * gap
            squares[j] = total
        for _ in range(n_nearest):
            best = 0
            for j in range(1, count):
                if squares[j] < squares[best]:
                    best = j
            if squares[best] == farthest:  # the gate excludes all other patches
                break
            pairs[n_pairs, 0] = drawn[row]
            pairs[n_pairs, 1] = best
            squares[best] = farthest
            n_pairs += 1
    return n_pairs


@dataclass(frozen=True, eq=False)
class SlopeGate:
    """A gate that admits only pairs of patches whose normals form similar angles with up.

    Parameters
    ----------
    source, target : (P,) and (P',) angles between the patches' normals and up, radians
    most : maximum difference of corresponding angles, radians
    """

    source: Floats
    target: Floats
    most: float


def correspondences(
    source: Bytes,
    target: Bytes,
    rng: np.random.Generator,
    p: MatchingParameters,
    gate: SlopeGate | None = None,
) -> Ints32:
    """Match a random sample of the source's patches by descriptors: Sec. III-E.

    Parameters
    ----------
    source : (P, d) uint8 descriptors
    target : (P', d) uint8 descriptors
    rng : random generator for the sample
    gate : slope gate; None admits all pairs

    Returns
    -------
    (M, 2) int32 correspondences, as indices in source and in target; nearest first for each source
    patch

    Raises
    ------
    ValueError : If the descriptors have different lengths
    """
    if source.shape[1] != target.shape[1]:
        raise ValueError(
            f"The descriptors have different lengths, {source.shape[1]} and {target.shape[1]} "
            "bytes. Compare descriptors of one model only."
        )
    drawn = np.sort(rng.choice(len(source), min(p.n_sources, len(source)), replace=False))
    n_nearest = min(p.n_nearest, len(target))
    pairs = np.empty((len(drawn) * n_nearest, 2), np.int32)
    if gate is None:
        gate = SlopeGate(np.zeros(len(source)), np.zeros(len(target)), math.inf)
    count = _match_nearest(
        source, target, drawn.astype(np.int32), n_nearest, gate.source, gate.target, gate.most,
        pairs,
    )  # fmt: skip
    return pairs[:count]
