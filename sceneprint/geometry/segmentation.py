"""Sec. III-F, segmentation: a surface map to smooth, compact patches that respect edges.

    Surface (h, w)  --segment-->  labels (h, w)  --patches_of-->  Patches (P)

SLIC over position and normal, started from a grid in the image. No pixel term: two pixels
belong together when their points are near and their normals agree, so that patches end at
creases and at depth edges alike.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneprint.geometry.kernel import kernel
from sceneprint.types import Floats32, Intrinsics, Ints32, Patches, Surface


@dataclass(frozen=True)
class SegmentationParameters:
    """The numbers of the finest segmentation."""

    n_patches: int = 1000  #: grid seeds of a full image
    iterations: int = 5  #: rounds of assignment and update
    normal_weight: float = 6.0  #: of 1 - cos(normals), beside squared seed spacings
    minimum_size: float = 0.15  #: patches below this share of a grid cell are dropped
    minimum_pixels: int = 4  #: and those below so many pixels


@kernel
def _assign(
    points: Floats32, normals: Floats32, valid: NDArray[np.bool_], centres: Floats32,
    spacing: float, normal_weight: np.float32, columns: int, labels: Ints32,
) -> None:  # fmt: skip
    """Give every pixel the nearest of the centres seeded in the nine cells around it."""
    height, width = valid.shape
    rows = len(centres) // columns
    for y in range(height):
        cell_y = min(int(y / spacing), rows - 1)
        for x in range(width):
            labels[y, x] = -1
            if not valid[y, x]:
                continue
            cell_x = min(int(x / spacing), columns - 1)
            px, py, pz = points[y, x, 0], points[y, x, 1], points[y, x, 2]
            nx, ny, nz = normals[y, x, 0], normals[y, x, 1], normals[y, x, 2]
            best = np.float32(np.inf)
            for cy in range(max(cell_y - 1, 0), min(cell_y + 2, rows)):
                for cx in range(max(cell_x - 1, 0), min(cell_x + 2, columns)):
                    k = cy * columns + cx
                    scale = centres[k, 6]  # (1 / metric seed spacing)^2; 0 for a dead centre
                    if scale <= 0:
                        continue
                    dx, dy, dz = px - centres[k, 0], py - centres[k, 1], pz - centres[k, 2]
                    cosine = nx * centres[k, 3] + ny * centres[k, 4] + nz * centres[k, 5]
                    distance = (dx * dx + dy * dy + dz * dz) * scale + normal_weight * (
                        np.float32(1.0) - cosine
                    )
                    if distance < best:
                        best = distance
                        labels[y, x] = k


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
    for _ in range(p.iterations):
        centres = _centres(
            _sums(surface.points, surface.normals, ones, labels, n), spacing, focal_length
        )
        _assign(
            surface.points, surface.normals, surface.valid, centres,
            spacing, np.float32(p.normal_weight), columns, labels,
        )  # fmt: skip
    smallest = max(p.minimum_pixels, p.minimum_size * spacing * spacing)
    return kept(labels, np.bincount(labels[labels >= 0], minlength=n) >= smallest)


def kept(labels: Ints32, keep: NDArray[np.bool_]) -> Ints32:
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
