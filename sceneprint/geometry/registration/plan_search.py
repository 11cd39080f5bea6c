"""Search for transforms between scans by correlating their plans from above (Sec. III-E).

    Surface  --draw_plan-->  ScanPlan
    ScanPlan, ScanPlan  --plan_hypotheses, slice_hypotheses-->  (n, 4, 4)
    ScanPlan, ScanPlan, T  --slice_correlation-->  correlation

Scans from distant viewpoints have few patches with similar surroundings in common, so
correspondences may yield no correct transform although the plans of the scans match. The upright
surfaces of each scan are drawn, with their normals, into an image seen from above. One image is
rotated through all yaws and correlated with the other. Level surfaces determine the height. This
method is not part of the paper.

In streets, few surfaces are as large as the walls of a hall, and the normals of trees and cars are
unreliable. Therefore, the points above the ground are also drawn without normals, in three slices
of heights, and in cells of double width that cover the whole range of a scanner.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneprint.geometry.kernel import kernel
from sceneprint.geometry.registration.overlap import first_per_cube
from sceneprint.geometry.rigid import select_distinct
from sceneprint.types import Bytes, Floats, Floats32, Ints32, Sphere, Surface

#: Minimum cosine between a candidate for up and a normal that votes for it. A normal below the
#: maximum cosine counts as perpendicular and casts half a vote.
_ALONG, _ACROSS = math.cos(math.radians(6.0)), math.sin(math.radians(4.0))
#: The same two limits, for the normals that refine up.
_NEAR, _LEVEL = math.cos(math.radians(8.0)), math.sin(math.radians(8.0))
#: Maximum number of candidates for up, maximum number of voting normals, and number of refinements.
_MOST_CANDIDATES, _MOST_VOTERS, _REFINEMENTS = 100, 1500, 8
#: Minimum vertical component of a level surface's normal, and maximum of an upright surface's.
_FLAT, _UPRIGHT = 0.9, 0.5
#: Edges of the height slices above the ground, and width of the squares whose lowest points define
#: the ground; in cells.
_SLICE_EDGES, _GROUND_CELLS = (0.8, 2.4, 5.2, 24.0), 8.0


@dataclass(frozen=True)
class PlanParameters:
    """Parameters of the search over plans, tuned on the hall of docs/clouds.md."""

    cell: float = 0.1  #: width of a cell of the plan image, metres
    side: int = 128  #: width of the plan image, cells
    voxel: float = 0.08  #: width of the cubes; one point of each is drawn, metres
    tilt: float = math.radians(50.0)  #: maximum angle between up and the scanner's axis
    n_yaws: int = 72  #: number of yaws
    kept_yaws: int = 24  #: number of yaws whose plans are correlated
    n_peaks: int = 6  #: number of shifts per yaw
    n_kept: int = 50  #: number of transforms kept; they differ by two cells or 1.5 steps of yaw
    n_heights: int = 2  #: number of heights per transform
    height_step: float = 0.05  #: width of a bin of the height histogram, metres
    height_range: float = 3.0  #: maximum absolute value of a height in the histogram, metres
    blur: float = 0.7  #: standard deviation of the Gaussian blur, cells
    flat_weight: float = 0.3  #: weight of the vertical component of normals
    sliced_yaws: int = 18  #: number of yaws (modulo half turns) whose slices are correlated
    n_sliced: int = 25  #: `n_kept` for slices
    slice_blur: float = 0.5  #: `blur` for slices
    slice_trend: float = 0.866  #: `blur` of the low frequencies that are subtracted from slices
    slice_share: float = 0.7  #: minimum ratio of slice correlation at a transform to elsewhere for
    #: its refinement by the points in slices
    slice_margin: float = 1.4  #: minimum ratio for slices to support a transform
    slice_distance: float = 16.0  #: minimum distance between scanners to use slices, cells


@dataclass(frozen=True, eq=False)
class ScanPlan:
    """The plan of a scan: its points as seen from above, and histograms.

    Parameters
    ----------
    R : (3, 3) R_level_sensor; its rows are two horizontal axes and up
    points, normals : (N, 3) float32, one row per voxel, in the axes of R
    slices : (N,) uint8, height slice of each point, from 1; 0 outside all slices
    azimuths : (n_yaws,) histogram of the directions in which upright surfaces face
    heights : (2, n) histograms of the heights of surfaces that face up and down
    """

    R: Floats
    points: Floats32
    normals: Floats32
    slices: Bytes
    azimuths: Floats
    heights: Floats


#: Pairs of a source plan and a target plan.
Plans = list[tuple[ScanPlan, ScanPlan]]


def dominant_up(normals: Floats, axis: Floats, tilt: float) -> Floats:
    """Estimate up: the direction to which most surfaces are perpendicular or parallel.

    Parameters
    ----------
    normals : (N, 3)
    axis : (3,) unit vector
    tilt : maximum angle between the axis and the normals that are tried, radians; the refined
        result may exceed it slightly

    Returns
    -------
    (3,) unit vector within 90 degrees of the axis; the axis itself if no normal is near it
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
    for _ in range(_REFINEMENTS):
        _gather_normals(normals, up, _NEAR, _LEVEL, spread)
        _, vectors = np.linalg.eigh(spread)
        up = vectors[:, -1] * math.copysign(1.0, float(vectors[:, -1] @ up))
    return up


@kernel
def _vote(normals: Floats, candidates: Floats, along: float, across: float, votes: Floats) -> None:
    """Write each candidate's votes: 1 for a parallel normal, 1/2 for a perpendicular normal."""
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
def _gather_normals(normals: Floats, up: Floats, near: float, level: float, spread: Floats) -> None:
    """Write the sum of n n^T over normals along `up`, minus half the sum over normals across it."""
    spread[:] = 0.0
    for i in range(len(normals)):
        cosine = abs(normals[i, 0] * up[0] + normals[i, 1] * up[1] + normals[i, 2] * up[2])
        weight = 1.0 if cosine > near else (-0.5 if cosine < level else 0.0)
        if weight != 0.0:
            for a in range(3):
                for b in range(3):
                    spread[a, b] += weight * normals[i, a] * normals[i, b]


def draw_plan(
    surface: Surface, p: PlanParameters, axis: Floats | None = None, up: Floats | None = None
) -> ScanPlan:
    """Return the plan of a scan: levelled points and histograms, but no image.

    Parameters
    ----------
    surface : surface with at least one valid point
    axis : (3,) expected up, ignored if `up` is not None; None selects the scanner's axis
    up : (3,) unit vector in the scanner's coordinates; None estimates it
    """
    shown = surface.fitted
    points = shown.points[shown.valid]
    indices = first_per_cube(points, p.voxel)
    at, facing = points[indices].astype(float), shown.normals[shown.valid][indices].astype(float)
    if up is None:
        up = dominant_up(facing, scanner_axis(surface) if axis is None else axis, p.tilt)
    level = np.zeros(3)
    level[int(np.argmin(np.abs(up)))] = 1.0
    level -= (level @ up) * up
    level /= np.linalg.norm(level)
    R = np.stack([level, np.cross(up, level), up])
    at, facing = at @ R.T, facing @ R.T
    return ScanPlan(
        R, at.astype(np.float32), facing.astype(np.float32), _slice_heights(at, p),
        _azimuth_histogram(facing, p.n_yaws), _height_histograms(at, facing, p),
    )  # fmt: skip


def other_plans(source: Surface, target: Surface, p: PlanParameters) -> Plans:
    """Return pairs of plans for scanners that were not mounted upright.

    A pair assumes that only the source scanner was on its side or upside down, or that both
    scanners were mounted on the same side.
    """
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    usual_source, usual_target = scanner_axis(source), scanner_axis(target)
    plan, pairs = draw_plan(target, p), []
    for axis in axes:
        if axis @ usual_source < 1:
            tilted = draw_plan(source, p, axis)
            pairs.append((tilted, plan))
            if usual_source @ usual_target == 1 and axis @ usual_source == 0:
                pairs.append((tilted, draw_plan(target, p, axis)))
    return pairs


def scanner_axis(surface: Surface) -> Floats:
    """Return the rotation axis (3,) of a scanner in its own coordinates; z if unknown."""
    axis = np.zeros(3)
    axis[surface.camera.pole if isinstance(surface.camera, Sphere) else 2] = 1.0
    return axis


def _azimuth_histogram(normals: Floats, n_yaws: int) -> Floats:
    """Return a histogram (n_yaws,) of the directions in which upright surfaces face.

    Square roots limit the influence of a single wall.
    """
    upright = normals[np.abs(normals[:, 2]) < _UPRIGHT]
    turns = np.arctan2(upright[:, 1], upright[:, 0]) / (2 * math.pi) % 1.0
    counts = np.bincount((turns * n_yaws).astype(int) % n_yaws, minlength=n_yaws)
    root = np.sqrt(counts)
    result: Floats = root + np.roll(root, 1) + np.roll(root, -1)
    return result


def _height_histograms(points: Floats, normals: Floats, p: PlanParameters) -> Floats:
    """Return smoothed roots of the height histograms of surfaces facing up, and down, (2, n)."""
    n = 2 * round(p.height_range / p.height_step)
    rows = []
    for sign in (1.0, -1.0):
        heights = points[sign * normals[:, 2] > _FLAT, 2]
        bins = np.floor((heights + p.height_range) / p.height_step).astype(int)
        counts = np.bincount(bins[(bins >= 0) & (bins < n)], minlength=n)
        rows.append(np.convolve(np.sqrt(counts), (0.25, 0.5, 0.25), "same"))
    return np.stack(rows)


def _height_offsets(source: ScanPlan, target: ScanPlan, p: PlanParameters) -> list[float]:
    """Return up to `n_heights` heights of the source above the target that align level surfaces."""
    scores = sum(
        np.correlate(b, a, "full") for a, b in zip(source.heights, target.heights, strict=True)
    )
    scores, offsets = np.asarray(scores), []
    middle = source.heights.shape[1] - 1
    for _ in range(p.n_heights):
        best = int(np.argmax(scores))
        if scores[best] <= 0:
            break
        offsets.append((best - middle) * p.height_step)
        scores[max(best - 4, 0) : best + 5] = 0.0
    return offsets or [0.0]


@kernel
def _draw(
    points: Floats32, normals: Floats32, cosine: float, sine: float, cell: float, flat: float,
    image: Floats32,
) -> None:  # fmt: skip
    """Add normals, rotated by a yaw, to an image (3, side, side), with bilinear weights."""
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
    for v in range(side):  # square roots limit the influence of a single wall
        for u in range(side):
            x, y, z = image[0, v, u], image[1, v, u], image[2, v, u]
            length = np.sqrt(x * x + y * y + z * z)
            if length > 0:
                for channel in range(3):
                    image[channel, v, u] /= np.sqrt(length)


@kernel
def _take_peaks(scores: Floats32, n: int, values: Floats, cells: Ints32) -> None:
    """Write the values and cells of the n highest peaks of a torus, at least three cells apart."""
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


@kernel
def _draw_slices(
    points: Floats32, slices: Bytes, cosine: float, sine: float, cell: float, image: Floats32
) -> None:
    """Rotate points by a yaw, and add them to an image (n_slices, side, side), which starts as 0.

    Cells contain the square root of their number of points, at most sqrt(3). Points of slice 0 are
    skipped. The square root and the limit reduce the influence of a single wall. Cell 0 is centred
    on the scanner, and negative cells come after the positive cells, so that a half turn reverses
    both axes.
    """
    side = image.shape[1]
    for i in range(len(points)):
        column = int(np.floor((cosine * points[i, 0] - sine * points[i, 1]) / cell + 0.5))
        line = int(np.floor((sine * points[i, 0] + cosine * points[i, 1]) / cell + 0.5))
        if slices[i] == 0 or 2 * max(abs(column), abs(line)) >= side:
            continue
        k, v, u = slices[i] - 1, line % side, column % side
        image[k, v, u] = np.sqrt(min(image[k, v, u] * image[k, v, u] + 1.0, 3.0))


def _slice_heights(points: Floats, p: PlanParameters) -> Bytes:
    """Return the height slice (N,) of each point, by its height above its lowest neighbour."""
    reach = math.ceil(p.side / _GROUND_CELLS)  # no point is drawn beyond it
    squares = np.floor(np.clip(points[:, :2] / (_GROUND_CELLS * p.cell), -reach, reach)).astype(int)
    squares += reach + 1
    lowest = np.full((2 * reach + 3, 2 * reach + 3), np.inf)
    np.minimum.at(lowest, tuple(squares.T), points[:, 2])
    for axis in (0, 1):
        lowest = np.minimum(lowest, np.minimum(np.roll(lowest, 1, axis), np.roll(lowest, -1, axis)))
    heights = (points[:, 2] - lowest[tuple(squares.T)]) / p.cell
    slices = np.searchsorted(_SLICE_EDGES, heights)
    return np.where(slices < len(_SLICE_EDGES), slices, 0).astype(np.uint8)


def _spectrum(plan: ScanPlan, yaw: float, p: PlanParameters) -> NDArray[np.complex64]:
    """Return the Fourier transform of a plan's normal image at a yaw, (3, side, side / 2 + 1)."""
    image = np.zeros((3, p.side, p.side), np.float32)
    _draw(plan.points, plan.normals, math.cos(yaw), math.sin(yaw), p.cell, p.flat_weight, image)
    return np.fft.rfft2(image).astype(np.complex64, copy=False)


def _slice_spectrum(plan: ScanPlan, yaw: float, p: PlanParameters) -> NDArray[np.complex64]:
    """Return the Fourier transform of a plan's slice images, (n_slices, side, side / 2 + 1).

    Magnitudes are replaced by their square roots. Most points are near the scanner, so otherwise
    the correlation would be highest where both scanners coincide.
    """
    image = np.zeros((len(_SLICE_EDGES) - 1, p.side, p.side), np.float32)
    _draw_slices(plan.points, plan.slices, math.cos(yaw), math.sin(yaw), 2 * p.cell, image)
    spectrum = np.fft.rfft2(image).astype(np.complex64, copy=False)
    spectrum /= np.sqrt(np.abs(spectrum) + 1e-6)
    return spectrum


def _blur(spectrum: NDArray[np.complex64], blur: float) -> NDArray[np.complex64]:
    """Return a spectrum blurred twice, as if both images of a correlation were blurred."""
    side = spectrum.shape[1]
    squares = np.fft.fftfreq(side)[:, None] ** 2 + np.fft.rfftfreq(side)[None] ** 2
    result: NDArray[np.complex64] = spectrum * np.exp(-((2 * math.pi * blur) ** 2) * squares)
    return result.astype(np.complex64)


def _yaw_agreement(source: ScanPlan, target: ScanPlan) -> Floats:
    """Return the correlation (n_yaws,) of two azimuth histograms for each yaw of the source."""
    yaws = np.arange(len(source.azimuths))
    result: Floats = source.azimuths[yaws - yaws[:, None]] @ target.azimuths
    return result


def plan_hypotheses(plans: Plans, p: PlanParameters) -> Floats:
    """Return transforms that align the plans of two scans, best first.

    Parameters
    ----------
    plans : pairs of source and target, one for each hypothesis of up

    Returns
    -------
    (n, 4, 4) T_target_source; their number does not depend on the number of pairs
    """
    tried = [_correlate_plans(source, target, p) for source, target in plans]
    values = np.concatenate([value for _, value in tried])
    best = np.argsort(-values, kind="stable")[: p.n_kept * p.n_heights]
    result: Floats = np.concatenate([transforms for transforms, _ in tried])[best]
    return result


def _correlate_plans(
    source: ScanPlan, target: ScanPlan, p: PlanParameters
) -> tuple[Floats, Floats]:
    """Return transforms (n, 4, 4) that align one plan with the other, and their correlations."""
    yaws = np.argsort(-_yaw_agreement(source, target), kind="stable")[: p.kept_yaws]
    angles = 2 * math.pi * yaws / p.n_yaws
    blurred = _blur(_spectrum(target, 0.0, p), p.blur)
    products = (blurred * _spectrum(source, float(angle), p).conj() for angle in angles)
    return _transforms_at_peaks(source, target, angles, products, p.cell, p.n_kept, p)


def slice_hypotheses(
    source: ScanPlan, target: ScanPlan, p: PlanParameters
) -> tuple[Floats, Floats]:
    """Return T_target_source (n, 4, 4) that align the points in the height slices, best first.

    Also return their correlations (n,).

    Only the `sliced_yaws` pairs of opposite yaws with the best agreement of azimuths are tried. A
    half turn of an image conjugates its spectrum, so both yaws of a pair share a spectrum.
    """
    half = p.n_yaws // 2
    agreement = _yaw_agreement(source, target)
    pairs = np.argsort(-(agreement[:half] + agreement[half : 2 * half]), kind="stable")
    angles = 2 * math.pi * pairs[: p.sliced_yaws] / p.n_yaws
    onto = _slice_target(target, p)

    def products() -> Iterator[NDArray[np.complex64]]:
        for angle in angles:
            spectrum = _slice_spectrum(source, float(angle), p)
            yield onto * spectrum.conj()
            yield onto * spectrum

    both = np.stack([angles, angles + math.pi], axis=1).ravel()
    return _transforms_at_peaks(source, target, both, products(), 2 * p.cell, p.n_sliced, p)


def slice_correlation(source: ScanPlan, target: ScanPlan, T: Floats, p: PlanParameters) -> float:
    """Return the correlation of the slices under T_target_source (4, 4): see `slice_hypotheses`.

    The result is the highest value among the cell of the shift and its neighbours.
    """
    R = target.R @ T[:3, :3] @ source.R.T
    yaw = math.atan2(R[1, 0] - R[0, 1], R[0, 0] + R[1, 1])
    shift = np.rint(target.R[:2] @ T[:3, 3] / (2 * p.cell)).astype(int)
    if np.abs(shift).max() >= p.side // 2:
        return 0.0
    product = _slice_target(target, p) * _slice_spectrum(source, yaw, p).conj()
    scores = np.fft.irfft2(product.sum(axis=0), s=(p.side, p.side))
    around = (shift[:, None] + np.arange(-1, 2)) % p.side
    return float(scores[np.ix_(around[1], around[0])].max())


def _slice_target(target: ScanPlan, p: PlanParameters) -> NDArray[np.complex64]:
    """Return the filtered spectrum of a target's slices, for correlation with those of sources."""
    spectrum = _slice_spectrum(target, 0.0, p)
    return _blur(spectrum, p.slice_blur) - _blur(spectrum, p.slice_trend)


def _transforms_at_peaks(
    source: ScanPlan, target: ScanPlan, angles: Floats, products: Iterable[NDArray[np.complex64]],
    cell: float, n_kept: int, p: PlanParameters,
) -> tuple[Floats, Floats]:  # fmt: skip
    """Return the transforms (n, 4, 4) at the peaks of the correlations, and their correlations.

    Parameters
    ----------
    source, target : two plans
    angles : yaw of the source for each correlation, radians
    products : products of the spectra of both images, (channels, side, side / 2 + 1)
    cell : width of a cell, metres
    n_kept : number of distinct yaws and shifts to keep; n is this number times the number of
        heights
    """
    values = np.empty(len(angles) * p.n_peaks)
    cells = np.empty((len(values), 2), np.int32)
    for place, product in enumerate(products):
        scores = np.fft.irfft2(product.sum(axis=0), s=(p.side, p.side))
        own = slice(place * p.n_peaks, (place + 1) * p.n_peaks)
        _take_peaks(scores.astype(np.float32, copy=False), p.n_peaks, values[own], cells[own])
    flat = np.tile(np.eye(4), (len(values), 1, 1))
    yaws = np.repeat(angles, p.n_peaks)
    flat[:, 0, 0], flat[:, 0, 1] = np.cos(yaws), -np.sin(yaws)
    flat[:, 1, 0], flat[:, 1, 1] = np.sin(yaws), np.cos(yaws)
    flat[:, :2, 3] = ((cells[:, ::-1] + p.side // 2) % p.side - p.side // 2) * cell
    # adjacent yaws propose the same shifts, which would displace other transforms
    best = select_distinct(flat, values, 2 * cell, 3 * math.pi / p.n_yaws, n_kept)
    lifts = _height_offsets(source, target, p)
    level = np.repeat(flat[best], len(lifts), axis=0)
    level[:, 2, 3] = np.tile(lifts, len(best))
    level[:, :3, :3] = target.R.T @ level[:, :3, :3] @ source.R
    level[:, :3, 3] = level[:, :3, 3] @ target.R
    return level, np.repeat(values[best], len(lifts))
