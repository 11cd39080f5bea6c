"""Read, sign and store the frames of an evaluation, for every later stage to take what it needs.

Protocol  --prepare_all-->  Member, ... and what could not be used; depth and geometry in a Store
"""

from __future__ import annotations

import math
import re
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cache, partial
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from sceneprint.errors import DatasetError, FrameError
from sceneprint.formats.artifact import read_geometry, write_geometry
from sceneprint.formats.dataset import FrameReference, find_sequences
from sceneprint.formats.dataset import FrameSequence as Run
from sceneprint.formats.dataset.sequences import natural
from sceneprint.geometry.kernel import kernel
from sceneprint.geometry.retrieval.ranking import Metric
from sceneprint.geometry.rigid import pose_difference, transform_points
from sceneprint.geometry.validation.acceptance import Strength
from sceneprint.geometry.validation.confidence import PlaceEvidence
from sceneprint.geometry.validation.validation import (
    PairValidation,
    ValidationParameters,
    rank_accepted,
)
from sceneprint.localization import LocalizationStatus
from sceneprint.models import Model
from sceneprint.models.model import AnswerParameters
from sceneprint.pipeline import Signer, open_signer, prepare
from sceneprint.types import (
    AnyFrame,
    Bytes,
    Cloud,
    DepthFrame,
    Floats,
    Floats32,
    Geometry,
    Intrinsics,
)

if TYPE_CHECKING:
    from scipy.spatial import KDTree

# What an evaluation remembers of a query: plain data, from which every figure is worked out.

#: Views of a query that are averaged, counted and drawn.
VIEWS = 5
#: A transform between rooms' frames is right within these metres and degrees.
RIGHT = (0.10, 10.0)
#: A candidate pose is of the right place within the model's distance between places, and these
#: degrees.
PLACE_DEG = 10.0
#: An answer beyond these is another place, not an inaccurate one.
GROSS = (0.50, 15.0)


@dataclass(frozen=True, eq=False)
class SignedFrame:
    """A frame that takes part and could be signed.

    Parameters
    ----------
    number : of its files in the store
    name : unique in the evaluation
    scene : its parent frame
    pose : (4, 4) T_parent_sensor
    signature : (n,) uint8
    """

    number: int
    name: str
    scene: str
    pose: Floats
    signature: Bytes


@dataclass(frozen=True)
class Error:
    """How far an estimated pose lies from the true one; infinite where there is none."""

    metres: float = math.inf
    radians: float = math.inf

    def within(self, metres: float, degrees: float) -> bool:
        """Return whether both parts are at most these."""
        return self.metres <= metres and self.radians <= math.radians(degrees)


@dataclass(frozen=True, eq=False)
class ValidatedPair:
    """A query validated against a database frame.

    Parameters
    ----------
    match : index of the database frame
    scene : of the database frame
    validation : what came of it
    same_scene : whether the match has the query's parent frame
    error : of T_match_query; infinite for another scene
    bound : error of refinement started at the true pose; None where it was not asked for
    overlap_mean, overlap_least : as in `Overlaps`; 0 for another scene
    milliseconds : that validation took
    limits : metres and degrees to which its transform is to be right
    """

    match: int
    scene: str
    validation: PairValidation
    same_scene: bool
    error: Error
    bound: Error | None
    overlap_mean: float
    overlap_least: float
    milliseconds: float
    limits: tuple[float, float] = RIGHT

    @property
    def accepted(self) -> bool:
        """Return whether the match was accepted, strong or weak."""
        return self.validation.status == "accepted"

    @property
    def right(self) -> bool:
        """Return whether the transform is right to its limits, accepted or not."""
        return self.error.within(*self.limits)


@dataclass(frozen=True, eq=False)
class JudgedPlace:
    """A candidate pose of a query, and how far off it is.

    Parameters
    ----------
    evidence : for the pose
    confidence : computed from it
    error : of the pose; infinite in another parent frame
    right : whether it is near enough to the true one to be of its place
    """

    evidence: PlaceEvidence
    confidence: float
    error: Error
    right: bool


@dataclass(frozen=True, eq=False)
class JudgedAnswer:
    """The answer to a query, and its error.

    Parameters
    ----------
    status : "found", "ambiguous" or "not_found"
    strength : "strong" or "weak"; None unless found
    error : of the pose in the map; infinite without one, and in another parent frame
    milliseconds : that the answer took, from R on
    places : that the answer was chosen from, the likeliest first
    limits : metres and degrees to which a pose is to be right; those of a depth camera by default
    """

    status: LocalizationStatus = "not_found"
    strength: Strength | None = None
    error: Error = Error()
    milliseconds: float = 0.0
    places: tuple[JudgedPlace, ...] = ()
    limits: tuple[float, float] = RIGHT

    @property
    def right(self) -> bool:
        """Return whether it is found within its limits, 10 cm and 10 degrees by default."""
        return self.status == "found" and self.error.within(*self.limits)

    @property
    def grossly_wrong(self) -> bool:
        """Return whether it is found beyond 50 cm or 15 degrees, or other limits in proportion."""
        gross = [g * limit / r for g, limit, r in zip(GROSS, self.limits, RIGHT, strict=True)]
        return self.status == "found" and not self.error.within(*gross)


@dataclass(frozen=True, eq=False)
class QueryOutcome:
    """All that is known of a query when the evaluation is done.

    Parameters
    ----------
    name, scene, pose : of the query
    allowed : (A,) rising indices of the database frames that it may find
    present : whether one of them is of the query's scene
    overlap_mean, overlap_least : (A,) with those, as in `Overlaps`
    ranking : R, indices of database frames, nearest first
    distances : (|R|,) of the ranking, as of `cross_distances`
    selection : C, in the order of R
    pairs : by index of the database frame: the first of R and all of C
    candidates : how many of R were validated
    average, average_of_ranking : errors of the pose averaged over accepted views of C and of R
    average_bound : error of the average of the same views of C, each refined from the true pose
    milliseconds : of ranking, of the selection, of averaging
    answer : the whole answer; see `answer_of`
    """

    name: str
    scene: str
    pose: Floats
    allowed: NDArray[np.intp]
    present: bool
    overlap_mean: Floats
    overlap_least: Floats
    ranking: list[int]
    distances: NDArray[np.int64]
    selection: list[int]
    pairs: dict[int, ValidatedPair]
    candidates: int
    average: Error = Error()
    average_of_ranking: Error = Error()
    average_bound: Error = Error()
    milliseconds: dict[str, float] = field(default_factory=dict)
    answer: JudgedAnswer = JudgedAnswer()

    def overlap_of(self, match: int) -> float:
        """Return the overlap with a database frame, by the definition of retrieval."""
        return float(self.overlap_mean[np.searchsorted(self.allowed, match)])

    def views(self, of: str) -> list[ValidatedPair]:
        """Return the pairs of a row in the order in which it answers with them.

        Parameters
        ----------
        of : "R" and "DR": as ranked, accepted or not; "VR" and "VDR": accepted ones, strong
            before weak
        """
        first = self.ranking[: self.candidates] if of in ("R", "VR") else self.selection
        pairs = [self.pairs[match] for match in first]
        return pairs if of in ("R", "DR") else in_preferred_order(pairs)

    def tried(self) -> list[ValidatedPair]:
        """Return all pairs of C in the order of `associate`: VDR's views, then the others."""
        first = self.views("VDR")
        return first + [pair for pair in self.views("DR") if not pair.accepted]


def in_preferred_order(pairs: Sequence[ValidatedPair]) -> list[ValidatedPair]:
    """Return accepted pairs, strong ones first: the order in which they are believed."""
    return [pairs[i] for i in rank_accepted([pair.validation for pair in pairs])]


def pose_error(T: Floats, truth: Floats) -> Error:
    """Return the difference of two (4, 4) rigid transforms between the same two frames."""
    return Error(*pose_difference(T, truth))


# How much two frames with known poses see of each other: the ground truth of retrieval.
#
# Frame or Cloud  --view_of-->  AnyView        queries, database  --overlaps-->  Overlaps

#: Spacing of the samples that are looked up in the other frame, pixels.
GRID = 20
#: Two depths agree within this, metres, plus this share of the depth.
TOLERANCE, RELATIVE_TOLERANCE = 0.05, 0.03
#: Two depths of a pair agree within this, metres: the measure that sorts pairs into bins.
PAIR_TOLERANCE = 0.10
#: Points of a cloud that are looked up in the other frame, and that are looked among, at most.
SAMPLES, POINTS = 2_000, 100_000


@dataclass(frozen=True, eq=False)
class OverlapView:
    """What overlap reads of a frame.

    Parameters
    ----------
    samples : (N, 3) metres, valid depth samples of a grid, in the parent frame
    depth : (H, W) float32, metres; 0 where missing
    intrinsics : of the depth image
    pose : (4, 4) T_parent_sensor
    """

    samples: Floats
    depth: Floats32
    intrinsics: Intrinsics
    pose: Floats


@dataclass(frozen=True, eq=False)
class CloudView:
    """What overlap reads of a cloud.

    Parameters
    ----------
    samples : (N, 3) metres, points of the cloud, in the parent frame
    points : (M, 3) of the parent frame, to find the nearest
    viewpoint : (3,) in the parent frame; None where there is none
    """

    samples: Floats
    points: KDTree
    viewpoint: Floats | None


AnyView = OverlapView | CloudView


@dataclass(frozen=True, eq=False)
class Overlaps:
    """Overlap of queries with database frames, by its two definitions.

    Parameters
    ----------
    mean : (Q, N) of retrieval: mean over both directions of the share of samples that the other
        frame sees within 5 cm + 3 % of the depth
    least : (Q, N) of pairs: the smaller direction, agreement within 10 cm

    A cloud sees a sample that has one of its points as near. As its points thin out with range,
    10 cm + 3 % of the range from its viewpoint count there.
    """

    mean: Floats
    least: Floats


def points_at(frame: DepthFrame, y: NDArray[np.intp], x: NDArray[np.intp]) -> Floats:
    """Return the points (..., 3) of some pixels of a depth image, metres, sensor frame."""
    k, z = frame.intrinsics, frame.depth[y, x].astype(np.float64)
    points: Floats = np.stack([(x - k.cx) / k.fx * z, (y - k.cy) / k.fy * z, z], axis=-1)
    return points


def view_of(frame: AnyFrame) -> AnyView:
    """Return what the overlap of a frame with a pose is computed from."""
    if frame.pose is None:
        raise ValueError(f"{frame.name} has no pose")
    if isinstance(frame, Cloud):
        return _cloud_view(frame, frame.pose)
    k = frame.intrinsics
    y, x = np.mgrid[GRID // 2 : k.height : GRID, GRID // 2 : k.width : GRID]
    points = points_at(frame, y, x)
    points = points[points[..., 2] > 0]
    return OverlapView(
        np.ascontiguousarray(transform_points(frame.pose, points)), frame.depth, k, frame.pose
    )


def _cloud_view(cloud: Cloud, pose: Floats) -> CloudView:
    from scipy.spatial import KDTree

    every = transform_points(pose, cloud.points.astype(np.float64))
    some, most = (every[:: -(-len(every) // n)] for n in (SAMPLES, POINTS))
    return CloudView(some, KDTree(most), pose[:3, 3] if cloud.has_viewpoint else None)


@kernel
def _seen(points: Floats, depth: Floats32, k: Floats, pose: Floats) -> tuple[int, int]:
    """Count the points of the parent frame that a frame sees where they are: both tolerances."""
    height, width = depth.shape
    loose = strict = 0
    for i in range(len(points)):
        dx, dy, dz = points[i, 0] - pose[0, 3], points[i, 1] - pose[1, 3], points[i, 2] - pose[2, 3]
        z = dx * pose[0, 2] + dy * pose[1, 2] + dz * pose[2, 2]
        if not z > 1e-6:
            continue
        x = np.rint((dx * pose[0, 0] + dy * pose[1, 0] + dz * pose[2, 0]) / z * k[0] + k[2])
        y = np.rint((dx * pose[0, 1] + dy * pose[1, 1] + dz * pose[2, 1]) / z * k[1] + k[3])
        if x >= 0 and x < width and y >= 0 and y < height:
            there = depth[int(y), int(x)]
            if there > 0:
                off = abs(there - z)
                loose += off < TOLERANCE + RELATIVE_TOLERANCE * z
                strict += off < PAIR_TOLERANCE
    return loose, strict


def _near(points: Floats, cloud: CloudView) -> tuple[int, int]:
    """Return of points in the parent frame, those that a cloud has a point at: both tolerances."""
    wide = np.zeros(len(points))
    if cloud.viewpoint is not None:
        wide = RELATIVE_TOLERANCE * np.linalg.norm(points - cloud.viewpoint, axis=1)
    off, _ = cloud.points.query(points, distance_upper_bound=float(wide.max()) + PAIR_TOLERANCE)
    return int((off < TOLERANCE + wide).sum()), int((off < PAIR_TOLERANCE + wide).sum())


def _shares(points: Floats, view: AnyView) -> tuple[float, float]:
    if not len(points):
        return 0.0, 0.0
    if isinstance(view, CloudView):
        loose, strict = _near(points, view)
        return loose / len(points), strict / len(points)
    k = view.intrinsics
    camera = np.array([k.fx, k.fy, k.cx, k.cy])
    loose, strict = _seen(points, view.depth, camera, view.pose)
    return loose / len(points), strict / len(points)


def overlap(a: AnyView, b: AnyView) -> tuple[float, float]:
    """Return the overlap of two frames of one parent frame: (mean, least) as in `Overlaps`."""
    there, back = _shares(a.samples, b), _shares(b.samples, a)
    return (there[0] + back[0]) / 2, min(there[1], back[1])


def overlaps(queries: Sequence[AnyView], database: Sequence[AnyView]) -> Overlaps:
    """Return the overlap of every query with every database frame of the same parent frame."""
    shares = np.array([[overlap(q, d) for d in database] for q in queries], float)
    shares = shares.reshape(len(queries), len(database), 2)
    return Overlaps(shares[..., 0], shares[..., 1])


# How far a sensor had come between two frames of one run.
#
# Member, ...  --travelled-->  metres of travel between each query and each database frame


def travelled(queries: Sequence[SignedFrame], database: Sequence[SignedFrame]) -> Floats:
    """Return the metres of path from each database frame to each query.

    The path leads through the frames of a run that take part, straight from each to the next:
    with every tenth frame alone it is a little shorter than it was.

    Parameters
    ----------
    queries, database : frames; those of one run have one name up to the last slash, and lie in
        the order of their names

    Returns
    -------
    (Q, N) metres; below 0 where the database frame is the later one, infinite for another run
    """
    along = {name: place for run in _runs((*queries, *database)) for name, place in run.items()}
    of_queries, of_database = ([_run(m) for m in members] for members in (queries, database))
    same = np.array(of_queries)[:, None] == np.array(of_database)
    there = np.array([along[m.name] for m in queries])
    here = np.array([along[m.name] for m in database])
    return np.where(same, there[:, None] - here, np.inf)


def _run(member: SignedFrame) -> str:
    return member.name.rpartition("/")[0]


def _runs(members: Sequence[SignedFrame]) -> list[dict[str, float]]:
    """Return of each run, the place of each frame on its path, metres from the first."""
    runs: dict[str, dict[str, SignedFrame]] = {}
    for member in members:
        runs.setdefault(_run(member), {})[member.name] = member
    placed = []
    for frames in runs.values():
        names = sorted(frames, key=natural)
        positions = np.array([frames[name].pose[:3, 3] for name in names])
        steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
        placed.append(dict(zip(names, np.concatenate([[0.0], np.cumsum(steps)]), strict=True)))
    return placed


# A map over tasks in this process or in several, with the same answers.
#
# tasks  --map_over-->  results, in order

S = TypeVar("S")
T = TypeVar("T")
R = TypeVar("R")


class Watch(Protocol):
    """Shows how far a stage has come: passes on what it is given."""

    def __call__(self, items: Iterable[T], stage: str, total: int) -> Iterable[T]:
        """Pass the items on, one by one."""
        ...


def unwatched(items: Iterable[T], stage: str, total: int) -> Iterable[T]:  # noqa: ARG001
    """Pass the items on and show nothing."""
    return items


def map_over(
    tasks: Sequence[T], do: Callable[[S, T], R], opening: Callable[[], S], jobs: int,
) -> Iterator[R]:  # fmt: skip
    """Do every task with what `opening` returns, which each process calls once.

    Each process holds its libraries to one thread: sums then have one order, and processes
    do not compete.

    Parameters
    ----------
    tasks : picklable, as is what comes of them
    do : a function of a module
    opening : the same, or a partial of one
    jobs : processes; 1 for this one alone

    Yields
    ------
    results : in the order of the tasks
    """
    from threadpoolctl import threadpool_limits

    jobs = min(jobs, len(tasks))
    if jobs <= 1:
        with threadpool_limits(1):
            opened = opening() if tasks else None
            for task in tasks:
                yield do(opened, task)  # type: ignore[arg-type]
        return
    context = get_context("spawn")
    with ProcessPoolExecutor(jobs, context, _start, (opening,)) as pool:
        try:
            yield from pool.map(partial(_call, do), tasks)
        finally:  # stopped half way: what is not begun is not done
            pool.shutdown(wait=True, cancel_futures=True)


#: What this process opened, if it is one of several.
_opened: list[Any] = []


def _start(opening: Callable[[], Any]) -> None:
    from threadpoolctl import threadpool_limits

    threadpool_limits(1)
    _opened[:] = [opening()]


def _call(do: Callable[[Any, Any], Any], task: Any) -> Any:
    return do(_opened[0], task)


# Which frames are the database and which the queries.
#
# PATH@db=0:600:2,queries=650:  --parse_part-->  Part  --choose-->  Protocol

Use = Literal["database", "query", "both"]

_RANGE = re.compile(r"(\d{1,9})?:(\d{1,9})?(?::(\d{1,9}))?", re.ASCII)
_OWN_RANGES = re.compile(r"(.+)@((?:db|queries)=[^@]*)", re.DOTALL)


@dataclass(frozen=True)
class Range:
    """Frames start, start + step, ... before stop; None: from the first, to the last, not said."""

    start: int | None
    stop: int | None
    step: int | None

    def __str__(self) -> str:
        ends = [self.start, self.stop, *([self.step] if self.step else [])]
        return ":".join("" if end is None else str(end) for end in ends)


Ranges = tuple[Range, ...]


@dataclass(frozen=True)
class PathRanges:
    """A path and the ranges given for it alone; None where it was not said.

    Parameters
    ----------
    path : of sequences
    database, queries : ranges over the frames of all its sequences, in order
    """

    path: Path
    database: Ranges | None = None
    queries: Ranges | None = None


@dataclass(frozen=True, eq=False)
class ProtocolFrame:
    """A frame that takes part.

    Parameters
    ----------
    name : unique in the protocol
    scene : its parent frame; frames of one scene have comparable poses
    use : database, query, or both: what it may find is then limited by the travel between
    reference : where it is
    """

    name: str
    scene: str
    use: Use
    reference: FrameReference

    def is_for(self, use: Use) -> bool:
        """Return whether the frame takes part as this."""
        return self.use in (use, "both")


@dataclass(frozen=True, eq=False)
class EvaluationProtocol:
    """The frames of an evaluation.

    Parameters
    ----------
    frames : database and queries, in the order given
    split : whether they come from TrainSplit.txt and TestSplit.txt: the paper's 7-Scenes table
    """

    frames: tuple[ProtocolFrame, ...]
    split: bool


def parse_ranges(text: str) -> Ranges:
    """Parse ranges such as 0:600, 0:600:2, 650: or 0:25+50:75.

    Raises
    ------
    DatasetError : it is none of these, a range is empty, or its step is 0.
    """
    ranges = []
    for one in text.split("+"):
        match = _RANGE.fullmatch(one.strip())
        if match is None:
            raise DatasetError(
                f"{text!r} is no range of frames. Write START:STOP or START:STOP:STEP, such as "
                "0:600:2, and join several with +, such as 0:25+50:75."
            )
        start, stop, step = (None if part is None else int(part) for part in match.groups())
        if step == 0 or (stop is not None and stop <= (start or 0)):
            raise DatasetError(
                f"{text!r} holds no frame. STOP must exceed START, and STEP be 1 up."
            )
        ranges.append(Range(start, stop, step))
    return tuple(ranges)


def parse_part(text: str) -> PathRanges:
    """Parse PATH, or PATH@db=RANGES,queries=RANGES with either of the two.

    Raises
    ------
    DatasetError : what follows the @ is not of this form.
    """
    match = _OWN_RANGES.fullmatch(text)
    if match is None:
        return PathRanges(Path(text))
    own: dict[str, Ranges] = {}
    for one in match[2].split(","):
        key, _, ranges = one.partition("=")
        if key not in ("db", "queries") or key in own:
            raise DatasetError(
                f"{text}: {one!r} is not understood. Write PATH@db=0:600:2,queries=650:1000:2."
            )
        own[key] = parse_ranges(ranges)
    return PathRanges(Path(match[1]), own.get("db"), own.get("queries"))


def choose(
    parts: Sequence[PathRanges], distractors: Sequence[Path] = (), *,
    database: Ranges | None = None, queries: Ranges | None = None, database_step: int = 1,
    query_step: int = 1, shared: bool = False,
    find: Callable[[Path], tuple[Run, ...]] = find_sequences,
) -> EvaluationProtocol:  # fmt: skip
    """Return assign the frames of each path to the database or the queries; no frame is read.

    A path's own ranges go before `database` and `queries`, and these before the split files of
    its scenes.

    Parameters
    ----------
    parts : paths, with ranges of their own or without
    distractors : paths of which every frame is in the database
    database, queries : for paths without ranges of their own
    database_step, query_step : take every so manieth frame, where a range says no step itself
    shared : a frame may be both, and paths without ranges are, as a whole, both
    find : what finds the sequences of a path; asked once for each

    Raises
    ------
    DatasetError : nothing says what is database and what query, a range lies outside its path,
        a frame is chosen twice, two scenes have one name, or there is no query.
    """
    gathered = _Gathered(shared=shared, find=find)
    every = (Range(None, None, None),)
    splits = []
    for part in parts:
        of_db, of_queries = part.database, part.queries
        if of_db is None and of_queries is None:
            of_db, of_queries = database, queries
            if shared:
                of_db, of_queries = of_db or every, of_queries or every
        splits.append(of_db is None and of_queries is None)
        if splits[-1]:
            gathered.add_split(part.path, database_step, query_step)
            continue
        gathered.add_ranges(part.path, of_db or (), "database", database_step)
        gathered.add_ranges(part.path, of_queries or (), "query", query_step)
    for path in distractors:
        gathered.add_ranges(path, every, "database", 1)
    frames = tuple(gathered.frames.values())
    wanted: tuple[tuple[Use, str], ...] = (
        ("query", "--queries"),
        ("database", "--db or --distractors"),
    )
    for use, option in wanted:
        if not any(frame.is_for(use) for frame in frames):
            raise DatasetError(
                f"No frame is chosen as {use}, so there is nothing to measure. Add {option}."
            )
    return EvaluationProtocol(frames, all(splits))


def every_frame(paths: Sequence[Path]) -> tuple[ProtocolFrame, ...]:
    """Return all frames of all paths, in order, each as a query; no frame is read.

    Raises
    ------
    DatasetError : a frame is there twice, or two scenes have one name.
    """
    places = [path.resolve() for path in paths]
    for i, place in enumerate(places):
        for j in range(i):
            if place.is_relative_to(places[j]) or places[j].is_relative_to(place):
                raise DatasetError(
                    f"{paths[i]}: Its frames are those of {paths[j]} too. Give each path once."
                )
    gathered = _Gathered()
    for path in paths:
        gathered.add_ranges(path, (Range(None, None, None),), "query", 1)
    return tuple(gathered.frames.values())


class _Gathered:
    """Frames so far, by the file they are in."""

    def __init__(
        self, *, shared: bool = False,
        find: Callable[[Path], tuple[Run, ...]] = find_sequences,
    ) -> None:  # fmt: skip
        self._shared = shared
        self._find = cache(find)
        self.frames: dict[Path, ProtocolFrame] = {}
        self._names: set[str] = set()
        self._places: dict[str, Path] = {}

    def add_split(self, path: Path, database_step: int, query_step: int) -> None:
        sequences = self._find(path)
        if not any(s.split for s in sequences):
            raise DatasetError(
                f"{path}: Nothing says which frames are the database and which the queries. "
                "Give --db and --queries, such as --db 0:600 --queries 650:1000, or put "
                "TrainSplit.txt and TestSplit.txt beside the sequences."
            )
        for scene in dict.fromkeys(s.parent_frame for s in sequences):
            own = [s for s in sequences if s.parent_frame == scene]
            train = [(s, f) for s in own if s.split == "train" for f in s.frames]
            test = [(s, f) for s in own if s.split == "test" for f in s.frames]
            self._add(path, train[::database_step], "database")
            self._add(path, test[::query_step], "query")

    def add_ranges(self, path: Path, ranges: Iterable[Range], use: Use, step: int) -> None:
        every = [(s, f) for s in self._find(path) for f in s.frames]
        for one in ranges:
            if (one.start or 0) >= len(every) or (one.stop or 0) > len(every):
                raise DatasetError(
                    f"{path}: The range {one} lies outside its {len(every)} frames. "
                    f"Choose from 0:{len(every)}."
                )
            self._add(path, every[one.start : one.stop : one.step or step], use)

    def _add(self, path: Path, new: list[tuple[Run, FrameReference]], use: Use) -> None:
        for run, reference in new:
            scene, file, place = run.parent_frame, reference.path.resolve(), run.place
            if self._places.setdefault(scene, place.resolve()) != place.resolve():
                raise DatasetError(
                    f"{path}: Another scene is called {scene} too, {self._places[scene]}. "
                    "Rename one of the folders."
                )
            known = self.frames.get(file)
            if known is not None and self._shared and known.use != use:
                self.frames[file] = replace(known, use="both")
                continue
            if known is not None:
                raise DatasetError(
                    f"{path}: {reference.name} is chosen twice, as {known.use} and as "
                    f"{use}. A frame must not be asked for itself: give ranges that do not meet."
                )
            own = reference.name.startswith(f"{scene}/")
            name = reference.name if own else f"{scene}/{reference.name}"
            if name in self._names:
                raise DatasetError(f"{path}: Two frames are called {name}. Rename one of them.")
            self._names.add(name)
            self.frames[file] = ProtocolFrame(name, scene, use, reference)


@dataclass(frozen=True)
class FrameStore:
    """A folder with what is too large to hold: depth and geometry of every frame by its number.

    Parameters
    ----------
    folder : of the files; whoever made it removes it
    """

    folder: Path

    def keep(self, number: int, frame: AnyFrame, geometry: Geometry) -> None:
        """Store a frame."""
        (self.folder / f"{number}.geometry").write_bytes(write_geometry(geometry))
        if isinstance(frame, Cloud):
            seen = "seen" if frame.has_viewpoint else "fused"
            np.save(self.folder / f"{number}.{seen}.npy", np.ascontiguousarray(frame.points))
            return
        k = frame.intrinsics
        camera = np.array([k.width, k.height, k.fx, k.fy, k.cx, k.cy])
        np.save(self.folder / f"{number}.depth.npy", np.ascontiguousarray(frame.depth))
        np.save(self.folder / f"{number}.camera.npy", camera)

    def frame(self, member: SignedFrame) -> AnyFrame:
        """Read a stored depth image or cloud, with the pose of the evaluation."""
        for has_viewpoint, seen in ((True, "seen"), (False, "fused")):
            if (path := self.folder / f"{member.number}.{seen}.npy").exists():
                return Cloud(np.load(path), has_viewpoint, member.name, member.pose)
        depth = np.load(self.folder / f"{member.number}.depth.npy")
        width, height, *rest = np.load(self.folder / f"{member.number}.camera.npy").tolist()
        camera = Intrinsics(int(width), int(height), *rest)
        return DepthFrame(depth, camera, member.name, member.pose)

    def geometry(self, number: int) -> Geometry:
        """Read the geometry of a frame, as a service would load it."""
        return read_geometry((self.folder / f"{number}.geometry").read_bytes())


@dataclass(frozen=True, eq=False)
class Prepared:
    """The frames that can be used, and why others cannot.

    Parameters
    ----------
    queries, database : in the order of the protocol
    left_out : (name, reason) of the others
    milliseconds : median time to sign a frame and work out its geometry; None without frames
    validation, metric, answer, unrelated_distance : of the model
    """

    queries: list[SignedFrame]
    database: list[SignedFrame]
    left_out: list[tuple[str, str]]
    milliseconds: float | None
    validation: ValidationParameters = field(default_factory=ValidationParameters)
    metric: Metric = "l2"
    answer: AnswerParameters = field(default_factory=AnswerParameters)
    unrelated_distance: float = math.inf


@dataclass(frozen=True, eq=False)
class _Task:
    number: int
    chosen: ProtocolFrame
    judged: bool
    length: int | None


@dataclass(frozen=True, eq=False)
class _Done:
    member: SignedFrame | None
    reason: str
    milliseconds: float


def prepare_all(
    chosen: tuple[ProtocolFrame, ...], signer: Signer, store: FrameStore, *,
    levels: int | None = None, jobs: int = 1, cache_dir: Path | None = None,
    watch: Watch = unwatched,
) -> Prepared:  # fmt: skip
    """Read, sign and store every frame.

    A frame without a pose cannot be judged, and is left out; but a database frame of a scene
    that no query is of needs none, as it is wrong wherever it lies.

    Parameters
    ----------
    chosen : see Protocol
    signer : see `open_signer`
    store : an empty one
    levels : how many levels of psi to keep, finest first; None for all, or what is stored
    jobs : processes
    cache_dir : of derived files of the model
    watch : told of each frame
    """
    scenes = {one.scene for one in chosen if one.is_for("query")}
    length = signer.model.level_length * levels if levels else None
    tasks = [_Task(i, one, one.scene in scenes, length) for i, one in enumerate(chosen)]
    # a process of its own opens the model itself: a table is too large to send
    own = signer if jobs == 1 else signer.model
    results = map_over(tasks, _prepare, partial(_open, own, cache_dir, store), jobs)
    by_use: dict[str, list[SignedFrame]] = {"query": [], "database": []}
    left_out, spent = [], []
    for one, done in zip(chosen, watch(results, "read and sign", len(tasks)), strict=True):
        if done.member is None:
            left_out.append((one.name, done.reason))
        else:
            for use in ("query", "database"):
                if one.is_for(use):
                    by_use[use].append(done.member)
            spent.append(done.milliseconds)
    median = float(np.median(spent)) if spent else None
    model = signer.model
    return Prepared(
        by_use["query"], by_use["database"], left_out, median, model.parameters.validation,
        model.metric, model.answer, model.unrelated_distance,
    )  # fmt: skip


def _open(
    model: Signer | Model, cache_dir: Path | None, store: FrameStore
) -> tuple[Signer, FrameStore]:
    return (model if isinstance(model, Signer) else open_signer(model, cache_dir)), store


def _prepare(opened: tuple[Signer, FrameStore], task: _Task) -> _Done:
    signer, store = opened
    try:
        frame = task.chosen.reference.read()
        if frame.pose is None and task.judged:
            return _Done(None, "no pose is known, so nothing can be judged by it", 0.0)
        start = time.perf_counter()
        signature, geometry = prepare(replace(frame, name=task.chosen.name), signer)
        spent = 1e3 * (time.perf_counter() - start)
    except FrameError as error:
        return _Done(None, str(error), 0.0)
    store.keep(task.number, frame, geometry)
    vector: Bytes = signature.vector[: task.length]
    # of a distractor without a pose only this is known: no other frame can be placed by it
    scene = task.chosen.name if frame.pose is None else task.chosen.scene
    pose = np.eye(4) if frame.pose is None else frame.pose
    return _Done(SignedFrame(task.number, task.chosen.name, scene, pose, vector), "", spent)
