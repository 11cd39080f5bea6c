"""Evaluation on pairs of frames: sampling, validation, Open3D baselines, and errors.

PATH...  --evaluate_pairs-->  PairEvaluation
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from sceneprint.errors import DatasetError
from sceneprint.fusion import open3d
from sceneprint.geometry.registration.alignment import AlignmentParameters
from sceneprint.geometry.registration.icp import refine_all
from sceneprint.geometry.registration.sequence_alignment import Matching
from sceneprint.geometry.signature.pair_features import PropertyParameters
from sceneprint.geometry.validation.acceptance import AcceptanceParameters, Mode
from sceneprint.geometry.validation.map_verification import MapParameters
from sceneprint.geometry.validation.validation import refine_transform
from sceneprint.models import Model, ModelParameters
from sceneprint.pipeline import Signer, geometry_of
from sceneprint.signing import see
from sceneprint.types import AnyFrame, Cloud, DepthFrame, Floats, Geometry
from sceneprint_lab.evaluation.judgement import (
    Candidate,
    Judge,
    QueryTask,
    open_judge,
    refined_from_truth,
    true_transform,
    validated,
)
from sceneprint_lab.evaluation.protocol import (
    RIGHT,
    Error,
    FrameStore,
    Overlaps,
    Prepared,
    ProtocolFrame,
    SignedFrame,
    ValidatedPair,
    Watch,
    every_frame,
    map_over,
    points_at,
    pose_error,
    prepare_all,
    unwatched,
    view_of,
)
from sceneprint_lab.evaluation.run import OFF_PLANE, PLANAR, overlaps_of, plane_share

#: Edges of the bins of true overlap (smaller direction, within 10 cm).
EDGES = (0.1, 0.3, 0.5, 0.7, 1.0)
BINS = tuple(f"{round(100 * low)}-{round(100 * high)}" for low, high in pairwise(EDGES))
#: Maximum overlap (mean of both directions) of two frames of a scene that count as negatives.
NOTHING = 0.01
#: Minimum share, among the sampled pairs of two scenes, of pairs with a planar frame.
PLANAR_SHARE = 0.25

Kind = Literal["overlapping", "same_scene", "cross_scene"]


@dataclass(frozen=True)
class Drawing:
    """Parameters for sampling pairs.

    Parameters
    ----------
    pairs : number of pairs per bin and scene, and of negatives per scene
    negatives : total number of pairs of two scenes
    apart : minimum number of frames between two frames of one sequence
    """

    pairs: int = 120
    negatives: int = 400
    apart: int = 30
    seed: int = 0


@dataclass(frozen=True)
class FrameOrigin:
    """The origin of a frame.

    Parameters
    ----------
    scene : parent frame
    run : sequence
    number : position in the sequence
    """

    scene: str
    run: str
    number: int


@dataclass(frozen=True)
class Drawn:
    """A sampled pair of frames.

    Parameters
    ----------
    query, match : indices of the frames
    kind : overlapping pair, negative pair of one scene, or negative pair of two scenes
    bin : bin of an overlapping pair; None for other pairs
    overlap_mean, overlap_least : see Overlaps; 0 for two scenes
    planar : whether one of the frames is planar
    """

    query: int
    match: int
    kind: Kind
    bin: str | None
    overlap_mean: float
    overlap_least: float
    planar: bool


def draw(
    places: Sequence[FrameOrigin], truth: Overlaps, planar: NDArray[np.bool_], p: Drawing
) -> list[Drawn]:
    """Return a sample of pairs from all bins and of both kinds of negatives.

    Each pair occurs once, with its later frame as the query. Every two scenes have equally many
    pairs, a quarter of which have a planar frame. Samples are smaller if fewer pairs exist.

    Parameters
    ----------
    places : origins of the N frames
    truth : (N, N) overlaps, 0 between scenes
    planar : (N,) mask of the frames that show mostly one plane
    p : parameters of the sample
    """
    scenes = list(dict.fromkeys(place.scene for place in places))
    of = {s: np.flatnonzero([place.scene == s for place in places]) for s in scenes}
    drawn: list[Drawn] = []
    for number, scene in enumerate(scenes):
        drawn += _of_one_scene(of[scene], places, truth, planar, p, number)
    couples = list(combinations(scenes, 2))
    for number, (a, b) in enumerate(couples):
        share = p.negatives // len(couples) + (number < p.negatives % len(couples))
        rng = np.random.default_rng((p.seed, 1, number))
        drawn += _of_two_scenes(of[a], of[b], planar, share, rng)
    return drawn


def _of_one_scene(
    own: NDArray[np.intp], places: Sequence[FrameOrigin], truth: Overlaps,
    planar: NDArray[np.bool_], p: Drawing, scene: int,
) -> list[Drawn]:  # fmt: skip
    later, earlier = np.tril_indices(len(own), -1)
    later, earlier = own[later], own[earlier]
    _, runs = np.unique([place.run for place in places], return_inverse=True)
    numbers = np.array([place.number for place in places], int)
    near = (runs[later] == runs[earlier]) & (np.abs(numbers[later] - numbers[earlier]) < p.apart)
    later, earlier = later[~near], earlier[~near]
    least, mean = truth.least[later, earlier], truth.mean[later, earlier]
    pairs = []
    choices: list[tuple[Kind, str | None, NDArray[np.bool_]]] = [
        ("overlapping", name, inside(least, name)) for name in BINS
    ]
    choices.append(("same_scene", None, (mean < NOTHING) & (least < NOTHING)))
    for number, (kind, name, good) in enumerate(choices):
        rng = np.random.default_rng((p.seed, 0, scene, number))
        for k in _sample(np.flatnonzero(good), p.pairs, rng):
            i, j = int(later[k]), int(earlier[k])
            flat = bool(planar[i] or planar[j])
            pairs.append(Drawn(i, j, kind, name, float(mean[k]), float(least[k]), flat))
    return pairs


def inside(least: Floats, name: str) -> NDArray[np.bool_]:
    """Return a mask of the overlaps in a bin; the last bin includes its upper edge."""
    low, high = list(pairwise(EDGES))[BINS.index(name)]
    return (least >= low) & ((least < high) | (high == EDGES[-1]))


def _of_two_scenes(
    a: NDArray[np.intp], b: NDArray[np.intp], planar: NDArray[np.bool_], n: int,
    rng: np.random.Generator,
) -> list[Drawn]:  # fmt: skip
    flat = (planar[a][:, None] | planar[b]).ravel()
    first = _sample(np.flatnonzero(flat), round(PLANAR_SHARE * n), rng)
    rest = np.setdiff1d(np.arange(len(flat)), first)
    chosen = np.concatenate([first, _sample(rest, n - len(first), rng)])
    return [
        Drawn(int(a[k // len(b)]), int(b[k % len(b)]), "cross_scene", None, 0.0, 0.0, bool(flat[k]))
        for k in np.sort(chosen)
    ]


def _sample(of: NDArray[np.intp], n: int, rng: np.random.Generator) -> NDArray[np.intp]:
    """Return at most n distinct random members of `of`, in ascending order."""
    return np.sort(rng.choice(of, min(n, len(of)), replace=False))


# Registration by Open3D: FPFH with RANSAC or FGR, then ICP. Each method has a standard
# configuration without tuning, works in one direction, and always returns a transform without a
# decision on acceptance. Times include the features of both frames.

T = TypeVar("T")

#: Parameters of FPFH: voxel edge, and radius and number of neighbours for normals and for features.
VOXEL, NORMALS, FEATURES = 0.05, (0.10, 30), (0.25, 100)
#: Parameters of RANSAC: maximum distance of a correspondence (metres), number of points of a
#: hypothesis, minimum ratio of edge lengths, maximum number of hypotheses, and confidence.
CORRESPONDENCE, POINTS, BASELINE_EDGES = 0.075, 3, 0.9
HYPOTHESES, CONFIDENCE = 100_000, 0.999
#: Parameter of FGR: maximum distance of a correspondence, metres; half a voxel, as in its authors'
#: example.
FGR_CORRESPONDENCE = 0.025
#: Parameters of point-to-plane ICP: voxel edge of both clouds, and maximum distance of a
#: correspondence, metres.
ICP_VOXEL, ICP_CORRESPONDENCE = 0.02, 0.05
#: The methods in the order of the tables.
METHODS = ("FPFH + RANSAC", "FPFH + FGR")
#: Minimum number of points of a cloud after downsampling.
_FEWEST = 10


class Clock:
    """A stopwatch that records the milliseconds of each stage."""

    def __init__(self) -> None:
        self.stages: dict[str, float] = {}

    def run(self, stage: str, call: Callable[[], T]) -> T:
        """Return the result of a call, and add its time to a stage."""
        start = time.perf_counter()
        result = call()
        self.stages[stage] = self.stages.get(stage, 0.0) + 1e3 * (time.perf_counter() - start)
        return result


@dataclass(frozen=True, eq=False)
class Attempt:
    """The result of a method for a pair.

    Parameters
    ----------
    start : (4, 4) T_match_query before ICP
    refined : (4, 4) T_match_query after ICP
    stages : milliseconds by stage, including the features of both frames
    """

    start: Floats
    refined: Floats
    stages: dict[str, float]

    @property
    def milliseconds(self) -> float:
        """Return the total time of all stages."""
        return sum(self.stages.values())


def points_of(frame: DepthFrame, minimum: float, maximum: float) -> Floats:
    """Return all samples of a depth image within a range, (N, 3) metres."""
    return points_at(frame, *np.nonzero((frame.depth >= minimum) & (frame.depth <= maximum)))


def register(
    query: Floats, match: Floats, o3d: Any, methods: Sequence[str] = METHODS, *, seed: int = 0,
    scale: float = 1.0,
) -> dict[str, Attempt]:  # fmt: skip
    """Register two clouds by each method; return {} if a cloud has too few points.

    Features are computed once; the time for them counts for each method.

    Parameters
    ----------
    query, match : (N, 3) metres
    o3d : module of Open3D
    methods : members of METHODS
    scale : factor of all lengths; 1 for rooms
    """
    o3r, shared = o3d.pipelines.registration, Clock()

    def search(radius: float, most: int) -> Any:
        return o3d.geometry.KDTreeSearchParamHybrid(scale * radius, most)

    clouds = [
        o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points)) for points in (query, match)
    ]
    thin = shared.run("voxel grid", lambda: [c.voxel_down_sample(scale * VOXEL) for c in clouds])
    if min(len(c.points) for c in thin) < _FEWEST:
        return {}
    shared.run("normals", lambda: [c.estimate_normals(search(*NORMALS)) for c in thin])
    features = shared.run(
        "features", lambda: [o3r.compute_fpfh_feature(c, search(*FEATURES)) for c in thin]
    )

    def ransac() -> Any:
        return o3r.registration_ransac_based_on_feature_matching(
            *thin, *features, True, scale * CORRESPONDENCE,
            o3r.TransformationEstimationPointToPoint(False), POINTS,
            [
                o3r.CorrespondenceCheckerBasedOnEdgeLength(BASELINE_EDGES),
                o3r.CorrespondenceCheckerBasedOnDistance(scale * CORRESPONDENCE),
            ],
            o3r.RANSACConvergenceCriteria(HYPOTHESES, CONFIDENCE),
        )  # fmt: skip

    def fgr() -> Any:
        option = o3r.FastGlobalRegistrationOption(
            maximum_correspondence_distance=scale * FGR_CORRESPONDENCE
        )
        return o3r.registration_fgr_based_on_feature_matching(*thin, *features, option)

    def icp(start: Floats) -> Any:
        # ICP uses denser clouds than the features do, with their own normals.
        fine = [c.voxel_down_sample(scale * ICP_VOXEL) for c in clouds]
        fine[1].estimate_normals(search(*NORMALS))
        return o3r.registration_icp(
            *fine, scale * ICP_CORRESPONDENCE, start, o3r.TransformationEstimationPointToPlane()
        )

    attempts = {}
    for name in methods:
        clock = Clock()
        clock.stages |= shared.stages
        o3d.utility.random.seed(seed)
        estimated = clock.run(name.split()[-1], ransac if name == METHODS[0] else fgr)
        start = np.array(estimated.transformation, np.float64)
        refined = clock.run("ICP", partial(icp, start))
        attempts[name] = Attempt(start, np.array(refined.transformation, np.float64), clock.stages)
    return attempts


@dataclass(frozen=True, eq=False)
class Other:
    """The errors of a baseline on a pair.

    Parameters
    ----------
    start, icp, ours : errors before refinement, after the baseline's ICP, and after our refinement
    milliseconds : time for the features of both frames, the search and the baseline's ICP
    """

    start: Error
    icp: Error
    ours: Error
    milliseconds: float


@dataclass(frozen=True, eq=False)
class Tried:
    """A sampled pair, with its validation.

    Parameters
    ----------
    drawn : sampled pair
    pair : validated pair, with `bound` if the frames overlap
    others : results of the baselines, by method; empty if there are too few points; None without
        baselines or without overlap
    milliseconds : time of our method, with the features of both frames; None if `others` is None
    """

    drawn: Drawn
    pair: ValidatedPair
    others: dict[str, Other] | None
    milliseconds: float | None


@dataclass(frozen=True, eq=False)
class Bench:
    """Data and parameters for evaluating pairs.

    Parameters
    ----------
    model : model whose parameters the baselines use
    limits : maximum error of a right transform, metres and degrees
    o3d : the Open3D module; None if there are no baselines
    """

    judging: Judge
    store: FrameStore
    model: Model
    limits: tuple[float, float]
    o3d: Any | None


def open_bench(
    store: FrameStore, model: Model, mode: Mode, seed: int, limits: tuple[float, float], *,
    baselines: bool, matching: Matching = "histograms",
) -> Bench:  # fmt: skip
    """Return a Bench for pairs of stored frames; raise MissingDependency if Open3D is missing."""
    o3d = open3d("A baseline of registration") if baselines else None
    judging = open_judge(store, mode, seed, model.parameters.validation, matching)
    return Bench(judging, store, model, limits, o3d)


def attempt(bench: Bench, task: tuple[Drawn, SignedFrame, SignedFrame]) -> Tried:
    """Return the validation of a pair and, if its frames overlap, the bound and the baselines."""
    drawn, query, match = task
    candidate = Candidate.of(match, drawn.match, drawn.overlap_mean, drawn.overlap_least)
    query_task = QueryTask(query.number, query.scene, query.pose, [], [], (candidate,))
    pair = replace(validated(bench.judging, query_task, candidate), limits=bench.limits)
    if drawn.kind != "overlapping":
        return Tried(drawn, pair, None, None)
    T = refined_from_truth(bench.judging, query_task, candidate)
    true = true_transform(query_task, candidate)
    pair = replace(pair, bound=_error(T, true))
    if bench.o3d is None:
        return Tried(drawn, pair, None, None)
    others, spent = _others(bench, bench.store.frame(query), bench.store.frame(match), true)
    return Tried(drawn, pair, others, spent + pair.milliseconds)


def _others(
    bench: Bench, query: AnyFrame, match: AnyFrame, true: Floats
) -> tuple[dict[str, Other], float]:
    """Return the errors of the baselines, and the time for our geometry of both frames, ms."""
    p = bench.model.parameters
    start = time.perf_counter()
    ours, its = (geometry_of(see(frame, p), bench.model) for frame in (query, match))
    spent = 1e3 * (time.perf_counter() - start)
    attempts = register(
        peer_points(query, bench.model), peer_points(match, bench.model), bench.o3d,
        seed=bench.judging.seed, scale=scale_of(p),
    )  # fmt: skip
    others = {}
    for name, result in attempts.items():
        refined = refined_by_us(ours, its, result.start, bench.judging.p.alignment)
        others[name] = Other(
            _error(result.start, true), _error(result.refined, true), _error(refined, true),
            result.milliseconds,
        )  # fmt: skip
    return others, spent


def scale_of(p: ModelParameters) -> float:
    """Return the ratio of a model's neighbourhood radius to the radius for rooms."""
    return p.properties.radius / PropertyParameters().radius


def peer_points(frame: AnyFrame, model: Model) -> Floats:
    """Return the points (N, 3) of a cloud, or those of a depth image that are within the range."""
    if isinstance(frame, Cloud):
        return frame.points.astype(np.float64)
    p = model.parameters.depth
    return points_of(frame, p.minimum_depth, p.maximum_depth)


def refined_by_us(
    query: Geometry, match: Geometry, T: Floats, p: AlignmentParameters
) -> Floats | None:
    """Return a baseline's transform after our coarse and fine refinements; None if they fail."""
    coarse = refine_all(query.surface, match.surface, T[None], p.coarse)
    return refine_transform(query, match, coarse[0] if len(coarse) else T, p.fine)


def _error(T: Floats | None, true: Floats) -> Error:
    return Error() if T is None else pose_error(T, true)


@dataclass(frozen=True)
class PairSettings:
    """The settings of an evaluation on pairs.

    Parameters
    ----------
    drawing : parameters of the sample
    frames : maximum number of frames per scene, evenly spaced over its recordings
    mode, matching, seed : arguments of `validate`
    limits : maximum error of a right transform, metres and degrees
    baselines : whether Open3D also registers overlapping pairs
    jobs : number of processes; only times depend on it
    cache_dir : folder for files derived from the model; None selects the user's cache folder
    """

    drawing: Drawing = field(default_factory=Drawing)
    frames: int = 300
    mode: Mode = "full"
    matching: Matching = "histograms"
    seed: int = 0
    limits: tuple[float, float] = RIGHT
    baselines: bool = False
    jobs: int = 1
    cache_dir: Path | None = None


@dataclass(frozen=True, eq=False)
class PairEvaluation:
    """The results of all pairs.

    Parameters
    ----------
    members : N usable frames, without their signatures
    limits : maximum error of a right transform, metres and degrees
    acceptance, map : parameters of the model
    planes : (N,) share of each frame's samples that lie in its largest plane
    tried : results in the order of the sample
    left_out : (name, reason) of unusable frames
    prepare_ms : median time to sign a frame and compute its geometry, milliseconds
    """

    members: list[SignedFrame]
    limits: tuple[float, float]
    acceptance: AcceptanceParameters
    planes: Floats
    tried: list[Tried]
    left_out: list[tuple[str, str]]
    prepare_ms: float | None
    map: MapParameters = field(default_factory=MapParameters)


def evaluate_pairs(
    paths: Sequence[Path], signer: Signer, store: FrameStore, settings: PairSettings,
    watch: Watch = unwatched,
) -> PairEvaluation:  # fmt: skip
    """Sample pairs by true overlap, validate them, and return the results with their errors.

    Parameters
    ----------
    paths : paths of sequences with poses; frames of different scenes are negatives
    signer : result of `open_signer`
    store : empty store
    watch : callback for progress

    Raises
    ------
    DatasetError : If no two frames can be used, or none make a pair
    MissingDependency : If baselines need Open3D, which cannot be imported
    """
    if settings.baselines:
        open3d("A baseline of registration")  # a missing library is detected before frames are read
    placed = spread(every_frame(paths), settings.frames)
    chosen = tuple(frame for frame, _ in placed)
    prepared = prepare_all(
        chosen, signer, store, jobs=settings.jobs, cache_dir=settings.cache_dir, watch=watch,
    )  # fmt: skip
    members = [replace(m, signature=np.empty(0, np.uint8)) for m in prepared.queries]
    if len(members) < 2:
        raise DatasetError(_too_few(prepared))
    parameters = signer.model.parameters
    opening_views = partial(_same, store, OFF_PLANE * scale_of(parameters))
    shares = map_over(members, _plane_share, opening_views, settings.jobs)
    planes = np.array(list(watch(shares, "planes", len(members))))
    places = [placed[member.number][1] for member in members]
    truth = _overlaps(members, store, watch)
    drawn = draw(places, truth, planes >= PLANAR, settings.drawing)
    if not drawn:
        raise DatasetError(
            f"No two of the {len(members)} frames are at least {settings.drawing.apart} frames "
            "apart and overlap either by a tenth or more, or not at all. Specify more recordings "
            "or a smaller --apart."
        )
    tasks = [(pair, members[pair.query], members[pair.match]) for pair in drawn]
    opening = partial(
        open_bench, store, signer.model, settings.mode, settings.seed, settings.limits,
        baselines=settings.baselines, matching=settings.matching,
    )  # fmt: skip
    tried = map_over(tasks, attempt, opening, settings.jobs)
    return PairEvaluation(
        members, settings.limits, parameters.validation.acceptance, planes,
        list(watch(tried, "validate", len(tasks))), prepared.left_out, prepared.milliseconds,
        signer.model.answer.map,
    )  # fmt: skip


def spread(chosen: Sequence[ProtocolFrame], most: int) -> list[tuple[ProtocolFrame, FrameOrigin]]:
    """Return at most `most` evenly spaced frames of each scene, and their origins."""
    counts: Counter[tuple[str, str]] = Counter()
    of: dict[str, list[tuple[ProtocolFrame, FrameOrigin]]] = {}
    for frame in chosen:
        run = str(frame.reference.path.parent)
        place = FrameOrigin(frame.scene, run, counts[frame.scene, run])
        counts[frame.scene, run] += 1
        of.setdefault(frame.scene, []).append((frame, place))
    return [
        own[i]
        for own in of.values()
        for i in np.linspace(0, len(own) - 1, min(most, len(own))).round().astype(int).tolist()
    ]


def _too_few(prepared: Prepared) -> str:
    usable = len(prepared.queries)
    if not prepared.left_out:
        return f"There is {usable} frame, but a pair requires two. Specify more recordings."
    name, reason = prepared.left_out[0]
    return (
        f"{usable or 'No'} frame is usable, but a pair requires two. The first omitted frame is "
        f"{name}: {reason.rstrip('.')}. Specify other recordings."
    )


def _plane_share(opened: tuple[FrameStore, float], member: SignedFrame) -> float:
    """Return the `plane_share` of a stored frame; `opened` is the store and the distance limit."""
    store, off = opened
    return plane_share(view_of(store.frame(member)).samples, off)


def _same(*opened: Any) -> tuple[Any, ...]:
    return opened


def _overlaps(members: Sequence[SignedFrame], store: FrameStore, watch: Watch) -> Overlaps:
    """Return the overlaps of all pairs of frames; 0 between scenes."""
    shape = len(members), len(members)
    mean, least = np.zeros(shape), np.zeros(shape)
    for scene in dict.fromkeys(member.scene for member in members):
        own = [i for i, member in enumerate(members) if member.scene == scene]
        of_scene = [members[i] for i in own]
        overlaps = overlaps_of(Prepared(of_scene, of_scene, [], None), store, watch)
        at = np.ix_(own, own)
        mean[at], least[at] = overlaps.mean, overlaps.least
    return Overlaps(mean, least)
