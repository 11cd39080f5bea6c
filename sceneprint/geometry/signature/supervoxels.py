"""Sec. III-F, segmentation of clouds: voxels to smooth, compact patches that respect edges.

    Voxels (V)  --supervoxels-->  labels (1, V)  --patches_of-->  Patches (P)

After VCCS (Papon 2013): seeds on a grid, grown from voxel to voxel that touch, by position and
normal; so a patch ends at creases and never crosses a gap. As in `segmentation.py` the distance
is that of k-means in position and normal, and centres follow their patches.
"""

from __future__ import annotations

import numpy as np

from sceneprint.geometry.kernel import kernel
from sceneprint.geometry.signature.segmentation import SegmentationParameters
from sceneprint.geometry.surface.cloud import Ints64, direction_cell, metric_cell
from sceneprint.geometry.surface.voxels import Voxels
from sceneprint.types import Floats, Floats32, Ints32

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
