"""Sec. III-F, segmentation: a surface to smooth, compact patches that respect edges.

    Surface (h, w)  --segment-->      labels (h, w)  --patches_of-->  Patches (P)
    Voxels (V)      --supervoxels-->  labels (1, V)  --patches_of-->  Patches (P)

SLIC over position and normal, started from a grid in the image. No pixel term: two pixels
belong together when their points are near and their normals agree, so that patches end at
creases and at depth edges alike.

Clouds are segmented after VCCS (Papon 2013): seeds on a grid, grown from voxel to voxel that touch,
by position and normal; so a patch ends at creases and never crosses a gap. The distance is that of
k-means in position and normal too, and centres follow their patches.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneprint.geometry.kernel import disjoint_kernel, kernel
from sceneprint.geometry.surface.cloud import Ints64, direction_cell, metric_cell
from sceneprint.geometry.surface.voxels import Voxels
from sceneprint.types import Floats, Floats32, Hierarchy, Intrinsics, Ints32, Patches, Surface


@dataclass(frozen=True)
class SegmentationParameters:
    """The numbers of the finest segmentation."""

    n_patches: int = 1000  #: grid seeds of a full image
    iterations: int = 5  #: rounds of assignment and update
    normal_weight: float = 6.0  #: of 1 - cos(normals), beside squared seed spacings
    minimum_size: float = 0.15  #: patches below this share of a grid cell are dropped
    minimum_pixels: int = 4  #: and those below so many pixels


@kernel
def _spread(
    centres: Floats32, row: int, shift: int, cells: Ints32, columns: int, out: Floats32
) -> None:
    """The centre in a row of cells, `shift` beside that of each pixel: (7, w); dead where none."""
    for x in range(len(cells)):
        column = cells[x] + shift
        if row < 0 or row * columns >= len(centres) or column < 0 or column >= columns:
            out[6, x] = 0.0
            continue
        for d in range(7):
            out[d, x] = centres[row * columns + column, d]


@kernel
def _centre_distances(
    pixels: Floats32, y: int, centres: Floats32, normal_weight: np.float32, distance: Floats32
) -> None:
    """Distance of each pixel of a row to its own centre, of (6, h, w) and (7, w); far if dead."""
    px, py, pz = pixels[0, y], pixels[1, y], pixels[2, y]
    nx, ny, nz = pixels[3, y], pixels[4, y], pixels[5, y]
    cx, cy, cz, mx, my, mz = (
        centres[0], centres[1], centres[2], centres[3], centres[4], centres[5]
    )  # fmt: skip
    scale = centres[6]  # (1 / metric seed spacing)^2; 0 for a dead centre
    for x in range(len(distance)):
        dx, dy, dz = px[x] - cx[x], py[x] - cy[x], pz[x] - cz[x]
        cosine = nx[x] * mx[x] + ny[x] * my[x] + nz[x] * mz[x]
        found = (dx * dx + dy * dy + dz * dz) * scale[x] + normal_weight * (
            np.float32(1.0) - cosine
        )
        distance[x] = found if scale[x] > 0 else np.float32(np.inf)


@kernel
def _assign(
    pixels: Floats32, valid: NDArray[np.bool_], centres: Floats32, spacing: float,
    normal_weight: np.float32, columns: int, labels: Ints32,
) -> None:  # fmt: skip
    """Give every pixel, of (6, h, w), the nearest of the centres seeded in the nine cells around
    it.

    Rows of pixels are compared with one centre each at a time, and loops write one array each, so
    that the compiler works on eight pixels at once.
    """
    height, width = valid.shape
    rows = len(centres) // columns
    cells = np.empty(width, np.int32)
    for x in range(width):
        cells[x] = min(int(x / spacing), columns - 1)
    around = np.zeros((9, 7, width), np.float32)
    distance, best = np.empty(width, np.float32), np.empty(width, np.float32)
    cell = -1
    for y in range(height):
        if min(int(y / spacing), rows - 1) != cell:
            cell = min(int(y / spacing), rows - 1)
            for n in range(9):
                _spread(centres, cell + n // 3 - 1, n % 3 - 1, cells, columns, around[n])
        best[:] = np.inf
        own = labels[y]
        for x in range(width):
            own[x] = -1
        for n in range(9):
            k = (cell + n // 3 - 1) * columns + n % 3 - 1
            _centre_distances(pixels, y, around[n], normal_weight, distance)
            for x in range(width):
                own[x] = k + cells[x] if distance[x] < best[x] else own[x]
            for x in range(width):
                best[x] = min(distance[x], best[x])
        for x in range(width):
            own[x] = own[x] if valid[y, x] else -1


@kernel
def _sums(
    points: Floats32, normals: Floats32, weights: Floats32, labels: Ints32, n: int
) -> NDArray[np.float64]:
    """Per label: weight, weighted point (3), weighted normal (3), pixels."""
    height, width = labels.shape
    sums = np.zeros((n, 8))
    for y in range(height):
        for x in range(width):
            k = labels[y, x]
            if k < 0:
                continue
            w = weights[y, x]
            sums[k, 0] += w
            for d in range(3):
                sums[k, 1 + d] += w * points[y, x, d]
                sums[k, 4 + d] += w * normals[y, x, d]
            sums[k, 7] += 1.0
    return sums


def _centres(sums: NDArray[np.float64], spacing: float, focal_length: float) -> Floats32:
    alive = sums[:, 0] > 0
    weight = np.where(alive, sums[:, 0], 1.0)[:, None]
    mean, normal = sums[:, 1:4] / weight, sums[:, 4:7] / weight
    length = np.linalg.norm(normal, axis=1)
    alive &= length > 1e-6
    normal = normal / np.where(alive, length, 1.0)[:, None]
    z = np.where(alive, mean[:, 2], 1.0)
    scale = np.where(alive, (focal_length / (spacing * z)) ** 2, 0.0)
    return np.column_stack([mean, normal, scale]).astype(np.float32)


def segment(surface: Surface, p: SegmentationParameters) -> Ints32:
    """Assign every valid pixel to a patch.

    Patches below either limit of the parameters are dropped (their pixels get -1):
    their normals would be noise, and in an image of a thousand patches they hold under
    one per cent of the surface.

    Parameters
    ----------
    surface : (h, w) points in metres and normals
    p : see SegmentationParameters

    Returns
    -------
    labels : (h, w) int32, 0 to P - 1 in the order of the image; -1 for none
    """
    height, width = surface.valid.shape
    assert isinstance(surface.camera, Intrinsics)
    spacing = max(math.sqrt(height * width / p.n_patches), 1.0)
    rows, columns = max(round(height / spacing), 1), max(round(width / spacing), 1)
    focal_length = math.sqrt(surface.camera.fx * surface.camera.fy)
    y, x = np.mgrid[:height, :width]
    cell_y = np.minimum((y / spacing).astype(np.int32), rows - 1)
    cell_x = np.minimum((x / spacing).astype(np.int32), columns - 1)
    labels: Ints32 = np.where(surface.valid, cell_y * columns + cell_x, -1).astype(np.int32)
    ones = np.ones((height, width), np.float32)
    n = rows * columns
    pixels = np.concatenate([surface.points, surface.normals], axis=2).transpose(2, 0, 1)
    pixels = np.ascontiguousarray(pixels)
    for _ in range(p.iterations):
        centres = _centres(
            _sums(surface.points, surface.normals, ones, labels, n), spacing, focal_length
        )
        _assign(
            pixels, surface.valid, centres, spacing, np.float32(p.normal_weight), columns, labels
        )
    smallest = max(p.minimum_pixels, p.minimum_size * spacing * spacing)
    return compact_labels(labels, np.bincount(labels[labels >= 0], minlength=n) >= smallest)


def compact_labels(labels: Ints32, keep: NDArray[np.bool_]) -> Ints32:
    """Renumber labels without gaps, those not kept becoming -1.

    Parameters
    ----------
    labels : (h, w) int32, -1 for none
    keep : (n,) bool
    """
    renumbered = np.where(keep, np.cumsum(keep) - 1, -1).astype(np.int32)
    result: Ints32 = np.where(labels >= 0, renumbered[labels], -1).astype(np.int32)
    return result


def patches_of(surface: Surface, labels: Ints32) -> Patches:
    """Means, normals and areas of labelled pixels, each pixel weighing its surface area.

    Parameters
    ----------
    surface : (h, w)
    labels : (h, w) int32, 0 to P - 1; -1 for none

    Returns
    -------
    patches : P of them, in the order of the labels
    """
    n = int(labels.max(initial=-1)) + 1
    sums = _sums(surface.points, surface.normals, surface.areas, labels, n)
    area = sums[:, 0]
    normal = sums[:, 4:7]
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    return Patches(
        means=sums[:, 1:4] / area[:, None],
        normals=normal / length,
        areas=area,
        sizes=sums[:, 7].astype(np.int32),
        coherences=np.minimum(length[:, 0] / area, 1.0),
    )


# Sec. III-F, hierarchy: the finest patches to H levels, each fewer by a constant factor.
#
#     Surface, labels (h, w)  --hierarchy-->  Hierarchy (H levels)
#
# Agglomerative K-Means over the finest patches in position and normal, weighted by area,
# seeded near-uniformly over the surface by farthest-point sampling.


@dataclass(frozen=True)
class HierarchyParameters:
    """The numbers of the hierarchy."""

    n_levels: int = 4  #: H
    factor: float = 2.0**0.5  #: each level has fewer patches by this factor
    iterations: int = 4  #: of K-Means
    normal_weight: float = 3.0  #: of 1 - cos(normals), beside squared patch diameters


@disjoint_kernel
def _nearer(
    patches: Floats, centre: Floats, scale: float, weight: float, c: int,
    nearest: Floats, labels: Ints32,
) -> None:  # fmt: skip
    """Move to cluster `c` all patches that are nearer to its centre than to their own."""
    x, y, z, nx, ny, nz = (
        patches[0], patches[1], patches[2], patches[3], patches[4], patches[5]
    )  # fmt: skip
    for k in range(len(labels)):
        dx, dy, dz = x[k] - centre[0], y[k] - centre[1], z[k] - centre[2]
        cosine = nx[k] * centre[3] + ny[k] * centre[4] + nz[k] * centre[5]
        distance = (dx * dx + dy * dy + dz * dz) * scale + weight * (1.0 - cosine)
        labels[k] = np.int32(c) if distance < nearest[k] else labels[k]
        nearest[k] = min(distance, nearest[k])


@kernel
def _k_means(
    patches: Floats, areas: Floats, n_clusters: int, scale: float, weight: float, iterations: int
) -> Ints32:
    """Labels of (6, P) positions and normals; clusters that end empty are numbered still."""
    n = patches.shape[1]
    centres = np.empty((n_clusters, 6))
    nearest = np.full(n, np.inf)
    labels = np.zeros(n, np.int32)
    chosen = int(np.argmax(areas))
    for c in range(n_clusters):  # farthest-point sampling
        centres[c] = patches[:, chosen]
        _nearer(patches, centres[c], scale, weight, c, nearest, labels)
        chosen = int(np.argmax(nearest))
    for _ in range(iterations):
        sums = np.zeros((n_clusters, 7))
        for k in range(n):
            for d in range(6):
                sums[labels[k], d] += areas[k] * patches[d, k]
            sums[labels[k], 6] += areas[k]
        nearest[:] = np.inf
        for c in range(n_clusters):
            if sums[c, 6] > 0:
                length = np.sqrt(sums[c, 3] ** 2 + sums[c, 4] ** 2 + sums[c, 5] ** 2)
                for d in range(3):
                    centres[c, d] = sums[c, d] / sums[c, 6]
                    if length > 1e-9:
                        centres[c, 3 + d] = sums[c, 3 + d] / length
            _nearer(patches, centres[c], scale, weight, c, nearest, labels)
    return labels


def _coarser(patches: Patches, n_clusters: int, p: HierarchyParameters) -> Ints32:
    """Index of each patch's parent among at most `n_clusters`, numbered without gaps."""
    scale = n_clusters / float(patches.areas.sum())
    joined = np.ascontiguousarray(np.concatenate([patches.means, patches.normals], axis=1).T)
    labels = _k_means(joined, patches.areas, n_clusters, scale, p.normal_weight, p.iterations)
    _, parents = np.unique(labels, return_inverse=True)
    numbered: Ints32 = parents.astype(np.int32)
    return numbered


def hierarchy(surface: Surface, finest: Ints32, p: HierarchyParameters) -> Hierarchy:
    """The levels {X_h}: every level is clustered from the finest patches.

    Parameters
    ----------
    surface : (h, w) points in metres and normals
    finest : (h, w) int32 labels of the finest level
    p : see HierarchyParameters

    Returns
    -------
    hierarchy : `n_levels` levels, finest first; each holds 1 / factor of the patches of the
        one before it, and never fewer than one
    """
    levels, labels = [patches_of(surface, finest)], [finest]
    for h in range(1, p.n_levels):
        n_clusters = max(round(len(levels[0]) / p.factor**h), 1)
        parents = _coarser(levels[0], n_clusters, p)
        coarse = np.where(finest >= 0, parents[finest], -1).astype(np.int32)
        levels.append(patches_of(surface, coarse))
        labels.append(coarse)
    return Hierarchy(tuple(levels), tuple(labels))


# How much a patch has to say: size and flatness to a weight, and of two patches to a pair's.
#
#     Patches (P)  --patch_weights-->  (P,)
#
# The paper counts every pair once. Then where the segmentation happens to cut decides how much
# a surface counts, and a chair's leg, whose one patch bends round it, counts like a square of
# floor. Weighting by size makes the statistics depend on the surface rather than on its cuts;
# weighting by coherence keeps normals that are means of unlike normals from being believed.


@dataclass(frozen=True)
class WeightParameters:
    """The numbers of the weights; both 0 give the paper's equal pairs."""

    size_exponent: float = 0.5  #: of the share of the image that a patch covers
    coherence_exponent: float = 20.0  #: of the length of the mean of its pixels' normals


def patch_weights(patches: Patches, p: WeightParameters) -> Floats:
    """Weight of each patch; a pair weighs the product of its two.

    Parameters
    ----------
    patches : P of them
    p : see WeightParameters

    Returns
    -------
    weights : (P,) positive, of mean 1
    """
    weights = patches.sizes**p.size_exponent * patches.coherences**p.coherence_exponent
    result: Floats = weights / weights.mean()
    return result


# Segmentation of clouds.

#: Depth of a seed's cell, in its width: surfaces seen at a slant are one cell still.
_DEPTH = 4.0
#: Least size of a patch, as a share of its seed's cell: seeds set wider end with no patch.
_LEAST = 1e-3
#: Rounds of growth before centres move: a patch may grow by so many voxels.
_GROWTH = 2


@kernel
def _seed_cells(
    points: Floats32, axes: Floats, centre: Floats, unit: float, spacing: float, cells: Ints64
) -> None:
    """Cell of each point: about a viewpoint of directions and range in `unit`; 0 for none."""
    for i in range(len(points)):
        px, py, pz = points[i, 0] - centre[0], points[i, 1] - centre[1], points[i, 2] - centre[2]
        x = axes[0, 0] * px + axes[0, 1] * py + axes[0, 2] * pz
        y = axes[1, 0] * px + axes[1, 1] * py + axes[1, 2] * pz
        z = axes[2, 0] * px + axes[2, 1] * py + axes[2, 2] * pz
        if unit > 0:
            r = np.sqrt(px * px + py * py + pz * pz)
            shell = int(np.floor(np.log(r / unit) / (_DEPTH * spacing))) + 4096
            cells[i] = direction_cell(x, y, z, spacing) * 8192 + min(max(shell, 0), 8191)
        else:
            cells[i] = metric_cell(x, y, z, spacing)


@kernel
def _centre_of(
    points: Floats32, normals: Floats32, sides: Floats32, labels: Ints32, spacing: float,
    sums: Floats,
) -> None:  # fmt: skip
    """Per label: mean point (3), unit mean normal (3), 1 / spacing^2 in metres; 0 where dead.

    spacing: in sides of a voxel.
    """
    sums[:] = 0.0
    for i in range(len(labels)):
        k = labels[i]
        for d in range(3):
            sums[k, d] += points[i, d]
            sums[k, 3 + d] += normals[i, d]
        sums[k, 6] += sides[i]
        sums[k, 7] += 1.0
    for k in range(len(sums)):
        n = sums[k, 7]
        length = np.sqrt(sums[k, 3] ** 2 + sums[k, 4] ** 2 + sums[k, 5] ** 2)
        if n == 0 or length < 1e-6 * n:
            sums[k, 6] = 0.0
            continue
        for d in range(3):
            sums[k, d] /= n
            sums[k, 3 + d] /= length
        metric = spacing * sums[k, 6] / n
        sums[k, 6] = 1.0 / (metric * metric)


@kernel
def _grow(
    points: Floats32, normals: Floats32, offsets: Ints64, indices: Ints32, centres: Floats,
    normal_weight: float, labels: Ints32, out: Ints32,
) -> None:  # fmt: skip
    """Give every voxel the nearest centre among its own and those of the voxels it touches."""
    for i in range(len(labels)):
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        nx, ny, nz = normals[i, 0], normals[i, 1], normals[i, 2]
        best, chosen, last = np.inf, labels[i], -1
        for m in range(offsets[i] - 1, offsets[i + 1]):
            k = labels[i] if m < offsets[i] else labels[indices[m]]
            if k == last or centres[k, 6] <= 0:
                continue
            if m >= offsets[i] and k == labels[i]:
                continue
            last = k
            dx, dy, dz = px - centres[k, 0], py - centres[k, 1], pz - centres[k, 2]
            cosine = nx * centres[k, 3] + ny * centres[k, 4] + nz * centres[k, 5]
            distance = (dx * dx + dy * dy + dz * dz) * centres[k, 6]
            distance += normal_weight * (1.0 - cosine)
            if distance < best or (distance == best and k < chosen):
                best, chosen = distance, k
        out[i] = chosen


@kernel
def _components(offsets: Ints64, indices: Ints32, labels: Ints32, parts: Ints32) -> int:
    """Number the connected parts of each label, in the order of their first voxels."""
    stack = np.empty(len(labels), np.int32)
    parts[:] = -1
    n = 0
    for first in range(len(labels)):
        if parts[first] >= 0:
            continue
        parts[first] = n
        stack[0], height = first, 1
        while height > 0:
            height -= 1
            i = stack[height]
            for m in range(offsets[i], offsets[i + 1]):
                j = indices[m]
                if parts[j] < 0 and labels[j] == labels[i]:
                    parts[j] = n
                    stack[height] = j
                    height += 1
        n += 1
    return n


def supervoxels(seen: Voxels, spacing: float, most: int, p: SegmentationParameters) -> Ints32:
    """Assign voxels to patches.

    Parameters
    ----------
    seen : V voxels
    spacing : of the seeds, in sides of a voxel
    most : patches; seeds are set wider until there are no more
    p : its iterations, weight of normals and limits of size

    Returns
    -------
    labels : (1, V) int32, 0 to P - 1; -1 for voxels in patches below either limit of size
    """
    if not len(seen.sides):
        return np.empty((1, 0), np.int32)
    while True:
        least = max(p.minimum_pixels, max(_LEAST, p.minimum_size) * spacing * spacing)
        seeds = _seeds(seen, spacing)
        n = int(np.count_nonzero(np.bincount(seeds) >= least))
        if n <= most:
            labels, n = _grown(seen, seeds, spacing, least, p)
            if n <= most:
                return labels[None]
        spacing *= 1.03 * (n / most) ** 0.85  # patches on surfaces at a slant are long


def _seeds(seen: Voxels, spacing: float) -> Ints32:
    """The seed that each voxel begins with (V,): that of its cell in a grid."""
    side, unit = float(np.median(seen.sides)), 0.0
    if seen.cloud.has_viewpoint:
        at = seen.points[0] - seen.centre
        ranges = np.sqrt((at * at).sum(axis=1))
        side, unit = float(np.median(seen.sides / ranges)), float(np.median(ranges))
    cells = np.empty(len(seen.sides), np.int64)
    _seed_cells(seen.points[0], seen.axes, seen.centre, unit, spacing * side, cells)
    _, first = np.unique(cells, return_inverse=True)
    return first.astype(np.int32)


def _grown(
    seen: Voxels, labels: Ints32, spacing: float, least: float, p: SegmentationParameters
) -> tuple[Ints32, int]:
    """Labels (V,) of the patches grown from seeds so far apart, and how many there are."""
    points, normals, links = seen.points[0], seen.normals[0], seen.links
    centres = np.zeros((int(labels.max(initial=-1)) + 1, 8))
    grown = labels.copy()
    for _ in range(p.iterations):
        _centre_of(points, normals, seen.sides, labels, spacing, centres)
        for _ in range(_GROWTH):
            _grow(
                points, normals, links.offsets, links.indices, centres, p.normal_weight,
                labels, grown,
            )  # fmt: skip
            labels, grown = grown, labels
    parts = np.empty(len(labels), np.int32)
    n = _components(links.offsets, links.indices, labels, parts)
    sizes = np.bincount(parts, minlength=n)
    keep = sizes >= least
    renumbered = np.where(keep, np.cumsum(keep) - 1, -1).astype(np.int32)
    return renumbered[parts], int(keep.sum())
