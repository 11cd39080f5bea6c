"""The frames of an evaluation: their selection, signatures, storage and overlaps.

Protocol  --prepare_all-->  Prepared; depth and geometry in a FrameStore
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

# The results of queries, from which all figures are computed.

#: Maximum number of a query's views that are averaged, counted and drawn.
VIEWS = 5
#: Maximum error of a right transform between frames of rooms, metres and degrees.
RIGHT = (0.10, 10.0)
#: Maximum rotation error of a pose at the right place, degrees. The maximum translation error is
#: the model's parameter `place_m`.
PLACE_DEG = 10.0
#: An answer is grossly wrong if an error exceeds these limits, metres and degrees.
GROSS = (0.50, 15.0)


@dataclass(frozen=True, eq=False)
class SignedFrame:
    """A signed frame of an evaluation.

    Parameters
    ----------
    name : name, unique in the evaluation
    scene : parent frame
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
    """The error of an estimated pose; infinite if there is no estimate."""

    metres: float = math.inf
    radians: float = math.inf

    def within(self, metres: float, degrees: float) -> bool:
        """Return whether both errors are within the limits."""
        return self.metres <= metres and self.radians <= math.radians(degrees)


@dataclass(frozen=True, eq=False)
class ValidatedPair:
    """The validation of a query against a database frame.

    Parameters
    ----------
    match : index of the database frame
    validation : result of the validation
    same_scene : whether the match is in the query's scene
    error : error of T_match_query; infinite for another scene
    bound : error after refinement from the reference pose; None unless computed
    overlap_mean, overlap_least : see Overlaps; 0 for another scene
    milliseconds : time of the validation
    limits : maximum error of a right transform, metres and degrees
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
        """Return whether the error is within `limits`, accepted or not."""
        return self.error.within(*self.limits)


@dataclass(frozen=True, eq=False)
class JudgedPlace:
    """A candidate pose of a query, and its error.

    Parameters
    ----------
    error : error of the pose; infinite in another parent frame
    right : whether the pose is at the right place
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
    error : error of the pose; infinite if there is no pose, or if it is in another parent frame
    milliseconds : time for the answer, without the ranking
    places : candidate places, most likely first
    limits : maximum error of a right pose, metres and degrees; the default is for depth cameras
    """

    status: LocalizationStatus = "not_found"
    strength: Strength | None = None
    error: Error = Error()
    milliseconds: float = 0.0
    places: tuple[JudgedPlace, ...] = ()
    limits: tuple[float, float] = RIGHT

    @property
    def right(self) -> bool:
        """Return whether the status is `found` and the error is within `limits`."""
        return self.status == "found" and self.error.within(*self.limits)

    @property
    def grossly_wrong(self) -> bool:
        """Return whether the pose was found, but its error exceeds GROSS, scaled like `limits`."""
        gross = [g * limit / r for g, limit, r in zip(GROSS, self.limits, RIGHT, strict=True)]
        return self.status == "found" and not self.error.within(*gross)


@dataclass(frozen=True, eq=False)
class QueryOutcome:
    """The results of a query.

    Parameters
    ----------
    name, scene, pose : name, scene and pose of the query
    allowed : (A,) ascending indices of the database frames that the query may find
    present : whether any allowed frame is in the query's scene
    overlap_mean, overlap_least : (A,) overlaps with the allowed frames; see Overlaps
    ranking : R: indices of database frames, nearest first
    distances : (|R|,) distances of R; see `cross_distances`
    selection : C, in the order of R
    pairs : validated pairs with the first members of R and all of C, by index of the database frame
    candidates : number of members of R that were validated
    average, average_of_ranking : errors of the poses averaged over accepted views of C, and of R
    average_bound : error of the average over the same views of C after refinement from the
        reference pose
    milliseconds : times of ranking, selection and averaging
    answer : complete answer; see `answer_of`
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
        """Return the overlap (`Overlaps.mean`) with an allowed database frame."""
        return float(self.overlap_mean[np.searchsorted(self.allowed, match)])

    def views(self, of: str) -> list[ValidatedPair]:
        """Return the pairs of a row of the table, in the order of the row.

        `of`: "R" and "DR" for all pairs in the order of R; "VR" and "VDR" for accepted pairs,
        strong before weak.
        """
        first = self.ranking[: self.candidates] if of in ("R", "VR") else self.selection
        pairs = [self.pairs[match] for match in first]
        return pairs if of in ("R", "DR") else in_preferred_order(pairs)

    def tried(self) -> list[ValidatedPair]:
        """Return all pairs of C in the order of `associate`: views of VDR, then the other pairs."""
        first = self.views("VDR")
        return first + [pair for pair in self.views("DR") if not pair.accepted]


def in_preferred_order(pairs: Sequence[ValidatedPair]) -> list[ValidatedPair]:
    """Return the accepted pairs, strong pairs first."""
    return [pairs[i] for i in rank_accepted([pair.validation for pair in pairs])]


def pose_error(T: Floats, truth: Floats) -> Error:
    """Return the difference between two rigid transforms (4, 4) of the same frames."""
    return Error(*pose_difference(T, truth))


# The overlap of frames by their reference poses, which defines whether retrieval is correct.
#
# Frame or Cloud  --view_of-->  AnyView        queries, database  --overlaps-->  Overlaps

#: Spacing of the samples that are looked up in the other frame, pixels.
GRID = 20
#: Depth tolerance of `Overlaps.mean`: metres plus a share of the depth.
TOLERANCE, RELATIVE_TOLERANCE = 0.05, 0.03
#: Depth tolerance of `Overlaps.least`, metres.
PAIR_TOLERANCE = 0.10
#: Maximum number of samples of a cloud, and of points in which samples are looked up.
SAMPLES, POINTS = 2_000, 100_000


@dataclass(frozen=True, eq=False)
class OverlapView:
    """A depth image, prepared for computing overlaps.

    Parameters
    ----------
    samples : (N, 3) valid samples of a grid in the parent frame, metres
    depth : (H, W) float32, metres; 0 if missing
    pose : (4, 4) T_parent_sensor
    """

    samples: Floats
    depth: Floats32
    intrinsics: Intrinsics
    pose: Floats


@dataclass(frozen=True, eq=False)
class CloudView:
    """A cloud, prepared for computing overlaps.

    Parameters
    ----------
    samples : (N, 3) points to look up in the other frame, in the parent frame, metres
    points : tree of the points (M, 3) in which samples are looked up, in the parent frame, metres
    viewpoint : (3,) viewpoint in the parent frame, if there is one
    """

    samples: Floats
    points: KDTree
    viewpoint: Floats | None


AnyView = OverlapView | CloudView


@dataclass(frozen=True, eq=False)
class Overlaps:
    """The overlaps of queries with database frames, by two definitions.

    Parameters
    ----------
    mean : (Q, N) for retrieval: share of samples that the other frame sees within 5 cm + 3 % of the
        depth, averaged over both directions
    least : (Q, N) for pairs: the same share within 10 cm, in the direction with the smaller share

    A cloud sees a sample if one of its points is within the tolerance. For clouds, both tolerances
    include 3 % of the range, because the distance between points grows with range.
    """

    mean: Floats
    least: Floats


def points_at(frame: DepthFrame, y: NDArray[np.intp], x: NDArray[np.intp]) -> Floats:
    """Return the points (..., 3) at pixels of a depth image, metres, in the sensor's frame."""
    k, z = frame.intrinsics, frame.depth[y, x].astype(np.float64)
    points: Floats = np.stack([(x - k.cx) / k.fx * z, (y - k.cy) / k.fy * z, z], axis=-1)
    return points


def view_of(frame: AnyFrame) -> AnyView:
    """Return a frame as a view for `overlap`; raise ValueError if it has no pose."""
    if frame.pose is None:
        raise ValueError(f"{frame.name} has no pose. Pass frames with poses.")
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
def _count_seen(points: Floats, depth: Floats32, k: Floats, pose: Floats) -> tuple[int, int]:
    """Return how many points (N, 3) a depth image sees, within the loose and strict tolerance."""
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


def _count_near(points: Floats, cloud: CloudView) -> tuple[int, int]:
    """Return how many points (N, 3) a cloud sees within the loose and the strict tolerance."""
    wide = np.zeros(len(points))
    if cloud.viewpoint is not None:
        wide = RELATIVE_TOLERANCE * np.linalg.norm(points - cloud.viewpoint, axis=1)
    off, _ = cloud.points.query(points, distance_upper_bound=float(wide.max()) + PAIR_TOLERANCE)
    return int((off < TOLERANCE + wide).sum()), int((off < PAIR_TOLERANCE + wide).sum())


def _shares(points: Floats, view: AnyView) -> tuple[float, float]:
    """Return the shares of points (N, 3) that a frame sees, loosely and strictly."""
    if not len(points):
        return 0.0, 0.0
    if isinstance(view, CloudView):
        loose, strict = _count_near(points, view)
        return loose / len(points), strict / len(points)
    k = view.intrinsics
    camera = np.array([k.fx, k.fy, k.cx, k.cy])
    loose, strict = _count_seen(points, view.depth, camera, view.pose)
    return loose / len(points), strict / len(points)


def overlap(a: AnyView, b: AnyView) -> tuple[float, float]:
    """Return the overlaps (mean, least) of two frames in one parent frame; see Overlaps."""
    there, back = _shares(a.samples, b), _shares(b.samples, a)
    return (there[0] + back[0]) / 2, min(there[1], back[1])


def overlaps(queries: Sequence[AnyView], database: Sequence[AnyView]) -> Overlaps:
    """Return the overlaps of all queries with all database frames, in the same parent frame."""
    shares = np.array([[overlap(q, d) for d in database] for q in queries], float)
    shares = shares.reshape(len(queries), len(database), 2)
    return Overlaps(shares[..., 0], shares[..., 1])


# The distance that a sensor travelled between two frames of a run.
#
# SignedFrame, ...  --travelled-->  length of the path between each query and each database frame


def travelled(queries: Sequence[SignedFrame], database: Sequence[SignedFrame]) -> Floats:
    """Return the length of the path from each database frame to each query.

    The path consists of straight lines between the frames of the evaluation, so it is too short if
    the frames are sparse. The names of frames of one run are equal up to the last slash, and sort
    in chronological order.

    Returns
    -------
    (Q, N) metres; negative if the database frame is later, infinite for another run
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
    """Return, for each run, the path length from its first frame to each frame, by name, metres."""
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


# Computations in one or several processes, with the same results.
#
# tasks  --map_over-->  results, in order

S = TypeVar("S")
T = TypeVar("T")
R = TypeVar("R")


class Watch(Protocol):
    """A function that shows progress during an iteration."""

    def __call__(self, items: Iterable[T], stage: str, total: int) -> Iterable[T]:
        """Return an iterable of the items that shows progress."""
        ...


def unwatched(items: Iterable[T], stage: str, total: int) -> Iterable[T]:  # noqa: ARG001
    """Return the items without showing progress."""
    return items


def map_over(
    tasks: Sequence[T], do: Callable[[S, T], R], opening: Callable[[], S], jobs: int,
) -> Iterator[R]:  # fmt: skip
    """Yield `do(opened, task)` for all tasks; each process computes `opened = opening()` once.

    Libraries use one thread per process, so that the order of summation is fixed and processes do
    not compete.

    Parameters
    ----------
    tasks : picklable tasks whose results are picklable
    do : function of a module
    opening : function of a module, or a partial of such a function
    jobs : number of processes; 1 uses this process

    Yields
    ------
    results : results in the order of the tasks
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
        finally:  # cancel pending tasks if the iterator is abandoned
            pool.shutdown(wait=True, cancel_futures=True)


#: Result of `opening` in this process of the pool.
_opened: list[Any] = []


def _start(opening: Callable[[], Any]) -> None:
    from threadpoolctl import threadpool_limits

    threadpool_limits(1)
    _opened[:] = [opening()]


def _call(do: Callable[[Any, Any], Any], task: Any) -> Any:
    return do(_opened[0], task)


# The selection of database frames and queries.
#
# PATH@db=0:600:2,queries=650:  --parse_part-->  Part  --choose-->  Protocol

Use = Literal["database", "query", "both"]

_RANGE = re.compile(r"(\d{1,9})?:(\d{1,9})?(?::(\d{1,9}))?", re.ASCII)
_OWN_RANGES = re.compile(r"(.+)@((?:db|queries)=[^@]*)", re.DOTALL)


@dataclass(frozen=True)
class Range:
    """Frames start, start + step, ... before stop; None: first frame, end, default step."""

    start: int | None
    stop: int | None
    step: int | None

    def __str__(self) -> str:
        ends = [self.start, self.stop, *([self.step] if self.step else [])]
        return ":".join("" if end is None else str(end) for end in ends)


Ranges = tuple[Range, ...]


@dataclass(frozen=True)
class PathRanges:
    """A path and its ranges.

    `database`, `queries`: ranges over the frames of all sequences, in order; None if unspecified.
    """

    path: Path
    database: Ranges | None = None
    queries: Ranges | None = None


@dataclass(frozen=True, eq=False)
class ProtocolFrame:
    """A selected frame.

    Parameters
    ----------
    name : name, unique in the protocol
    scene : parent frame; poses of one scene are comparable
    use : database, query, or both, for evaluations that exclude frames by distance of travel
    reference : location of the frame in its sequence
    """

    name: str
    scene: str
    use: Use
    reference: FrameReference

    def is_for(self, use: Use) -> bool:
        """Return whether the frame is a query or a database frame, as `use` specifies."""
        return self.use in (use, "both")


@dataclass(frozen=True, eq=False)
class EvaluationProtocol:
    """The frames of an evaluation.

    Parameters
    ----------
    frames : database frames and queries, in the order of the arguments
    split : whether TrainSplit.txt and TestSplit.txt selected the frames, as for the paper's
        7-Scenes table
    """

    frames: tuple[ProtocolFrame, ...]
    split: bool


def parse_ranges(text: str) -> Ranges:
    """Parse ranges such as 0:600, 0:600:2, 650: or 0:25+50:75.

    Raise DatasetError if the text does not consist of ranges, a range is empty, or a step is 0.
    """
    ranges = []
    for part in text.split("+"):
        match = _RANGE.fullmatch(part.strip())
        if match is None:
            raise DatasetError(
                f"{text!r} is not a range of frames. Write START:STOP or START:STOP:STEP, such as "
                "0:600:2, and join several with +, such as 0:25+50:75."
            )
        start, stop, step = (None if part is None else int(part) for part in match.groups())
        if step == 0 or (stop is not None and stop <= (start or 0)):
            raise DatasetError(
                f"{text!r} contains no frame. Use a STOP above START, and a STEP of at least 1."
            )
        ranges.append(Range(start, stop, step))
    return tuple(ranges)


def parse_part(text: str) -> PathRanges:
    """Parse PATH, PATH@db=RANGES, PATH@queries=RANGES or PATH@db=RANGES,queries=RANGES.

    Raise DatasetError if the part after the @ does not have this form.
    """
    match = _OWN_RANGES.fullmatch(text)
    if match is None:
        return PathRanges(Path(text))
    own: dict[str, Ranges] = {}
    for part in match[2].split(","):
        key, _, ranges = part.partition("=")
        if key not in ("db", "queries") or key in own:
            raise DatasetError(
                f"{text}: {part!r} is invalid. Write PATH@db=0:600:2,queries=650:1000:2."
            )
        own[key] = parse_ranges(ranges)
    return PathRanges(Path(match[1]), own.get("db"), own.get("queries"))


def choose(
    parts: Sequence[PathRanges], distractors: Sequence[Path] = (), *,
    database: Ranges | None = None, queries: Ranges | None = None, database_step: int = 1,
    query_step: int = 1, shared: bool = False,
    find: Callable[[Path], tuple[Run, ...]] = find_sequences,
) -> EvaluationProtocol:  # fmt: skip
    """Assign the frames of paths to the database or to the queries, without reading frames.

    The ranges of a path have precedence over `database` and `queries`, which have precedence over
    the split files of its scenes.

    Parameters
    ----------
    parts : paths with optional ranges
    distractors : paths whose frames all belong to the database
    database, queries : ranges for paths without ranges
    database_step, query_step : step for ranges that do not have one
    shared : whether frames may have both uses; if so, frames of paths without ranges have both
    find : function that returns the sequences of a path; it is called once per path

    Raises
    ------
    DatasetError : If the use of a path's frames is unspecified, a range lies outside its path, a
        frame is selected twice, two scenes have the same name, or there is no query
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
                f"No frame is selected as {use}, so nothing can be measured. Add {option}."
            )
    return EvaluationProtocol(frames, all(splits))


def every_frame(paths: Sequence[Path]) -> tuple[ProtocolFrame, ...]:
    """Return all frames of all paths, in order, as queries, without reading frames.

    Raise DatasetError if a frame occurs twice, or two scenes have the same name.
    """
    places = [path.resolve() for path in paths]
    for i, place in enumerate(places):
        for j in range(i):
            if place.is_relative_to(places[j]) or places[j].is_relative_to(place):
                raise DatasetError(
                    f"{paths[i]}: the path contains the same frames as {paths[j]}. Specify each "
                    "path once."
                )
    gathered = _Gathered()
    for path in paths:
        gathered.add_ranges(path, (Range(None, None, None),), "query", 1)
    return tuple(gathered.frames.values())


class _Gathered:
    """The selected frames, by file."""

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
        """Add the frames that a path's split files select; raise DatasetError if there are none."""
        sequences = self._find(path)
        if not any(s.split for s in sequences):
            raise DatasetError(
                f"{path}: the database and the queries are not specified. Add --db and --queries, "
                "such as --db 0:600 --queries 650:1000, or put TrainSplit.txt and TestSplit.txt "
                "beside the sequences."
            )
        for scene in dict.fromkeys(s.parent_frame for s in sequences):
            own = [s for s in sequences if s.parent_frame == scene]
            train = [(s, f) for s in own if s.split == "train" for f in s.frames]
            test = [(s, f) for s in own if s.split == "test" for f in s.frames]
            self._add(path, train[::database_step], "database")
            self._add(path, test[::query_step], "query")

    def add_ranges(self, path: Path, ranges: Iterable[Range], use: Use, step: int) -> None:
        """Add the frames of a path in `ranges`; raise DatasetError if a range lies outside it."""
        every = [(s, f) for s in self._find(path) for f in s.frames]
        for part in ranges:
            if (part.start or 0) >= len(every) or (part.stop or 0) > len(every):
                raise DatasetError(
                    f"{path}: the range {part} lies outside the {len(every)} frames. Select a "
                    f"range within 0:{len(every)}."
                )
            self._add(path, every[part.start : part.stop : part.step or step], use)

    def _add(self, path: Path, new: list[tuple[Run, FrameReference]], use: Use) -> None:
        """Add frames, or, if shared, second uses of them; raise DatasetError for duplicates."""
        for run, reference in new:
            scene, file, place = run.parent_frame, reference.path.resolve(), run.place
            if self._places.setdefault(scene, place.resolve()) != place.resolve():
                raise DatasetError(
                    f"{path}: another scene, {self._places[scene]}, also has the name {scene}. "
                    "Rename one of the folders."
                )
            earlier = self.frames.get(file)
            if earlier is not None and self._shared and earlier.use != use:
                self.frames[file] = replace(earlier, use="both")
                continue
            if earlier is not None:
                raise DatasetError(
                    f"{path}: {reference.name} is selected twice, as {earlier.use} and as {use}, "
                    "but a query must not find itself. Specify ranges that do not overlap."
                )
            own = reference.name.startswith(f"{scene}/")
            name = reference.name if own else f"{scene}/{reference.name}"
            if name in self._names:
                raise DatasetError(f"{path}: two frames have the name {name}. Rename one of them.")
            self._names.add(name)
            self.frames[file] = ProtocolFrame(name, scene, use, reference)


@dataclass(frozen=True)
class FrameStore:
    """A folder of the depth and geometry of frames, by number, which would not fit into memory.

    `folder`: folder of the files; the caller removes it.
    """

    folder: Path

    def keep(self, number: int, frame: AnyFrame, geometry: Geometry) -> None:
        """Store the depth image or the points of a frame, and its geometry."""
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
        """Read a stored depth image or cloud, with the pose that the evaluation uses."""
        for has_viewpoint, seen in ((True, "seen"), (False, "fused")):
            if (path := self.folder / f"{member.number}.{seen}.npy").exists():
                return Cloud(np.load(path), has_viewpoint, member.name, member.pose)
        depth = np.load(self.folder / f"{member.number}.depth.npy")
        width, height, *rest = np.load(self.folder / f"{member.number}.camera.npy").tolist()
        camera = Intrinsics(int(width), int(height), *rest)
        return DepthFrame(depth, camera, member.name, member.pose)

    def geometry(self, number: int) -> Geometry:
        """Read the geometry of a frame by its number."""
        return read_geometry((self.folder / f"{number}.geometry").read_bytes())


@dataclass(frozen=True, eq=False)
class Prepared:
    """The signed frames of an evaluation, and the reasons why other frames are unusable.

    Parameters
    ----------
    queries, database : frames in the order of the protocol
    left_out : (name, reason) of unusable frames
    milliseconds : median time to sign a frame and compute its geometry; None without frames
    validation, metric, answer, unrelated_distance : parameters of the model
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
    """Read, sign and store all frames; return the signed ones, and the reasons for the others.

    Frames without a pose are omitted, because errors cannot be computed for them, except database
    frames of scenes without queries, which are wrong for any query.

    Parameters
    ----------
    chosen : frames of a protocol
    signer : result of `open_signer`
    store : empty store
    levels : number of levels of psi, finest first; None selects all levels or, if the model
        whitens, stored signatures
    jobs : number of processes
    cache_dir : folder of derived files of the model
    watch : callback for progress
    """
    scenes = {frame.scene for frame in chosen if frame.is_for("query")}
    length = signer.model.level_length * levels if levels else None
    tasks = [_Task(i, frame, frame.scene in scenes, length) for i, frame in enumerate(chosen)]
    # The signer's table is too large to send to other processes, so they open the model.
    own = signer if jobs == 1 else signer.model
    results = map_over(tasks, _prepare, partial(_open, own, cache_dir, store), jobs)
    by_use: dict[str, list[SignedFrame]] = {"query": [], "database": []}
    left_out, spent = [], []
    for frame, done in zip(chosen, watch(results, "read and sign", len(tasks)), strict=True):
        if done.member is None:
            left_out.append((frame.name, done.reason))
        else:
            for use in ("query", "database"):
                if frame.is_for(use):
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
    """Return a signer for the model, and the store."""
    return (model if isinstance(model, Signer) else open_signer(model, cache_dir)), store


def _prepare(opened: tuple[Signer, FrameStore], task: _Task) -> _Done:
    """Read, sign and store a frame; return the reason if it is unusable."""
    signer, store = opened
    try:
        frame = task.chosen.reference.read()
        if frame.pose is None and task.judged:
            return _Done(None, "its pose is unknown, so no error can be computed", 0.0)
        start = time.perf_counter()
        signature, geometry = prepare(replace(frame, name=task.chosen.name), signer)
        spent = 1e3 * (time.perf_counter() - start)
    except FrameError as error:
        return _Done(None, str(error), 0.0)
    store.keep(task.number, frame, geometry)
    vector: Bytes = signature.vector[: task.length]
    # A distractor without a pose gets its own scene.
    scene = task.chosen.name if frame.pose is None else task.chosen.scene
    pose = np.eye(4) if frame.pose is None else frame.pose
    return _Done(SignedFrame(task.number, task.chosen.name, scene, pose, vector), "", spent)
