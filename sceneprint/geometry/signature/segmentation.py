"""Segmentation of a surface into smooth, compact patches, and their hierarchy (Sec. III-F).

    Surface (h, w)  --segment-->      labels (h, w)  --extract_patches-->  Patches (P)
    Voxels (V)      --supervoxels-->  labels (1, V)  --extract_patches-->  Patches (P)
    Surface, labels (h, w)  --hierarchy-->  Hierarchy (H levels)
    Patches (P)  --patch_weights-->  (P,)

Images are segmented by SLIC over position and normal, starting from a grid. The distance has no
pixel term, so patches end at both creases and depth edges.

Clouds are segmented by a variant of VCCS (Papon 2013): patches grow from seeds on a grid over
touching voxels, by position and normal. They end at creases and do not cross gaps. Unlike in VCCS,
the distance is that of k-means, and centres move with their patches.

The hierarchy is an agglomerative K-Means over the positions and normals of the finest patches,
weighted by area. Farthest-point sampling distributes its seeds evenly over the surface.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from sceneprint.geometry.kernel import disjoint_kernel, kernel
from sceneprint.geometry.surface.cloud import Ints64, direction_cell, metric_cell
from sceneprint.geometry.surface.voxels import Voxels
from sceneprint.types import Floats, Floats32, Hierarchy, Intrinsics, Ints32, Patches, Surface


@dataclass(frozen=True)
class SegmentationParameters:
    """Parameters of the finest segmentation."""

    n_patches: int = 1000  #: number of seeds on the grid of a full image
    iterations: int = 5  #: number of rounds of assignment and update
    normal_weight: float = 6.0  #: weight of 1 - cos(normals), relative to squared seed spacings
    minimum_size: float = 0.15  #: patches smaller than this share of a grid cell are dropped
    minimum_pixels: int = 4  #: patches with fewer pixels are dropped


@kernel
def _spread_centres(
    centres: Floats32, row: int, shift: int, cells: Ints32, columns: int, out: Floats32
) -> None:
    """Write to `out` (7, w) the centre `shift` cells beside each pixel of a cell row; 0 outside."""
    for x in range(len(cells)):
        column = cells[x] + shift
        if row < 0 or row * columns >= len(centres) or column < 0 or column >= columns:
            out[6, x] = 0.0
            continue
        for d in range(7):
            out[d, x] = centres[row * columns + column, d]


@disjoint_kernel
def _assign_row(
    pixels: Floats32, y: int, centres: Floats32, normal_weight: np.float32, k: np.int32,
    cells: Ints32, labels: Ints32, nearest: Floats32,
) -> None:  # fmt: skip
    """Assign the pixels of a row to the centres (7, w) beside them if those are nearer.

    Unused centres get no pixels. `k` is the index of the centre beside the pixels of the first
    cell.
    """
    px, py, pz = pixels[0, y], pixels[1, y], pixels[2, y]
    nx, ny, nz = pixels[3, y], pixels[4, y], pixels[5, y]
    cx, cy, cz, mx, my, mz = (
        centres[0], centres[1], centres[2], centres[3], centres[4], centres[5]
    )  # fmt: skip
    scale = centres[6]  # (1 / metric seed spacing)^2; 0 for an unused centre
    for x in range(len(labels)):
        dx, dy, dz = px[x] - cx[x], py[x] - cy[x], pz[x] - cz[x]
        cosine = nx[x] * mx[x] + ny[x] * my[x] + nz[x] * mz[x]
        distance = (dx * dx + dy * dy + dz * dz) * scale[x] + normal_weight * (
            np.float32(1.0) - cosine
        )
        distance = distance if scale[x] > 0 else np.float32(np.inf)
        labels[x] = k + cells[x] if distance < nearest[x] else labels[x]
        nearest[x] = min(distance, nearest[x])


@kernel
def _assign(
    pixels: Floats32, valid: NDArray[np.bool_], centres: Floats32, spacing: float,
    normal_weight: np.float32, columns: int, labels: Ints32,
) -> None:  # fmt: skip
    """Assign each pixel of (6, h, w) to the nearest of the centres of the nine cells around it.

    Centres are copied to the pixels once per row of cells, so that a loop over the pixels of a row
    can be vectorized.
    """
    height, width = valid.shape
    rows = len(centres) // columns
    cells = np.empty(width, np.int32)
    for x in range(width):
        cells[x] = min(int(x / spacing), columns - 1)
    around = np.zeros((3, 3, 7, width), np.float32)  # three rows of cells, indexed by row modulo 3
    nearest = np.empty(width, np.float32)
    cell, spread = -1, -2
    for y in range(height):
        if min(int(y / spacing), rows - 1) != cell:
            cell = min(int(y / spacing), rows - 1)
            for row in range(spread + 1, cell + 2):
                for n in range(3):
                    _spread_centres(centres, row, n - 1, cells, columns, around[row % 3, n])
            spread = cell + 1
        nearest[:] = np.inf
        own = labels[y]
        for x in range(width):
            own[x] = -1
        for n in range(9):
            row, shift = cell + n // 3 - 1, n % 3
            k = np.int32(row * columns + shift - 1)
            _assign_row(pixels, y, around[row % 3, shift], normal_weight, k, cells, own, nearest)
        for x in range(width):
            own[x] = own[x] if valid[y, x] else -1


@kernel
def _sums(
    points: Floats32, normals: Floats32, weights: Floats32, labels: Ints32, n: int
) -> NDArray[np.float64]:
    """Return (n, 8) sums per label: weights, weighted points, weighted normals, and pixels."""
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


@kernel
def _centres(sums: Floats, spacing: float, focal_length: float, centres: Floats32) -> None:
    """Write each label's mean point, mean normal and (1 / metric seed spacing)^2, (n, 7)."""
    for k in range(len(sums)):
        alive = sums[k, 0] > 0
        weight = sums[k, 0] if alive else 1.0
        x, y, z = sums[k, 1] / weight, sums[k, 2] / weight, sums[k, 3] / weight
        nx, ny, nz = sums[k, 4] / weight, sums[k, 5] / weight, sums[k, 6] / weight
        length = np.sqrt(nx * nx + ny * ny + nz * nz)
        alive = alive and length > 1e-6
        scale = focal_length / (spacing * z) if alive else 0.0
        length = length if alive else 1.0
        centres[k, 0], centres[k, 1], centres[k, 2] = x, y, z
        centres[k, 3], centres[k, 4], centres[k, 5] = nx / length, ny / length, nz / length
        centres[k, 6] = scale * scale


@lru_cache(maxsize=8)
def _seed_grid(height: int, width: int, n_patches: int) -> tuple[Ints32, float, int]:
    """Return each pixel's cell (h, w), the spacing in pixels, and the number of cells in a row."""
    spacing = max(math.sqrt(height * width / n_patches), 1.0)
    rows, columns = max(round(height / spacing), 1), max(round(width / spacing), 1)
    y, x = np.mgrid[:height, :width]
    cell_y = np.minimum((y / spacing).astype(np.int32), rows - 1)
    cell_x = np.minimum((x / spacing).astype(np.int32), columns - 1)
    cells: Ints32 = (cell_y * columns + cell_x).astype(np.int32)
    cells.flags.writeable = False
    return cells, spacing, columns


def segment(surface: Surface, p: SegmentationParameters) -> Ints32:
    """Assign valid pixels to patches.

    Patches smaller than either limit are dropped: their normals would be noise, and in an image
    with a thousand patches they cover less than 1 % of the surface.

    Parameters
    ----------
    surface : (h, w) points in metres and normals

    Returns
    -------
    labels : (h, w) int32, 0 to P - 1 in the order of occurrence in the image; -1 for pixels
        without a patch
    """
    height, width = surface.valid.shape
    assert isinstance(surface.camera, Intrinsics)
    cells, spacing, columns = _seed_grid(height, width, p.n_patches)
    focal_length = math.sqrt(surface.camera.fx * surface.camera.fy)
    labels: Ints32 = np.where(surface.valid, cells, np.int32(-1))
    ones = np.ones((height, width), np.float32)
    n = int(cells[-1, -1]) + 1
    pixels = np.concatenate([surface.points, surface.normals], axis=2).transpose(2, 0, 1)
    pixels = np.ascontiguousarray(pixels)
    centres = np.empty((n, 7), np.float32)
    for _ in range(p.iterations):
        sums = _sums(surface.points, surface.normals, ones, labels, n)
        _centres(sums, spacing, focal_length, centres)
        _assign(
            pixels, surface.valid, centres, spacing, np.float32(p.normal_weight), columns, labels
        )
    smallest = max(p.minimum_pixels, p.minimum_size * spacing * spacing)
    return compact_labels(labels, np.bincount(labels[labels >= 0], minlength=n) >= smallest)


def compact_labels(labels: Ints32, keep: NDArray[np.bool_]) -> Ints32:
    """Renumber the labels (h, w) selected by `keep` (n,) without gaps; others become -1."""
    renumbered = np.where(keep, np.cumsum(keep) - 1, -1).astype(np.int32)
    result: Ints32 = np.where(labels >= 0, renumbered[labels], -1).astype(np.int32)
    return result


def extract_patches(surface: Surface, labels: Ints32) -> Patches:
    """Compute the patches of labelled pixels, with means weighted by surface area.

    Parameters
    ----------
    surface : (h, w) points and normals
    labels : (h, w) int32, 0 to P - 1; -1 for pixels without a patch

    Returns
    -------
    patches : P patches in the order of the labels
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


@dataclass(frozen=True)
class HierarchyParameters:
    """Parameters of the hierarchy."""

    n_levels: int = 4  #: number of levels, H
    factor: float = 2.0**0.5  #: ratio of the patch counts of successive levels
    iterations: int = 4  #: number of iterations of K-Means
    normal_weight: float = 3.0  #: weight of 1 - cos(normals), relative to squared patch diameters


#: Number of consecutive patches that are compared with a centre, or skipped, as a block.
_BLOCK = 8


@disjoint_kernel
def _move_nearer(
    patches: Floats, centre: Floats, scale: float, weight: float, c: int, first: int, last: int,
    nearest: Floats, labels: Ints32,
) -> None:  # fmt: skip
    """Move patches to cluster `c` if its centre is nearer than their current centre."""
    x, y, z, nx, ny, nz = (
        patches[0], patches[1], patches[2], patches[3], patches[4], patches[5]
    )  # fmt: skip
    for k in range(first, last):
        dx, dy, dz = x[k] - centre[0], y[k] - centre[1], z[k] - centre[2]
        cosine = nx[k] * centre[3] + ny[k] * centre[4] + nz[k] * centre[5]
        distance = (dx * dx + dy * dy + dz * dz) * scale + weight * (1.0 - cosine)
        labels[k] = np.int32(c) if distance < nearest[k] else labels[k]
        nearest[k] = min(distance, nearest[k])


@kernel
def _boxes(patches: Floats, boxes: Floats) -> float:
    """Write the bounding boxes (6, n) of blocks of patches; return the largest normal length."""
    longest = 0.0
    boxes[:3], boxes[3:] = np.inf, -np.inf
    for k in range(patches.shape[1]):
        b = k // _BLOCK
        for d in range(3):
            boxes[d, b] = min(boxes[d, b], patches[d, k])
            boxes[3 + d, b] = max(boxes[3 + d, b], patches[d, k])
        squared = patches[3, k] ** 2 + patches[4, k] ** 2 + patches[5, k] ** 2
        longest = max(longest, np.sqrt(squared))
    return longest


@disjoint_kernel
def _least_distances(
    boxes: Floats, centre: Floats, scale: float, weight: float, longest: float, least: Floats
) -> None:
    """Write lower bounds on the blocks' distances from a centre that allow for rounding errors."""
    cosine = longest * np.sqrt(centre[3] ** 2 + centre[4] ** 2 + centre[5] ** 2)
    of_normals = weight * (1.0 - cosine) - 1e-9 * abs(weight) * (1.0 + cosine)
    shrunk = scale * (1.0 - 1e-9)
    for b in range(len(least)):
        dx = max(max(boxes[0, b] - centre[0], centre[0] - boxes[3, b]), 0.0)
        dy = max(max(boxes[1, b] - centre[1], centre[1] - boxes[4, b]), 0.0)
        dz = max(max(boxes[2, b] - centre[2], centre[2] - boxes[5, b]), 0.0)
        least[b] = (dx * dx + dy * dy + dz * dz) * shrunk + of_normals


@kernel
def _maximum(values: Floats, first: int, last: int) -> float:
    largest: float = values[first]
    for k in range(first + 1, last):
        largest = max(largest, values[k])
    return largest


@kernel
def _seed(
    patches: Floats, areas: Floats, boxes: Floats, longest: float, scale: float, weight: float,
    centres: Floats, labels: Ints32,
) -> None:  # fmt: skip
    """Select centres by farthest-point sampling from the largest patch; label each patch."""
    n, n_blocks = len(labels), boxes.shape[1]
    nearest, farthest = np.full(n, np.inf), np.full(n_blocks, np.inf)
    least = np.empty(n_blocks)
    chosen = int(np.argmax(areas))
    for c in range(len(centres)):
        centres[c] = patches[:, chosen]
        _least_distances(boxes, centres[c], scale, weight, longest, least)
        for b in range(n_blocks):
            if least[b] < farthest[b]:
                first, last = b * _BLOCK, min((b + 1) * _BLOCK, n)
                _move_nearer(patches, centres[c], scale, weight, c, first, last, nearest, labels)
                farthest[b] = _maximum(nearest, first, last)
        worst = int(np.argmax(farthest))
        chosen, last = worst * _BLOCK, min((worst + 1) * _BLOCK, n)
        while chosen < last - 1 and nearest[chosen] != farthest[worst]:
            chosen += 1


@kernel
def _reassign(
    patches: Floats, boxes: Floats, longest: float, scale: float, weight: float, centres: Floats,
    labels: Ints32,
) -> None:  # fmt: skip
    """Assign each patch to the nearest centre, or to the first of several that are equally near.

    The distance to the current centre is an upper bound. Therefore, a block of patches is compared
    only with centres whose lower bound does not exceed it.
    """
    n, n_blocks = len(labels), boxes.shape[1]
    nearest, farthest, least = np.empty(n), np.empty(n_blocks), np.empty(n_blocks)
    for k in range(n):
        nearest[k] = np.inf
        _move_nearer(
            patches, centres[labels[k]], scale, weight, labels[k], k, k + 1, nearest, labels
        )
    for b in range(n_blocks):
        farthest[b] = _maximum(nearest, b * _BLOCK, min((b + 1) * _BLOCK, n))
    nearest[:] = np.inf
    for c in range(len(centres)):
        _least_distances(boxes, centres[c], scale, weight, longest, least)
        for b in range(n_blocks):
            if least[b] <= farthest[b]:
                first, last = b * _BLOCK, min((b + 1) * _BLOCK, n)
                _move_nearer(patches, centres[c], scale, weight, c, first, last, nearest, labels)


@kernel
def _k_means(
    patches: Floats, areas: Floats, n_clusters: int, scale: float, weight: float, iterations: int
) -> Ints32:
    """Cluster positions and normals (6, P); return labels without gaps for empty clusters.

    Bounds for blocks of neighbouring patches make 95 % of the distances unnecessary.
    """
    n = patches.shape[1]
    centres, labels = np.empty((n_clusters, 6)), np.zeros(n, np.int32)
    boxes = np.empty((6, (n + _BLOCK - 1) // _BLOCK))
    longest = _boxes(patches, boxes)
    _seed(patches, areas, boxes, longest, scale, weight, centres, labels)
    for _ in range(iterations):
        sums = np.zeros((n_clusters, 7))
        for k in range(n):
            for d in range(6):
                sums[labels[k], d] += areas[k] * patches[d, k]
            sums[labels[k], 6] += areas[k]
        for c in range(n_clusters):
            if sums[c, 6] > 0:
                length = np.sqrt(sums[c, 3] ** 2 + sums[c, 4] ** 2 + sums[c, 5] ** 2)
                for d in range(3):
                    centres[c, d] = sums[c, d] / sums[c, 6]
                    if length > 1e-9:
                        centres[c, 3 + d] = sums[c, 3 + d] / length
        _reassign(patches, boxes, longest, scale, weight, centres, labels)
    return labels


def _cluster(patches: Patches, n_clusters: int, p: HierarchyParameters) -> Ints32:
    """Cluster patches; return the label of each, numbered without gaps and below `n_clusters`."""
    scale = n_clusters / float(patches.areas.sum())
    columns = np.ascontiguousarray(np.concatenate([patches.means, patches.normals], axis=1).T)
    labels = _k_means(columns, patches.areas, n_clusters, scale, p.normal_weight, p.iterations)
    _, parents = np.unique(labels, return_inverse=True)
    numbered: Ints32 = parents.astype(np.int32)
    return numbered


def hierarchy(surface: Surface, finest: Ints32, p: HierarchyParameters) -> Hierarchy:
    """Compute the levels {X_h}, each by clustering the finest patches.

    Parameters
    ----------
    surface : (h, w) points in metres and normals
    finest : (h, w) int32 labels of the finest level

    Returns
    -------
    hierarchy : `n_levels` levels, finest first; a level has 1 / factor as many patches as the
        previous level, but at least one
    """
    levels, labels = [extract_patches(surface, finest)], [finest]
    for h in range(1, p.n_levels):
        n_clusters = max(round(len(levels[0]) / p.factor**h), 1)
        parents = _cluster(levels[0], n_clusters, p)
        coarse = np.where(finest >= 0, parents[finest], -1).astype(np.int32)
        levels.append(extract_patches(surface, coarse))
        labels.append(coarse)
    return Hierarchy(tuple(levels), tuple(labels))


@dataclass(frozen=True)
class WeightParameters:
    """Parameters of patch weights; zeros give all pairs the same weight, as in the paper.

    The paper counts all pairs equally, so the weight of a surface depends on its segmentation, and
    a patch around a chair leg counts as much as a patch of floor. Weights by size make the
    statistics depend on the surface instead; weights by coherence reduce the influence of curved
    patches.
    """

    size_exponent: float = 0.5  #: exponent of a patch's share of the image
    coherence_exponent: float = 20.0  #: exponent of the length of a patch's mean normal


def patch_weights(patches: Patches, p: WeightParameters) -> Floats:
    """Return positive weights (P,) of patches, with mean 1. A pair's weight is their product."""
    weights = patches.sizes**p.size_exponent * patches.coherences**p.coherence_exponent
    result: Floats = weights / weights.mean()
    return result


#: Ratio of depth to width of a seed's cell; it exceeds 1 so that a slanted surface lies in one
#: cell.
_DEPTH = 4.0
#: Minimum size of a patch as a share of its seed's cell; it guarantees that some spacing suffices.
_LEAST = 1e-3
#: Number of growth rounds, each by one voxel, between updates of the centres.
_GROWTH = 2


@kernel
def _seed_cells(
    points: Floats32, axes: Floats, centre: Floats, unit: float, spacing: float, cells: Ints64
) -> None:
    """Write each point's cell, by direction and range / `unit`; by position if `unit` is 0."""
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
def _voxel_centres(
    points: Floats32, normals: Floats32, sides: Floats32, labels: Ints32, spacing: float,
    sums: Floats,
) -> None:  # fmt: skip
    """Write each label's mean point, unit mean normal and 1 / spacing^2 to (n, 7); 0 if unused.

    The argument `spacing` is in voxel sides; the written spacing is in metres.
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
    """Assign each voxel to the nearest of its own centre and the centres of touching voxels."""
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
    """Number the connected parts of all labels, ordered by first voxel; return the count."""
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
    spacing : distance between the seeds, in voxel sides
    most : maximum number of patches; the spacing grows until there are no more
    p : parameters of the segmentation

    Returns
    -------
    labels : (1, V) int32, 0 to P - 1; -1 for voxels in patches that are too small
    """
    if not len(seen.sides):
        return np.empty((1, 0), np.int32)
    while True:
        least = max(p.minimum_pixels, max(_LEAST, p.minimum_size) * spacing * spacing)
        seeds = _seeds(seen, spacing)
        n = int(np.count_nonzero(np.bincount(seeds) >= least))
        if n <= most:
            labels, n = _grow_patches(seen, seeds, spacing, least, p)
            if n <= most:
                return labels[None]
        spacing *= 1.03 * (n / most) ** 0.85  # sqrt is too slow for long, slanted patches


def _seeds(seen: Voxels, spacing: float) -> Ints32:
    """Return the seed (V,) of each voxel: the number of its cell in a grid."""
    side, unit = float(np.median(seen.sides)), 0.0
    if seen.cloud.has_viewpoint:
        at = seen.points[0] - seen.centre
        ranges = np.sqrt((at * at).sum(axis=1))
        side, unit = float(np.median(seen.sides / ranges)), float(np.median(ranges))
    cells = np.empty(len(seen.sides), np.int64)
    _seed_cells(seen.points[0], seen.axes, seen.centre, unit, spacing * side, cells)
    _, first = np.unique(cells, return_inverse=True)
    return first.astype(np.int32)


def _grow_patches(
    seen: Voxels, labels: Ints32, spacing: float, least: float, p: SegmentationParameters
) -> tuple[Ints32, int]:
    """Grow patches and drop those below `least` voxels; return labels (V,) and the patch count."""
    points, normals, links = seen.points[0], seen.normals[0], seen.links
    centres = np.zeros((int(labels.max(initial=-1)) + 1, 8))
    grown = labels.copy()
    for _ in range(p.iterations):
        _voxel_centres(points, normals, seen.sides, labels, spacing, centres)
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
