"""Rankings, validations and answers for queries, and their errors by the reference poses."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sceneprint.geometry.registration.sequence_alignment import Matching
from sceneprint.geometry.retrieval.ranking import (
    Ints64,
    Metric,
    Ranking,
    cross_distances,
    diversify,
    pairwise_distances,
    ranking_size,
)
from sceneprint.geometry.rigid import average_poses, inverse
from sceneprint.geometry.validation.acceptance import Mode
from sceneprint.geometry.validation.confidence import compute_confidences
from sceneprint.geometry.validation.map_verification import MapParameters, looks_ahead
from sceneprint.geometry.validation.validation import (
    PairValidation,
    ValidationParameters,
    refine_transform,
)
from sceneprint.localization import PosedFrame, PoseEstimate, decide, localize, views_of_rows
from sceneprint.models.model import AnswerParameters
from sceneprint.pipeline import PairMatch, associate, validate
from sceneprint.places import LocalizationParameters, PosePrior, QueryFrame
from sceneprint.types import Bytes, Floats, Geometry
from sceneprint_lab.evaluation.protocol import (
    PLACE_DEG,
    RIGHT,
    VIEWS,
    Error,
    FrameStore,
    JudgedAnswer,
    JudgedPlace,
    SignedFrame,
    ValidatedPair,
    Watch,
    in_preferred_order,
    pose_error,
    unwatched,
)


@dataclass(frozen=True, eq=False)
class Candidate:
    """A database frame against which a query is validated.

    Parameters
    ----------
    match : index of the frame in the database
    overlap_mean, overlap_least : overlaps with the query; see Overlaps
    """

    match: int
    number: int
    scene: str
    pose: Floats
    overlap_mean: float = 0.0
    overlap_least: float = 0.0

    @classmethod
    def of(cls, frame: SignedFrame, match: int, mean: float = 0.0, least: float = 0.0) -> Candidate:
        """Return a frame of the database as a candidate."""
        return cls(match, frame.number, frame.scene, frame.pose, mean, least)


@dataclass(frozen=True, eq=False)
class QueryTask:
    """A query and its candidates.

    Parameters
    ----------
    ranking : database indices of the first members of R, in order
    selection : database indices of C, in order
    candidates : candidates of `ranking` and `selection`, without duplicates
    allowed : ascending indices of all database frames that the query may find
    retrieved : R; with None, frames of other places are not compared
    """

    number: int
    scene: str
    pose: Floats
    ranking: list[int]
    selection: list[int]
    candidates: tuple[Candidate, ...]
    allowed: NDArray[np.intp] = field(default_factory=lambda: np.empty(0, np.intp))
    retrieved: Ranking | None = None


@dataclass(frozen=True, eq=False)
class Judged:
    """The result of a QueryTask; for the fields, see QueryOutcome."""

    pairs: dict[int, ValidatedPair]
    average: Error
    average_of_ranking: Error
    average_bound: Error
    milliseconds: float
    answer: JudgedAnswer


@dataclass(frozen=True, eq=False)
class Judge:
    """Data and parameters for validating and answering queries.

    Parameters
    ----------
    geometry : function that returns the geometry of a frame, given its number in the store
    mode, seed, p, matching : arguments of `validate` for all pairs
    database : frames of the map; empty if only pairs are validated
    answer : answer parameters of the model
    confidence : minimum confidence of a pose that is found
    unrelated_distance : d0 of the model
    rendered : whether the frames of the map are views rendered from a surface
    """

    geometry: Callable[[int], Geometry]
    mode: Mode
    seed: int
    p: ValidationParameters = field(default_factory=ValidationParameters)
    matching: Matching = "histograms"
    database: Sequence[SignedFrame] = ()
    answer: AnswerParameters = field(default_factory=AnswerParameters)
    confidence: float = LocalizationParameters.confidence
    unrelated_distance: float = math.inf
    rendered: bool = False


def open_judge(
    store: FrameStore, mode: Mode, seed: int, p: ValidationParameters,
    matching: Matching = "histograms", database: Sequence[SignedFrame] = (),
    answer: AnswerParameters | None = None, unrelated_distance: float = math.inf,
) -> Judge:  # fmt: skip
    """Return a Judge for the frames of a store, which caches geometries."""
    geometry = lru_cache(128)(store.geometry)  # successive queries share candidates
    return Judge(
        geometry, mode, seed, p, matching, database, answer or AnswerParameters(),
        unrelated_distance=unrelated_distance,
    )  # fmt: skip


def views_to_average(pairs: Sequence[ValidatedPair]) -> list[ValidatedPair]:
    """Return at most VIEWS accepted views from the scene with the most strong views, strong first.

    Poses are comparable only within a scene. Ties between scenes are resolved by the number of
    accepted views, then by the rank of the first view.

    `pairs`: pairs of a query, in the order of R.
    """
    accepted = in_preferred_order(pairs)
    scenes = [pair.scene for pair in accepted]
    strong = Counter(pair.scene for pair in accepted if pair.validation.strength == "strong")
    winner = max(
        dict.fromkeys(scenes), key=lambda scene: (strong[scene], scenes.count(scene)), default=""
    )
    return [pair for pair in accepted if pair.scene == winner][:VIEWS]


def judge(judging: Judge, task: QueryTask) -> Judged:
    """Validate a query against its candidates, and estimate its pose; return results and errors.

    The bound of registration (the error after refinement from the reference pose) is computed for
    the first match of VDR and for the averaged views of C.
    """
    of = {c.match: c for c in task.candidates}
    pairs = {c.match: validated(judging, task, c) for c in task.candidates}
    selected = [pairs[match] for match in task.selection]
    views = views_to_average(selected)
    start = time.perf_counter()
    average = _average(task, of, {p.match: p.validation.T_match_query for p in views})
    spent = 1e3 * (time.perf_counter() - start)
    refined = {
        pair.match: refined_from_truth(judging, task, of[pair.match])
        for pair in (*in_preferred_order(selected)[:1], *views)
        if pair.same_scene
    }
    for match, T in refined.items():
        bound = Error() if T is None else pose_error(T, true_transform(task, of[match]))
        pairs[match] = replace(pairs[match], bound=bound)
    ranked = views_to_average([pairs[match] for match in task.ranking])
    return Judged(
        pairs, average, _average(task, of, {p.match: p.validation.T_match_query for p in ranked}),
        _average(task, of, {p.match: refined.get(p.match) for p in views}), spent,
        answer_of(judging, task),
    )  # fmt: skip


def answer_of(judging: Judge, task: QueryTask, prior: PosePrior | None = None) -> JudgedAnswer:
    """Return the answer that a service would give for the candidates of C, with its error.

    Parameters
    ----------
    judging, task : arguments of `judge`
    prior : pose that the robot expects, in a scene of the database
    """
    start = time.perf_counter()
    database = _Recording(judging, task, prior)
    frame = QueryFrame(database.query, database.first_matches())
    estimate = decide([frame], task.retrieved or database.selected, database, database.p)
    spent = 1e3 * (time.perf_counter() - start)
    if estimate is None:
        return JudgedAnswer(milliseconds=spent)
    return _judged_answer(estimate, task, database.p, spent)


class _Recording:
    """The frames that a query may find, with the interface that `localization.decide` requires."""

    def __init__(self, judging: Judge, task: QueryTask, prior: PosePrior | None) -> None:
        self._judging, self._task, self._prior = judging, task, prior
        self._allowed = set(task.allowed.tolist())
        self._poses = [frame.pose for frame in judging.database]
        # Frames that the query may not find are put into a separate scene, so that they do not
        # vote.
        self._scenes = [
            frame.scene if row in self._allowed else ""
            for row, frame in enumerate(judging.database)
        ]
        self.query = judging.geometry(task.number)
        p = replace(LocalizationParameters.of(judging.answer), confidence=judging.confidence)
        asks_elsewhere = task.retrieved is not None and judging.mode == "full"
        self.p = p if asks_elsewhere else replace(p, rivals=0)
        self.selected = _ranking_of(judging, task, sorted(task.selection, key=self._is_far))

    def first_matches(self) -> list[PairMatch]:
        """Return the matches of C, including guided matches."""
        return self._validated(
            self.selected, pose_of=lambda row: (self._scenes[row], self._poses[row])
        )

    def locate(self, frames: Sequence[QueryFrame]) -> PoseEstimate | None:
        p, agreement = self.p, self._judging.p.agreement
        ahead = [looks_ahead(self.query)] * len(self._poses)  # all frames are from one sensor
        views_of = views_of_rows(
            frames[-1].matches, self._poses, self._geometry, self._scenes, p.map, agreement, ahead,
            [self._judging.rendered] * len(self._poses),
        )  # fmt: skip
        asks_map = views_of if self._judging.mode == "full" else None
        return localize(frames, self._poses, self._scenes, asks_map, self._prior, p, agreement)

    def search(self, frame: int, validations: Mapping[int, PairValidation]) -> list[PairMatch]:  # noqa: ARG002
        return self._validated(self.selected, validations=validations)

    def posed(self, rows: Sequence[int]) -> dict[int, PosedFrame]:
        return {
            row: PosedFrame(self._scenes[row], self._poses[row], looks_ahead(seen))
            for row in rows
            if (seen := self._geometry(row)) is not None
        }

    def compare(self, rows: Sequence[int]) -> list[PairMatch]:
        return self._validated(_ranking_of(self._judging, self._task, rows), retry=False)

    def _validated(self, ranking: Ranking, **how: Any) -> list[PairMatch]:
        judging = self._judging
        return associate(
            self.query, ranking, range(len(ranking)), self._geometry, seed=judging.seed,
            p=judging.p, mode=judging.mode, matching=judging.matching, **how,
        )  # fmt: skip

    def _geometry(self, row: int) -> Geometry | None:
        if row not in self._allowed:
            return None
        return self._judging.geometry(self._judging.database[row].number)

    def _is_far(self, row: int) -> bool:
        """Return whether there is a prior and the frame is too far from it to show its surfaces."""
        prior = self._prior
        return prior is not None and not (
            self._scenes[row] == prior.parent and prior.reaches(self._poses[row], self.p.map)
        )


def _judged_answer(
    estimate: PoseEstimate, task: QueryTask, p: LocalizationParameters, spent: float
) -> JudgedAnswer:
    """Return an estimate as an answer, with the errors of its pose and of all candidate places."""

    def error_of(T: Floats) -> Error:
        return pose_error(T, task.pose) if estimate.parent == task.scene else Error()

    supported = [(place, place.evidence) for place in estimate.places if place.evidence is not None]
    confidences = compute_confidences([evidence for _, evidence in supported], p.judgement)
    places = []
    for i in sorted(range(len(supported)), key=lambda i: -confidences[i]):
        place, evidence = supported[i]
        error = error_of(place.T)
        right = error.within(p.map.place_m, PLACE_DEG)
        places.append(JudgedPlace(evidence, confidences[i], error, right))
    # The error limit is proportional to `place_m`, so it is larger for scans.
    limits = RIGHT[0] * p.map.place_m / MapParameters.place_m, RIGHT[1]
    error = Error() if estimate.average is None else error_of(estimate.average.T)
    return JudgedAnswer(estimate.status, estimate.strength, error, spent, tuple(places), limits)


def _ranking_of(judging: Judge, task: QueryTask, rows: Sequence[int]) -> Ranking:
    """Return database rows as a ranking, with their distances in R; d0 for rows outside R."""
    index = np.array(rows, np.intp)
    distances = np.full(len(index), judging.unrelated_distance)
    if task.retrieved is not None:
        distance_of = dict(
            zip(task.retrieved.indices.tolist(), task.retrieved.distances.tolist(), strict=True)
        )
        distances = np.array([distance_of.get(row, judging.unrelated_distance) for row in rows])
    similarities = np.clip(1.0 - distances / judging.unrelated_distance, 0.0, 1.0)
    whole = np.where(np.isfinite(distances), distances, 0.0).astype(np.int64)
    return Ranking(index, whole, np.nan_to_num(similarities))


def true_transform(task: QueryTask, candidate: Candidate) -> Floats:
    """Return T_match_query (4, 4) according to the reference poses."""
    T: Floats = inverse(candidate.pose) @ task.pose
    return T


def validated(judging: Judge, task: QueryTask, candidate: Candidate) -> ValidatedPair:
    """Validate a query against a candidate; return the result with its error."""
    query, match = judging.geometry(task.number), judging.geometry(candidate.number)
    start = time.perf_counter()
    validation = validate(query, match, judging.seed, judging.p, judging.mode, judging.matching)
    spent = 1e3 * (time.perf_counter() - start)
    same, T = candidate.scene == task.scene, validation.T_match_query
    return ValidatedPair(
        match=candidate.match, scene=candidate.scene, validation=validation, same_scene=same,
        error=pose_error(T, true_transform(task, candidate)) if same and T is not None else Error(),
        bound=None, overlap_mean=candidate.overlap_mean, overlap_least=candidate.overlap_least,
        milliseconds=spent,
    )  # fmt: skip


def refined_from_truth(judging: Judge, task: QueryTask, candidate: Candidate) -> Floats | None:
    """Return T_match_query (4, 4) after refinement from the reference pose; None if it fails."""
    query, match = judging.geometry(task.number), judging.geometry(candidate.number)
    return refine_transform(query, match, true_transform(task, candidate), judging.p.alignment.fine)


def _average(
    task: QueryTask, of: dict[int, Candidate], transforms: dict[int, Floats | None]
) -> Error:
    """Return the error of the poses averaged over candidates; infinite if no transform is known."""
    poses = [of[match].pose @ T for match, T in transforms.items() if T is not None]
    if not poses or any(of[match].scene != task.scene for match in transforms):
        return Error()
    return pose_error(average_poses(np.stack(poses)).T, task.pose)


# R and C of all queries, from stored signatures.

#: Number of queries whose distances are computed together.
BLOCK = 64
#: Number of queries for which distances within R are computed again, to measure the time.
TIMED = 3


@dataclass(frozen=True, eq=False)
class Ranked:
    """R and C of one query.

    Parameters
    ----------
    ranking : R: database indices, nearest first
    distances : (|R|,) distances of R; see `cross_distances`
    selection : C, in the order of R
    milliseconds : times of `rank` (scan and sort), `diversify` and, for some queries,
        `compare_ranking`
    """

    ranking: list[int]
    distances: Ints64
    selection: list[int]
    milliseconds: dict[str, float]

    @property
    def retrieved(self) -> Ranking:
        """Return R as a Ranking without similarities."""
        return Ranking(np.array(self.ranking, np.intp), self.distances, np.zeros(len(self.ranking)))


def rank(
    queries: Bytes, database: Bytes, allowed: NDArray[np.bool_], *, metric: Metric,
    candidates: int = 10, watch: Watch = unwatched,
) -> list[Ranked]:  # fmt: skip
    """Return the ranking and the selection of each query.

    Parameters
    ----------
    queries : (Q, n) uint8
    database : (N, n) uint8
    allowed : (Q, N) mask of the frames that a query may find
    metric : l1 or l2
    candidates : size of C
    watch : callback for progress

    Returns
    -------
    ranked : results of the Q queries; the lists of a query that may find no frame are empty
    """
    size = max((ranking_size(int(n)) for n in allowed.sum(axis=1)), default=0)
    # Compute the distances of all pairs of the database once if there are fewer of them than pairs
    # in all rankings.
    whole = len(database) ** 2 <= len(queries) * size**2
    among = pairwise_distances(database, metric) if whole and len(queries) else None
    rows = _rows(queries, database, metric)
    rankings = []
    for i, (row, spent) in enumerate(watch(rows, "rank", len(queries))):
        start = time.perf_counter()
        index = np.flatnonzero(allowed[i])
        order = np.argsort(row[index], kind="stable")  # sort ties by index
        ranking = index[order[: ranking_size(len(index))]]
        ms = {"rank": spent + 1e3 * (time.perf_counter() - start)}
        start = time.perf_counter()
        if among is None or i < TIMED:
            within = pairwise_distances(database[ranking], metric)
            ms["compare_ranking"] = 1e3 * (time.perf_counter() - start)
        else:
            within = among[np.ix_(ranking, ranking)]
        start = time.perf_counter()
        selection = diversify(row[ranking], within, candidates)
        ms["diversify"] = 1e3 * (time.perf_counter() - start)
        chosen = ranking[selection.indices]
        rankings.append(Ranked(ranking.tolist(), row[ranking], chosen.tolist(), ms))
    return rankings


def _rows(queries: Bytes, database: Bytes, metric: Metric) -> Iterable[tuple[Ints64, float]]:
    """Yield each query's distances (N,) from the database, and the time for them, milliseconds."""
    for begin in range(0, len(queries), BLOCK):
        start = time.perf_counter()
        block = cross_distances(queries[begin : begin + BLOCK], database, metric)
        spent = 1e3 * (time.perf_counter() - start) / len(block)
        for row in block:
            yield row, spent
