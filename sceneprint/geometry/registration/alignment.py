"""Search for the transform that best explains two frames, and for alternatives (Sec. III-E).

    correspondences (M)  --consensus-->  transforms (S, 4, 4), by descending support
    Geometry, Geometry  --align-->  Alignment               for one direction
    Geometry, Geometry  --align_scans-->  two Alignments    for scans, with one search
    Geometry, Geometry, T  --align_guided-->  Alignment     from a predicted transform

Two correspondences are compatible if a rigid motion could map both: their patches agree in
distance, in heights over each other's planes, in the angle of their normals, and in handedness. A
seed correspondence and compatible correspondences that are also compatible with each other
(second-order compatibility: Chen et al., SC2-PCR, CVPR 2022) determine one transform, which is
refined over all correspondences that it explains.

For depth images, both directions are searched independently, because the agreement of independent
results is evidence. Scans contain much more surface, so a single search is sufficient; its result
is refined separately in each direction.

If `up` is known in both frames (an IMU measures it to half a degree), transforms that tilt it are
excluded. Since `up` may be wrong, the gates have a margin, and if no transform fits, the search is
repeated without `up`. The paper does not use gravity.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from sceneprint.geometry.kernel import cached_per_frame, disjoint_kernel, kernel
from sceneprint.geometry.registration.icp import (
    COARSE,
    FINE,
    Refinement,
    RefinementParameters,
    refine,
    refine_all,
    refine_with_index,
)
from sceneprint.geometry.registration.overlap import (
    OverlapParameters,
    PlaneParameters,
    PlaneView,
    agreements,
    plane_agreement,
    plane_view,
    sample_points,
)
from sceneprint.geometry.registration.patch_descriptors import (
    MatchingParameters,
    SlopeGate,
    correspondences,
)
from sceneprint.geometry.registration.plan_search import (
    PlanParameters,
    ScanPlan,
    dominant_up,
    draw_plan,
    other_plans,
    plan_hypotheses,
    slice_hypotheses,
)
from sceneprint.geometry.registration.sequence_alignment import (
    Matching,
    SequenceParameters,
    sequence_correspondences,
)
from sceneprint.geometry.registration.slice_support import refine_by_slices
from sceneprint.geometry.rigid import (
    GravityParameters,
    Ups,
    are_level,
    inverse,
    inverses,
    rotation_of_covariance,
    select_distinct,
    slopes,
)
from sceneprint.types import (
    Bytes,
    Floats,
    Floats32,
    Geometry,
    Ints32,
    Patches,
    Sphere,
    Surface,
    kind_of,
)


@dataclass(frozen=True)
class ConsensusParameters:
    """Parameters of the compatibility graph and of its hypotheses."""

    distance_tolerance: float = 0.12  #: tolerance of lengths and heights, metres
    angle_tolerance: float = 0.5  #: tolerance of the angle between two patches' normals, radians
    minimum_distance: float = 0.15  #: minimum distance between the two patches of a pair, metres
    n_seeds: int = 40  #: number of transforms that are fitted
    n_support: int = 16  #: number of correspondences in the first fit for each seed
    normal_weight: float = 0.05  #: weight of normals relative to positions, square metres
    rounds: int = 3  #: number of refits to the correspondences that a transform explains
    inlier_distance: float = 0.15  #: maximum distance of corresponding patches, metres
    inlier_cosine: float = 0.85  #: minimum cosine between their normals


@kernel
def _alike_angles(a: float, b: float, most: float) -> bool:
    """Return whether two angles with these cosines differ by at most `most` radians."""
    a, b = min(max(a, -1.0), 1.0), min(max(b, -1.0), 1.0)
    return not abs(np.arccos(a) - np.arccos(b)) > most


#: Results of `_compare` for two correspondences; _UNDECIDED requires a comparison of angles.
_APART, _ALIKE, _UNDECIDED = 0, 1, 2


@disjoint_kernel
def _compare(
    p: Floats, n: Floats, q: Floats, m: Floats, i: int,
    tolerance: float, angle: float, minimum: float, verdicts: Bytes, cosines: Floats,
) -> None:  # fmt: skip
    """Compare correspondence i with all later ones; points and normals are (3, M), cosines (2, M).

    They are compatible if lengths, heights above each other's planes, angles between normals and
    the signed triple product, which excludes mirror images, agree. The cosines bound the difference
    of two angles from both sides; an arccosine is necessary only between these bounds.
    """
    later = i + 1  # slices, because indices that can be negative prevent vectorization
    px, py, pz, nx, ny, nz = (
        p[0, later:], p[1, later:], p[2, later:], n[0, later:], n[1, later:], n[2, later:],
    )  # fmt: skip
    qx, qy, qz, mx, my, mz = (
        q[0, later:], q[1, later:], q[2, later:], m[0, later:], m[1, later:], m[2, later:],
    )  # fmt: skip
    in_a, in_b = cosines[0, later:], cosines[1, later:]
    least, most = 1.0 - math.cos(angle) - 1e-9, angle + 1e-9
    pxi, pyi, pzi, nxi, nyi, nzi = p[0, i], p[1, i], p[2, i], n[0, i], n[1, i], n[2, i]
    qxi, qyi, qzi, mxi, myi, mzi = q[0, i], q[1, i], q[2, i], m[0, i], m[1, i], m[2, i]
    later_verdicts = verdicts[later:]
    for j in range(len(later_verdicts)):
        ax, ay, az = px[j] - pxi, py[j] - pyi, pz[j] - pzi
        bx, by, bz = qx[j] - qxi, qy[j] - qyi, qz[j] - qzi
        da, db = np.sqrt(ax * ax + ay * ay + az * az), np.sqrt(bx * bx + by * by + bz * bz)
        alike = (abs(da - db) <= tolerance) & (da >= minimum) & (db >= minimum)
        ha = ax * nxi + ay * nyi + az * nzi
        hb = bx * mxi + by * myi + bz * mzi
        ga = ax * nx[j] + ay * ny[j] + az * nz[j]
        gb = bx * mx[j] + by * my[j] + bz * mz[j]
        alike = alike & (abs(ha - hb) <= tolerance) & (abs(ga - gb) <= tolerance)
        ta = (
            ax * (nyi * nz[j] - nzi * ny[j])
            + ay * (nzi * nx[j] - nxi * nz[j])
            + az * (nxi * ny[j] - nyi * nx[j])
        )
        tb = (
            bx * (myi * mz[j] - mzi * my[j])
            + by * (mzi * mx[j] - mxi * mz[j])
            + bz * (mxi * my[j] - myi * mx[j])
        )
        alike = alike & (abs(ta - tb) <= 2 * tolerance)
        ca = nxi * nx[j] + nyi * ny[j] + nzi * nz[j]
        cb = mxi * mx[j] + myi * my[j] + mzi * mz[j]
        in_a[j], in_b[j] = ca, cb
        apart = abs(min(max(ca, -1.0), 1.0) - min(max(cb, -1.0), 1.0))
        angle_says = _ALIKE if apart < least else _UNDECIDED
        later_verdicts[j] = angle_says if alike & (apart <= most) else _APART


@kernel
def _build_graph(
    p: Floats, n: Floats, q: Floats, m: Floats,
    tolerance: float, angle: float, minimum: float, bits: NDArray[np.uint64],
) -> None:  # fmt: skip
    """Set bit j of row i if correspondences i and j are compatible; all arrays are (3, M)."""
    count = p.shape[1]
    verdicts, cosines = np.empty(count, np.uint8), np.empty((2, count))
    for i in range(count):
        _compare(p, n, q, m, i, tolerance, angle, minimum, verdicts, cosines)
        for j in range(i + 1, count):
            if verdicts[j] == _APART:
                continue
            if verdicts[j] == _ALIKE or _alike_angles(cosines[0, j], cosines[1, j], angle):
                bits[i, j >> 6] |= np.uint64(1) << np.uint64(j & 63)
                bits[j, i >> 6] |= np.uint64(1) << np.uint64(i & 63)


@kernel
def _count_common(bits: NDArray[np.uint64], common: Ints32) -> None:
    """Write how many correspondences are compatible with both i and j; 0 for incompatible pairs."""
    count, words = bits.shape
    m1, m2 = np.uint64(0x5555555555555555), np.uint64(0x3333333333333333)
    m4, h = np.uint64(0x0F0F0F0F0F0F0F0F), np.uint64(0x0101010101010101)
    for i in range(count):
        for j in range(i + 1, count):
            if not (bits[i, j >> 6] >> np.uint64(j & 63)) & np.uint64(1):
                continue
            total = 0
            for k in range(words):
                v = bits[i, k] & bits[j, k]
                v = v - ((v >> np.uint64(1)) & m1)
                v = (v & m2) + ((v >> np.uint64(2)) & m2)
                v = (v + (v >> np.uint64(4))) & m4
                total += int((v * h) >> np.uint64(56))
            common[i, j] = total
            common[j, i] = total


@disjoint_kernel
def _select_weighted(weights: Floats, places: Ints32) -> int:
    """Write the indices of the positive weights; return their number."""
    count = 0
    for i in range(len(weights)):
        places[count] = i
        count += 1 if weights[i] > 0 else 0
    return count


@kernel
def _fit_transform(
    p: Floats, n: Floats, q: Floats, m: Floats, weights: Floats, normal_weight: float,
    places: Ints32, T: Floats,
) -> bool:  # fmt: skip
    """Fit T to positions and normals, (3, M) each, by weighted Kabsch; return whether it succeeded.

    `places` (M,) is scratch space for the indices of weighted correspondences.
    """
    used = _select_weighted(weights, places)
    if used < 3:
        return False
    total, a, b, H = 0.0, np.zeros(3), np.zeros(3), np.zeros((3, 3))
    for k in range(used):
        i = places[k]
        total += weights[i]
        for r in range(3):
            a[r] += weights[i] * p[r, i]
            b[r] += weights[i] * q[r, i]
    for r in range(3):
        a[r] /= total
        b[r] /= total
    for k in range(used):
        i = places[k]
        for r in range(3):
            moved, facing = q[r, i] - b[r], normal_weight * m[r, i]
            for c in range(3):
                H[r, c] += weights[i] * (moved * (p[c, i] - a[c]) + facing * n[c, i])
    R = np.empty((3, 3))
    rotation_of_covariance(H, R)
    for r in range(3):
        for c in range(3):
            T[r, c] = R[r, c]
        T[r, 3] = b[r] - (R[r, 0] * a[0] + R[r, 1] * a[1] + R[r, 2] * a[2])
        T[3, r] = 0.0
    T[3, 3] = 1.0
    return True


@kernel
def _weigh_inliers(
    p: Floats, n: Floats, q: Floats, m: Floats, T: Floats,
    distance: float, cosine: float, weights: Floats,
) -> None:  # fmt: skip
    """Write the weights (1 - d^2 / distance^2)^2 of correspondences under T; arrays are (3, M)."""
    px, py, pz, qx, qy, qz = p[0], p[1], p[2], q[0], q[1], q[2]
    ax, ay, az, bx, by, bz = n[0], n[1], n[2], m[0], m[1], m[2]
    xx, xy, xz, tx = T[0, 0], T[0, 1], T[0, 2], T[0, 3]
    yx, yy, yz, ty = T[1, 0], T[1, 1], T[1, 2], T[1, 3]
    zx, zy, zz, tz = T[2, 0], T[2, 1], T[2, 2], T[2, 3]
    square = distance * distance
    for i in range(len(weights)):
        x = xx * px[i] + xy * py[i] + xz * pz[i] + tx - qx[i]
        y = yx * px[i] + yy * py[i] + yz * pz[i] + ty - qy[i]
        z = zx * px[i] + zy * py[i] + zz * pz[i] + tz - qz[i]
        u = 1.0 - (x * x + y * y + z * z) / square
        nx = xx * ax[i] + xy * ay[i] + xz * az[i]
        ny = yx * ax[i] + yy * ay[i] + yz * az[i]
        nz = zx * ax[i] + zy * ay[i] + zz * az[i]
        c = nx * bx[i] + ny * by[i] + nz * bz[i]
        weights[i] = (u * u if u > 0 else 0.0) if c > cosine else 0.0


@kernel
def _write_largest(row: Ints32, order: Ints32) -> None:
    """Write the indices of a row's largest values, largest first, ties by index, to `order`."""
    count = 0
    for j in range(len(row)):
        if count == len(order) and row[j] <= row[order[count - 1]]:
            continue
        place = count if count < len(order) else count - 1
        while place > 0 and row[order[place - 1]] < row[j]:
            order[place] = order[place - 1]
            place -= 1
        order[place] = j
        count = min(count + 1, len(order))


@kernel
def _fit_hypotheses(
    p: Floats, n: Floats, q: Floats, m: Floats, common: Ints32, n_seeds: int, n_support: int,
    normal_weight: float, rounds: int, distance: float, cosine: float, T: Floats,
) -> int:  # fmt: skip
    count = len(common)
    support = np.zeros(count)
    for i in range(count):
        total = 0
        for j in range(count):
            total += common[i, j]
        support[i] = total
    weights, places, n_fitted = np.zeros(count), np.empty(count, np.int32), 0
    order = np.empty(min(n_support, count), np.int32)
    for _ in range(n_seeds):
        seed = int(np.argmax(support))
        if support[seed] <= 0:
            break
        row = common[seed]
        _write_largest(row, order)
        weights[:] = 0.0
        weights[seed] = max(row[order[0]], 1)
        for k in order:
            weights[k] = max(float(row[k]), weights[k])
        for j in range(count):  # skip seeds that would repeat this hypothesis
            if row[j] > 0:
                support[j] *= 1.0 - 0.5 * row[j] / row[order[0]]
        support[seed] = 0.0
        if not _fit_transform(p, n, q, m, weights, normal_weight, places, T[n_fitted]):
            continue
        for _ in range(rounds):
            _weigh_inliers(p, n, q, m, T[n_fitted], distance, cosine, weights)
            if not _fit_transform(p, n, q, m, weights, normal_weight, places, T[n_fitted]):
                break
        n_fitted += 1
    return n_fitted


def consensus(source: Patches, target: Patches, pairs: Ints32, p: ConsensusParameters) -> Floats:
    """Compute transforms from source to target on which correspondences agree.

    Parameters
    ----------
    source, target : patches of the two frames
    pairs : (M, 2) int32 correspondences, indices in source and in target

    Returns
    -------
    (S, 4, 4) T_target_source; S is at most `n_seeds`, and 0 if fewer than three correspondences
    agree
    """
    if len(pairs) < 3:
        return np.empty((0, 4, 4))
    a = np.ascontiguousarray(source.means[pairs[:, 0]].T)
    n = np.ascontiguousarray(source.normals[pairs[:, 0]].T)
    b = np.ascontiguousarray(target.means[pairs[:, 1]].T)
    m = np.ascontiguousarray(target.normals[pairs[:, 1]].T)
    bits = np.zeros((len(pairs), (len(pairs) + 63) // 64), np.uint64)
    _build_graph(a, n, b, m, p.distance_tolerance, p.angle_tolerance, p.minimum_distance, bits)
    common = np.zeros((len(pairs), len(pairs)), np.int32)
    _count_common(bits, common)
    T = np.zeros((p.n_seeds, 4, 4))
    count = _fit_hypotheses(
        a, n, b, m, common, p.n_seeds, p.n_support, p.normal_weight, p.rounds,
        p.inlier_distance, p.inlier_cosine, T,
    )  # fmt: skip
    return T[:count]


def floor_error(frame: Geometry, up: Floats, p: GravityParameters) -> float:
    """Return the angle, in radians, between `up` (3,) and the surface's nearest dominant direction.

    Visible floors and tables determine the up direction as precisely as an IMU, but ramps mislead,
    and the floor may be out of view. Therefore, the angle is a hint, not evidence.
    """
    facing = frame.surface.normals[frame.surface.valid][:: p.floor_stride].astype(float)
    if not len(facing):
        return 0.0
    cosine = float(np.clip(dominant_up(facing, up, p.floor_tilt) @ up, -1.0, 1.0))
    return math.acos(cosine)


def contradiction(
    tilt: float, query: Geometry, match: Geometry, ups: Ups, p: GravityParameters
) -> str:
    """Return why a transform that fits but tilts against `up` was rejected.

    Parameters
    ----------
    tilt : tilt of the transform, radians
    query, match : the two frames
    ups : up vectors of query and match, both known
    """
    wrong = [
        name
        for name, frame, up in (("query", query, ups[0]), ("match", match, ups[1]))
        if up is not None and p.refined_tilt < floor_error(frame, up, p) < 0.95 * p.floor_tilt
    ]
    clue = f" (the floor of the {wrong[0]} disagrees with it)" if len(wrong) == 1 else ""
    return (
        f"the surfaces fit only if tilted by {math.degrees(tilt):.0f} deg against `up`: either the "
        f"place only looks similar, or `up` is wrong{clue}. Check the IMU's calibration and the "
        "axes of `up`"
    )


#: Source of a proposed transform: correspondences, plans or the map's poses.
Search = Literal["correspondences", "plans", "guided"]


@dataclass(frozen=True)
class AlignmentParameters:
    """Parameters of the search for a transform."""

    matching: MatchingParameters = field(default_factory=MatchingParameters)
    consensus: ConsensusParameters = field(default_factory=ConsensusParameters)
    n_refined: int = 16  #: number of hypotheses that are refined
    n_sliced: int = 4  #: number of slice hypotheses among them, regardless of their scores
    score_stride: int = 2  #: stride of the points that score hypotheses
    n_fine: int = 6  #: number of hypotheses for scans that are refined finely before ranking
    fine_stride: int = 4  #: stride of the pixels in this refinement
    violation_weight: float = 3.0  #: weight of a violation in the score of a hypothesis
    rank_violations: float = 1.0  #: weight of violations in the rank of a refined hypothesis
    same_m: float = 0.1  #: maximum difference between equal hypotheses, metres
    same_rad: float = math.radians(6.0)  #: maximum difference between equal hypotheses, radians
    coarse: RefinementParameters = COARSE
    fine: RefinementParameters = FINE
    lever: float = 1.0  #: length that counts as one radian in `stiffness`, metres
    sequence: SequenceParameters = field(default_factory=SequenceParameters)
    plan: PlanParameters = field(default_factory=PlanParameters)
    gravity: GravityParameters = field(default_factory=GravityParameters)


@dataclass(frozen=True, eq=False)
class FrameSamples:
    """A frame with precomputed sample points for scoring hypotheses.

    Parameters
    ----------
    points : (N, 6) float32 result of `sample_points`
    up : (3,) unit vector in the sensor's coordinates; None if unknown
    """

    geometry: Geometry
    points: Floats32
    planes: PlaneView
    up: Floats | None = None

    def plan(self, p: PlanParameters) -> ScanPlan:
        """Return the plan of a scan, as seen from above."""
        if self.up is not None:
            return draw_plan(self.geometry.surface, p, up=self.up)
        return _upright_plan(self.geometry.surface, p)


@cached_per_frame
def _upright_plan(surface: Surface, p: PlanParameters) -> ScanPlan:
    return draw_plan(surface, p)


def frame_samples(
    geometry: Geometry, stride: int, p: PlaneParameters, up: Floats | None = None
) -> FrameSamples:
    """Prepare a frame for `align` by sampling every `stride`-th row and column."""
    return FrameSamples(
        geometry, sample_points(geometry.surface, stride), plane_view(geometry, p), up
    )


@dataclass(frozen=True, eq=False)
class Alignment:
    """The result of a search in one direction.

    Parameters
    ----------
    T : (4, 4) T_target_source
    others : (n, 4, 4) other refined hypotheses, best first
    stiffness : ratio of the smallest to the largest eigenvalue of the information matrix; 0 if a
        direction is unconstrained
    refined : result of the last refinement; None if it failed
    search : source of the transform
    proposed : (n, 4, 4) all hypotheses before refinement, best first; for scans only
    distinctness : ratio of the correlation of height slices under T to that under any other
        transform; 0 if unknown
    """

    T: Floats
    others: Floats
    stiffness: float
    refined: Refinement | None
    search: Search = "correspondences"
    proposed: Floats = field(default_factory=lambda: np.empty((0, 4, 4)))
    distinctness: float = 0.0


def align(
    source: FrameSamples,
    target: FrameSamples,
    rng: np.random.Generator,
    p: AlignmentParameters,
    overlap_p: OverlapParameters,
    matching: Matching = "histograms",
) -> Alignment | None:
    """Search for the transform from source to target: Sec. III-E, in one direction.

    Correspondences propose about 40 hypotheses. They are scored by the agreement of both frames'
    points; the best distinct hypotheses are refined and ranked by planes, and the best hypothesis
    is refined finely.

    Parameters
    ----------
    source, target : samples of two frames
    rng : random generator for the sampled patches
    matching : method of matching

    Returns
    -------
    alignment : the result; None if fewer than three correspondences agree, or all refinements fail
    """
    a, b = source.geometry, target.geometry
    ups = source.up, target.up
    hypotheses = _vote_hypotheses(a, b, rng, p, matching, ups)
    scores = _score(source, target, hypotheses, p, overlap_p)
    chosen = select_distinct(hypotheses, scores, p.same_m, p.same_rad, p.n_refined)
    refined = refine_all(a.surface, b.surface, hypotheses[chosen], p.coarse)
    refined = refined[are_level(refined, ups, p.gravity.refined_tilt)]
    if not len(refined):
        return None
    refined = refined[_rank(source, target, refined, p, overlap_p)]
    return _refine_finally(source, target, refined[0], refined[1:], p, "correspondences")


def align_scans(
    query: FrameSamples,
    match: FrameSamples,
    rng: np.random.Generator,
    p: AlignmentParameters,
    overlap_p: OverlapParameters,
    matching: Matching = "histograms",
    *,
    other_axes: bool = False,
) -> tuple[Alignment, Alignment] | None:
    """Search for the transform between two scans, and refine it in both directions.

    Both correspondences and plans propose hypotheses. The best hypotheses are refined finely before
    ranking: plans are coarse, and the ranks of coarsely refined hypotheses are unreliable.

    Parameters
    ----------
    query, match : samples of two scans
    rng, p, overlap_p, matching : arguments of `align`
    other_axes : whether to consider that the scanners were not upright

    Returns
    -------
    alignments : query to match, and match to query; None if all refinements fail
    """
    a, b = query.geometry, match.geometry
    ups = query.up, match.up
    voted = _vote_hypotheses(a, b, rng, p, matching, ups)
    planned, sliced, values = _search_plans(query, match, p.plan, other_axes=other_axes)
    hypotheses = np.concatenate([voted, sliced, planned])
    scores = _score(query, match, hypotheses, p, overlap_p)
    priorities = scores.copy()  # slices are too coarse to be scored, so the best slices come first
    priorities[len(voted) : len(voted) + min(len(sliced), p.n_sliced)] = math.inf
    chosen = select_distinct(hypotheses, priorities, p.same_m, p.same_rad, p.n_refined)
    transforms, index = refine_with_index(a.surface, b.surface, hypotheses[chosen], p.coarse)
    if not len(index):
        return None
    is_planned = np.array(chosen)[index] >= len(voted)
    level = are_level(transforms, ups, p.gravity.refined_tilt)
    transforms, is_planned = transforms[level], is_planned[level]
    if not len(transforms):
        return None
    order = _rank(query, match, transforms, p, overlap_p)
    transforms, is_planned = transforms[order], is_planned[order]
    onto, numbers = b.surface.fitted, replace(p.fine, stride=p.fine_stride)
    fine, index = refine_with_index(a.surface, onto, transforms[: p.n_fine], numbers)
    transforms[index] = fine
    order = _rank(query, match, transforms, p, overlap_p)
    T, others = transforms[order[0]], transforms[order[1:]]
    search: Search = "plans" if is_planned[order[0]] else "correspondences"
    distinctness = 0.0
    if len(sliced):
        plans = query.plan(p.plan), match.plan(p.plan)
        T, distinctness = refine_by_slices(*plans, T, sliced, values, p.plan)
    there = _refine_finally(query, match, T, others, p, search)
    back = _refine_finally(match, query, inverse(T), inverses(others), p, search)
    proposed = hypotheses[np.argsort(-scores, kind="stable")]
    return replace(there, proposed=proposed, distinctness=distinctness), back


def _search_plans(
    query: FrameSamples, match: FrameSamples, p: PlanParameters, *, other_axes: bool
) -> tuple[Floats, Floats, Floats]:
    """Return hypotheses (n, 4, 4) from plans and, if both scanners see all around, from slices.

    The last result is the correlations of the hypotheses from slices. Streets require slices; with
    `other_axes` there are none, because scanners in streets are upright.
    """
    a, b = query.geometry.surface, match.geometry.surface
    if other_axes:
        return plan_hypotheses(other_plans(a, b, p), p), np.empty((0, 4, 4)), np.empty(0)
    pair = query.plan(p), match.plan(p)
    planned = plan_hypotheses([pair], p)
    if a.spread is None or b.spread is None:
        return planned, np.empty((0, 4, 4)), np.empty(0)
    return planned, *slice_hypotheses(*pair, p)


def align_guided(
    source: FrameSamples, target: FrameSamples, T: Floats, p: AlignmentParameters
) -> Alignment | None:
    """Refine a predicted T_target_source (4, 4) in one direction; return None if that fails."""
    surface, onto = source.geometry.surface, target.geometry.surface
    coarse = refine(
        sample_points(surface, p.coarse.stride), onto, T, p.coarse, kind_of(surface.camera)
    )
    if coarse is None:
        return None
    result = _refine_finally(source, target, coarse.T, np.empty((0, 4, 4)), p, "guided")
    return None if result.refined is None else result


def are_scans(query: Geometry, match: Geometry) -> bool:
    """Return whether both frames are range images about a viewpoint."""
    return all(isinstance(frame.surface.camera, Sphere) for frame in (query, match))


def _vote_hypotheses(
    source: Geometry, target: Geometry, rng: np.random.Generator, p: AlignmentParameters,
    matching: Matching, ups: Ups,
) -> Floats:  # fmt: skip
    """Return the hypotheses from correspondences that do not tilt against `ups`."""
    pairs = _match_patches(source, target, rng, p, matching, ups)
    voted = consensus(source.patches, target.patches, pairs, p.consensus)
    return voted[are_level(voted, ups, p.gravity.proposed_tilt)]


def _match_patches(
    source: Geometry, target: Geometry, rng: np.random.Generator, p: AlignmentParameters,
    matching: Matching, ups: Ups,
) -> Ints32:  # fmt: skip
    gate = None
    if ups[0] is not None and ups[1] is not None:
        angles = slopes(source.patches.normals, ups[0]), slopes(target.patches.normals, ups[1])
        gate = SlopeGate(*angles, p.gravity.gate)
    if matching == "histograms":
        return correspondences(source.descriptors, target.descriptors, rng, p.matching, gate)
    pairs = sequence_correspondences(source.patches, target.patches, rng, p.sequence)
    if gate is None:
        return pairs
    return pairs[np.abs(gate.source[pairs[:, 0]] - gate.target[pairs[:, 1]]) <= gate.most]


def _refine_finally(
    source: FrameSamples, target: FrameSamples, T: Floats, others: Floats, p: AlignmentParameters,
    search: Search,
) -> Alignment:  # fmt: skip
    surface = source.geometry.surface
    onto = target.geometry.surface.fitted
    fine = refine(sample_points(surface, p.fine.stride), onto, T, p.fine, kind_of(surface.camera))
    if fine is None:
        return Alignment(T, others, 0.0, None, search)
    scale = np.array([p.lever] * 3 + [1.0] * 3)
    eigenvalues = np.linalg.eigvalsh(fine.information / np.outer(scale, scale))
    stiffness = max(float(eigenvalues[0] / eigenvalues[-1]), 0.0)
    return Alignment(fine.T, others, stiffness, fine, search)


def _score(
    source: FrameSamples, target: FrameSamples, transforms: Floats, p: AlignmentParameters,
    overlap_p: OverlapParameters,
) -> Floats:  # fmt: skip
    """Return the score of each transform (n,): its share of inliers minus weighted violations."""
    total = np.zeros(len(transforms))
    for frame, other, direction in (
        (source, target, transforms), (target, source, inverses(transforms)),
    ):  # fmt: skip
        points = frame.points[:: p.score_stride]
        counts = agreements(points, other.geometry.surface, direction, overlap_p)
        total += (counts[:, 0] - p.violation_weight * counts[:, 1]) / max(len(points), 1)
    return total


def _rank(
    source: FrameSamples, target: FrameSamples, transforms: Floats, p: AlignmentParameters,
    overlap_p: OverlapParameters,
) -> Ints32:  # fmt: skip
    """Return the indices of refined transforms, best first."""
    agreement = plane_agreement(source.planes, target.planes, transforms, overlap_p)
    scores = agreement.share - p.rank_violations * agreement.violations
    return np.argsort(-scores, kind="stable").astype(np.int32)
