"""Validate a query against its candidates, and judge the results by the true poses."""

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
    """A database frame that a query is to be validated against.

    Parameters
    ----------
    match : its index in the database
    number : of its files in the store
    scene, pose : as in Member
    overlap_mean, overlap_least : with the query
    """

    match: int
    number: int
    scene: str
    pose: Floats
    overlap_mean: float = 0.0
    overlap_least: float = 0.0

    @classmethod
    def of(cls, frame: SignedFrame, match: int, mean: float = 0.0, least: float = 0.0) -> Candidate:
        """Return the candidate that a frame of the database is, with its overlaps."""
        return cls(match, frame.number, frame.scene, frame.pose, mean, least)


@dataclass(frozen=True, eq=False)
class QueryTask:
    """One query with its candidates.

    Parameters
    ----------
    number : of the query's files in the store
    scene, pose : of the query
    ranking : database indices of the first of R, in order
    selection : those of C, in order
    candidates : all of both, each once
    allowed : rising indices of all database frames that it may find
    retrieved : R; without it no frames elsewhere are compared before a pose is found
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
    """The result of a task; fields as in QueryOutcome."""

    pairs: dict[int, ValidatedPair]
    average: Error
    average_of_ranking: Error
    average_bound: Error
    milliseconds: float
    answer: JudgedAnswer


@dataclass(frozen=True, eq=False)
class Judge:
    """What a process needs to validate.

    Parameters
    ----------
    geometry : gives that of a frame by its number in the store
    mode : see `validate`
    seed : of every pair, as a service has one for all that it validates
    p : of the model
    matching : see `validate`
    database : the frames of the map; empty where only pairs are validated
    answer : of the model
    confidence : least of a pose that is found
    unrelated_distance : of the model, by which distances are similarities
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
    """Return a judge of the frames of a store."""
    geometry = lru_cache(128)(store.geometry)  # neighbouring queries have common candidates
    return Judge(
        geometry, mode, seed, p, matching, database, answer or AnswerParameters(),
        unrelated_distance=unrelated_distance,
    )  # fmt: skip


def views_to_average(pairs: Sequence[ValidatedPair]) -> list[ValidatedPair]:
    """Return the first accepted views of one scene, strong ones first.

    Poses are comparable within one scene only. The scene with most strong matches counts, of equals
    the one with most matches, and of these the one whose match comes first.

    Parameters
    ----------
    pairs : of a query, in the order of R
    """
    accepted = in_preferred_order(pairs)
    scenes = [pair.scene for pair in accepted]
    strong = Counter(pair.scene for pair in accepted if pair.validation.strength == "strong")
    winner = max(
        dict.fromkeys(scenes), key=lambda one: (strong[one], scenes.count(one)), default=""
    )
    return [pair for pair in accepted if pair.scene == winner][:VIEWS]


def judge(judging: Judge, task: QueryTask) -> Judged:
    """Validate a query against each candidate, average its pose, and judge all by the true pose.

    The bound that registration can reach, which is refinement from the true pose, is computed for
    the first answer and for the averaged views of C.
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
    """Return the answer that a robot gets from the candidates of C, judged by the true pose.

    It is the one that a service gives: the same functions validate the candidates and decide.

    Parameters
    ----------
    judging, task : see there
    prior : what the robot believes of its pose, its parent a scene of the database
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
    """The frames of an evaluation that one query searches."""

    def __init__(self, judging: Judge, task: QueryTask, prior: PosePrior | None) -> None:
        self._judging, self._task, self._prior = judging, task, prior
        self._allowed = set(task.allowed.tolist())
        self._poses = [frame.pose for frame in judging.database]
        # what a query may not find must not tell poses apart either: a scene of its own
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
        """Return the matches of C, some of them guided."""
        return self._validated(
            self.selected, pose_of=lambda row: (self._scenes[row], self._poses[row])
        )

    def locate(self, frames: Sequence[QueryFrame]) -> PoseEstimate | None:
        p, agreement = self.p, self._judging.p.agreement
        ahead = [looks_ahead(self.query)] * len(self._poses)  # a recording has one sensor
        views_of = views_of_rows(
            frames[-1].matches, self._poses, self._geometry, self._scenes, p.map, agreement, ahead,
            [self._judging.rendered] * len(self._poses),
        )  # fmt: skip
        asks_map = views_of if self._judging.mode == "full" else None
        return localize(frames, self._poses, self._scenes, asks_map, self._prior, p, agreement)

    def search(self, frame: int, known: Mapping[int, PairValidation]) -> list[PairMatch]:  # noqa: ARG002
        return self._validated(self.selected, known=known)

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
        """Return whether a frame was taken too far from the prior to show the same."""
        prior = self._prior
        return prior is not None and not (
            self._scenes[row] == prior.parent and prior.reaches(self._poses[row], self.p.map)
        )


def _judged_answer(
    estimate: PoseEstimate, task: QueryTask, p: LocalizationParameters, spent: float
) -> JudgedAnswer:
    """Return an answer with the places that it was chosen from, judged by the true pose."""

    def error_of(T: Floats) -> Error:
        return pose_error(T, task.pose) if estimate.parent == task.scene else Error()

    known = [(one, one.evidence) for one in estimate.places if one.evidence is not None]
    confidences = compute_confidences([evidence for _, evidence in known], p.judgement)
    places = []
    for i in sorted(range(len(known)), key=lambda i: -confidences[i]):
        place, evidence = known[i]
        error = error_of(place.T)
        right = error.within(p.map.place_m, PLACE_DEG)
        places.append(JudgedPlace(evidence, confidences[i], error, right))
    # as far off as places are apart, so that a scan may be off by more than a depth image
    limits = RIGHT[0] * p.map.place_m / MapParameters.place_m, RIGHT[1]
    error = Error() if estimate.average is None else error_of(estimate.average.T)
    return JudgedAnswer(estimate.status, estimate.strength, error, spent, tuple(places), limits)


def _ranking_of(judging: Judge, task: QueryTask, rows: Sequence[int]) -> Ranking:
    """Return some rows of R in another order; without R every distance is that of strangers."""
    index = np.array(rows, np.intp)
    distances = np.full(len(index), judging.unrelated_distance)
    if task.retrieved is not None:
        known = dict(
            zip(task.retrieved.indices.tolist(), task.retrieved.distances.tolist(), strict=True)
        )
        distances = np.array([known.get(row, judging.unrelated_distance) for row in rows])
    similarities = np.clip(1.0 - distances / judging.unrelated_distance, 0.0, 1.0)
    whole = np.where(np.isfinite(distances), distances, 0.0).astype(np.int64)
    return Ranking(index, whole, np.nan_to_num(similarities))


def true_transform(task: QueryTask, candidate: Candidate) -> Floats:
    """Return T_match_query by the true poses."""
    T: Floats = inverse(candidate.pose) @ task.pose
    return T


def validated(judging: Judge, task: QueryTask, candidate: Candidate) -> ValidatedPair:
    """Return the validation of a query and one candidate, with its error."""
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
    """Return the transform that refinement reaches from the true pose; see `refined_at`."""
    query, match = judging.geometry(task.number), judging.geometry(candidate.number)
    return refine_transform(query, match, true_transform(task, candidate), judging.p.alignment.fine)


def _average(
    task: QueryTask, of: dict[int, Candidate], transforms: dict[int, Floats | None]
) -> Error:
    """Return the error of the pose averaged over views of one scene; infinite without views."""
    poses = [of[match].pose @ T for match, T in transforms.items() if T is not None]
    if not poses or any(of[match].scene != task.scene for match in transforms):
        return Error()
    return pose_error(average_poses(np.stack(poses)).T, task.pose)


# R and C of every query, by stored signatures alone.

#: Queries scanned at once.
BLOCK = 64
#: Queries whose distances within R are computed again, to time what a service does.
TIMED = 3


@dataclass(frozen=True, eq=False)
class Ranked:
    """R and C of one query.

    Parameters
    ----------
    ranking : R, database indices, nearest first
    distances : (|R|,) of R, as of `cross_distances`
    selection : C, in the order of R
    milliseconds : of `rank` (scan and sort), `diversify`, and sometimes `compare_ranking`
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
    """Rank the database for each query and select from the ranking.

    Parameters
    ----------
    queries : (Q, n) uint8
    database : (N, n) uint8
    allowed : (Q, N), which frames a query may find
    metric : l1 or l2
    candidates : size of C
    watch : follows the queries

    Returns
    -------
    ranked : Q; empty lists where nothing is allowed
    """
    size = max((ranking_size(int(n)) for n in allowed.sum(axis=1)), default=0)
    # every pair of the database once, or the pairs within each ranking anew: whichever is less
    whole = len(database) ** 2 <= len(queries) * size**2
    among = pairwise_distances(database, metric) if whole and len(queries) else None
    rows = _rows(queries, database, metric)
    rankings = []
    for i, (row, spent) in enumerate(watch(rows, "rank", len(queries))):
        start = time.perf_counter()
        index = np.flatnonzero(allowed[i])
        order = np.argsort(row[index], kind="stable")  # ties by index
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
    """Yield the distances of each query to the database, and the milliseconds they took."""
    for begin in range(0, len(queries), BLOCK):
        start = time.perf_counter()
        block = cross_distances(queries[begin : begin + BLOCK], database, metric)
        spent = 1e3 * (time.perf_counter() - start) / len(block)
        for row in block:
            yield row, spent
