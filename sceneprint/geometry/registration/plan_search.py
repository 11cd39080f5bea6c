"""Sec. III-E for scans: hypotheses of a transform from plan views, seen from above.

    Surface  --plan_of-->  ScanPlan        ScanPlan, ScanPlan  --plan_hypotheses-->  (n, 4, 4)

Two scans taken far apart share few patches whose surroundings look alike, so correspondences
propose no right transform. Their plans still fit: what stands upright is drawn, with its normals,
into an image seen from above, and one image is turned through all yaws and correlated with the
other. Floors, ceilings and tables give the height. The method is not the paper's.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneprint.geometry.kernel import kernel
from sceneprint.geometry.registration.overlap import one_of_each
from sceneprint.geometry.rigid import select_distinct
from sceneprint.types import Floats, Floats32, Ints32, Sphere, Surface

#: Normals this near a candidate speak for it as up; twice as much as one across it.
_ALONG, _ACROSS = math.cos(math.radians(6.0)), math.sin(math.radians(4.0))
#: While up is polished, normals this near to it or to level take part.
_NEAR, _LEVEL = math.cos(math.radians(8.0)), math.sin(math.radians(8.0))
#: Candidates for up, normals that vote on them, and steps that polish the best.
_MOST_CANDIDATES, _MOST_VOTERS, _POLISHES = 100, 1500, 8
#: Vertical component of the normal of a surface that heights, or azimuths, are counted of.
_FLAT, _UPRIGHT = 0.9, 0.5


@dataclass(frozen=True)
class PlanParameters:
    """The numbers of the search over plans; chosen on the hall: docs/clouds.md."""

    cell: float = 0.1  #: of the plan image, metres
    side: int = 128  #: of the plan image, cells
    voxel: float = 0.08  #: of which one point is drawn, metres
    tilt: float = math.radians(50.0)  #: most of up from the scanner's axis
    n_yaws: int = 72
    kept_yaws: int = 24  #: of which plans are correlated
    n_peaks: int = 6  #: shifts of each yaw
    n_kept: int = 50  #: of all together, that differ by two cells or one and a half yaws
    n_heights: int = 2  #: of each of these
    height_step: float = 0.05  #: of the histogram of heights, metres
    height_range: float = 3.0  #: of it each way, metres
    blur: float = 0.7  #: standard deviation, cells
    flat_weight: float = 0.3  #: of the vertical component beside the horizontal ones


@dataclass(frozen=True, eq=False)
class ScanPlan:
    """A scan as it is drawn from above.

    Parameters
    ----------
    R : (3, 3) R_level_sensor: rows are two level axes, then up
    points, normals : (N, 3) float32 each, one per voxel, along the level axes
    azimuths : (n_yaws,) how much upright surface faces each way
    heights : (2, n) how much surface that faces up, and down, is at each height
    """

    R: Floats
    points: Floats32
    normals: Floats32
    azimuths: Floats
    heights: Floats


#: Source and target, pair by pair.
Plans = list[tuple[ScanPlan, ScanPlan]]


def up_of(normals: Floats, axis: Floats, tilt: float) -> Floats:
    """The direction that most surface faces, or stands across.

    Parameters
    ----------
    normals : (N, 3)
    axis : (3,) unit vector
    tilt : most of the result from the axis, radians

    Returns
    -------
    (3,) unit vector, on the axis's side; the axis itself where no normal is near it
    """
    cosines = normals @ axis
    near = np.abs(cosines) > math.cos(tilt)
    candidates = np.where(cosines[near, None] < 0, -normals[near], normals[near])
    if not len(candidates):
        return axis
    candidates = candidates[:: max(len(candidates) // _MOST_CANDIDATES, 1)]
    votes = np.empty(len(candidates))
    _vote(normals[:: max(len(normals) // _MOST_VOTERS, 1)], candidates, _ALONG, _ACROSS, votes)
    up: Floats = candidates[int(np.argmax(votes))]
    spread = np.empty((3, 3))
    for _ in range(_POLISHES):
        _gather(normals, up, _NEAR, _LEVEL, spread)
        _, vectors = np.linalg.eigh(spread)
        up = vectors[:, -1] * math.copysign(1.0, float(vectors[:, -1] @ up))
    return up


@kernel
def _vote(normals: Floats, candidates: Floats, along: float, across: float, votes: Floats) -> None:
    """For each candidate: the normals along it, and half of those across it."""
    for k in range(len(candidates)):
        a, b, c = candidates[k, 0], candidates[k, 1], candidates[k, 2]
        total = 0.0
        for i in range(len(normals)):
            cosine = abs(normals[i, 0] * a + normals[i, 1] * b + normals[i, 2] * c)
            if cosine > along:
                total += 1.0
            elif cosine < across:
                total += 0.5
        votes[k] = total


@kernel
def _gather(normals: Floats, up: Floats, near: float, level: float, spread: Floats) -> None:
    """n n^T of the normals along a direction, less half of that of the normals across it."""
    spread[:] = 0.0
    for i in range(len(normals)):
        cosine = abs(normals[i, 0] * up[0] + normals[i, 1] * up[1] + normals[i, 2] * up[2])
        weight = 1.0 if cosine > near else (-0.5 if cosine < level else 0.0)
        if weight != 0.0:
            for a in range(3):
                for b in range(3):
                    spread[a, b] += weight * normals[i, a] * normals[i, b]


def plan_of(
    surface: Surface, p: PlanParameters, axis: Floats | None = None, up: Floats | None = None
) -> ScanPlan:
    """The plan of a scan.

    Parameters
    ----------
    surface : valid points; at least one
    axis : (3,) near which up is looked for; default: the axis that the scanner turns about
    up : (3,) unit vector in the scanner's coordinates, where it is known; it is taken as it is
    """
    shown = surface.fitted
    points = shown.points[shown.valid]
    kept = one_of_each(points, p.voxel)
    where, facing = points[kept].astype(float), shown.normals[shown.valid][kept].astype(float)
    if up is None:
        up = up_of(facing, axis_of(surface) if axis is None else axis, p.tilt)
    level = np.zeros(3)
    level[int(np.argmin(np.abs(up)))] = 1.0
    level -= (level @ up) * up
    level /= np.linalg.norm(level)
    R = np.stack([level, np.cross(up, level), up])
    where, facing = where @ R.T, facing @ R.T
    return ScanPlan(
        R, where.astype(np.float32), facing.astype(np.float32),
        _azimuths(facing, p.n_yaws), _heights(where, facing, p),
    )  # fmt: skip


def other_plans(source: Surface, target: Surface, p: PlanParameters) -> Plans:
    """Plans of two scans whose scanners stood otherwise than upright, pair by pair.

    Either the source was turned onto its side or upside down and the target was not, or both were
    mounted on their sides alike.
    """
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    usual_source, usual_target = axis_of(source), axis_of(target)
    plan, found = plan_of(target, p), []
    for axis in axes:
        if axis @ usual_source < 1:
            turned = plan_of(source, p, axis)
            found.append((turned, plan))
            if usual_source @ usual_target == 1 and axis @ usual_source == 0:
                found.append((turned, plan_of(target, p, axis)))
    return found


def axis_of(surface: Surface) -> Floats:
    """The axis that a scanner turns about, (3,), in its own coordinates; z where not known."""
    axis = np.zeros(3)
    axis[surface.camera.pole if isinstance(surface.camera, Sphere) else 2] = 1.0
    return axis


def _azimuths(normals: Floats, n_yaws: int) -> Floats:
    """How much upright surface faces each way (n_yaws,), as a root, so that no wall outdoes all."""
    upright = normals[np.abs(normals[:, 2]) < _UPRIGHT]
    turns = np.arctan2(upright[:, 1], upright[:, 0]) / (2 * math.pi) % 1.0
    counts = np.bincount((turns * n_yaws).astype(int) % n_yaws, minlength=n_yaws)
    root = np.sqrt(counts)
    result: Floats = root + np.roll(root, 1) + np.roll(root, -1)
    return result


def _heights(points: Floats, normals: Floats, p: PlanParameters) -> Floats:
    """How much surface that faces up, and down, is at each height: (2, n), as a root, smoothed."""
    n = 2 * round(p.height_range / p.height_step)
    rows = []
    for sign in (1.0, -1.0):
        heights = points[sign * normals[:, 2] > _FLAT, 2]
        bins = np.floor((heights + p.height_range) / p.height_step).astype(int)
        counts = np.bincount(bins[(bins >= 0) & (bins < n)], minlength=n)
        rows.append(np.convolve(np.sqrt(counts), (0.25, 0.5, 0.25), "same"))
    return np.stack(rows)


def _lifts(source: ScanPlan, target: ScanPlan, p: PlanParameters) -> list[float]:
    """Heights of the source's origin above the target's that lay flat surface on flat surface."""
    scores = sum(
        np.correlate(b, a, "full") for a, b in zip(source.heights, target.heights, strict=True)
    )
    scores, found = np.asarray(scores), []
    middle = source.heights.shape[1] - 1
    for _ in range(p.n_heights):
        best = int(np.argmax(scores))
        if scores[best] <= 0:
            break
        found.append((best - middle) * p.height_step)
        scores[max(best - 4, 0) : best + 5] = 0.0
    return found or [0.0]


@kernel
def _draw(
    points: Floats32, normals: Floats32, cosine: float, sine: float, cell: float, flat: float,
    image: Floats32,
) -> None:  # fmt: skip
    """Normals added up in an image (3, side, side), turned by a yaw, bilinearly."""
    side = image.shape[1]
    middle = 0.5 * side - 0.5
    for i in range(len(points)):
        column = (cosine * points[i, 0] - sine * points[i, 1]) / cell + middle
        line = (sine * points[i, 0] + cosine * points[i, 1]) / cell + middle
        u, v = int(np.floor(column)), int(np.floor(line))
        if u < 0 or v < 0 or u >= side - 1 or v >= side - 1:
            continue
        nx = cosine * normals[i, 0] - sine * normals[i, 1]
        ny = sine * normals[i, 0] + cosine * normals[i, 1]
        nz = flat * normals[i, 2]
        for b in range(2):
            for a in range(2):
                share = (column - u if a else u + 1 - column) * (line - v if b else v + 1 - line)
                image[0, v + b, u + a] += share * nx
                image[1, v + b, u + a] += share * ny
                image[2, v + b, u + a] += share * nz
    for v in range(side):  # the root of its length, so that no wall outdoes all
        for u in range(side):
            x, y, z = image[0, v, u], image[1, v, u], image[2, v, u]
            length = np.sqrt(x * x + y * y + z * z)
            if length > 0:
                for channel in range(3):
                    image[channel, v, u] /= np.sqrt(length)


@kernel
def _take_peaks(scores: Floats32, n: int, values: Floats, cells: Ints32) -> None:
    """The n greatest of a torus (side, side) that are three cells apart: values, (line, column)."""
    side = len(scores)
    for k in range(n):
        best, line, column = scores[0, 0], 0, 0
        for v in range(side):
            for u in range(side):
                if scores[v, u] > best:
                    best, line, column = scores[v, u], v, u
        values[k], cells[k, 0], cells[k, 1] = best, line, column
        for v in range(line - 2, line + 3):
            for u in range(column - 2, column + 3):
                scores[v % side, u % side] = -np.float32(np.inf)


def _spectrum(plan: ScanPlan, yaw: float, p: PlanParameters) -> NDArray[np.complex64]:
    """Fourier transform of a plan's image turned by a yaw: (3, side, side / 2 + 1)."""
    image = np.zeros((3, p.side, p.side), np.float32)
    _draw(plan.points, plan.normals, math.cos(yaw), math.sin(yaw), p.cell, p.flat_weight, image)
    return np.fft.rfft2(image).astype(np.complex64, copy=False)


def plan_hypotheses(plans: Plans, p: PlanParameters) -> Floats:
    """Transforms that lay the plan of one scan onto that of another, best first.

    Parameters
    ----------
    plans : of source and target, as often as there are guesses which way is up

    Returns
    -------
    (n, 4, 4) T_target_source; the same number whatever the number of plans
    """
    tried = [_laid(source, target, p) for source, target in plans]
    values = np.concatenate([value for _, value in tried])
    best = np.argsort(-values, kind="stable")[: p.n_kept * p.n_heights]
    found: Floats = np.concatenate([transforms for transforms, _ in tried])[best]
    return found


def _laid(source: ScanPlan, target: ScanPlan, p: PlanParameters) -> tuple[Floats, Floats]:
    """Transforms (n, 4, 4) that lay one plan onto the other, and their correlations."""
    yaws = np.arange(p.n_yaws)
    ways = [float(np.roll(source.azimuths, k) @ target.azimuths) for k in yaws]
    kept = np.argsort(-np.array(ways), kind="stable")[: p.kept_yaws]
    lines = np.fft.fftfreq(p.side)[:, None] ** 2 + np.fft.rfftfreq(p.side)[None] ** 2
    # both images are blurred: the square of a Gaussian's transform
    blurred = _spectrum(target, 0.0, p) * np.exp(-((2 * math.pi * p.blur) ** 2) * lines)
    blurred = blurred.astype(np.complex64)
    values = np.empty(len(kept) * p.n_peaks)
    cells = np.empty((len(values), 2), np.int32)
    for place, k in enumerate(kept):
        spectrum = _spectrum(source, 2 * math.pi * k / p.n_yaws, p)
        product = (blurred * spectrum.conj()).sum(axis=0)
        scores = np.fft.irfft2(product, s=(p.side, p.side)).astype(np.float32, copy=False)
        own = slice(place * p.n_peaks, (place + 1) * p.n_peaks)
        _take_peaks(scores, p.n_peaks, values[own], cells[own])
    flat = np.tile(np.eye(4), (len(values), 1, 1))
    angles = 2 * math.pi * np.repeat(kept, p.n_peaks) / p.n_yaws
    flat[:, 0, 0], flat[:, 0, 1] = np.cos(angles), -np.sin(angles)
    flat[:, 1, 0], flat[:, 1, 1] = np.sin(angles), np.cos(angles)
    flat[:, :2, 3] = ((cells[:, ::-1] + p.side // 2) % p.side - p.side // 2) * p.cell
    # neighbouring yaws propose the same shifts: without them there is room for what differs
    best = select_distinct(flat, values, 2 * p.cell, 3 * math.pi / p.n_yaws, p.n_kept)
    lifts = _lifts(source, target, p)
    level = np.repeat(flat[best], len(lifts), axis=0)
    level[:, 2, 3] = np.tile(lifts, len(best))
    level[:, :3, :3] = target.R.T @ level[:, :3, :3] @ source.R
    level[:, :3, 3] = level[:, :3, 3] @ target.R
    return level, np.repeat(values[best], len(lifts))
