"""Evaluate a recording: sign all frames, answer every query, and judge the answers.

EvaluationProtocol, Signer  --evaluate-->  Evaluation
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sceneprint.errors import DatasetError
from sceneprint.geometry.registration.sequence_alignment import Matching
from sceneprint.geometry.retrieval.ranking import Metric
from sceneprint.geometry.validation.acceptance import Mode
from sceneprint.pipeline import Signer
from sceneprint.types import Floats
from sceneprint_lab.evaluation.baselines import Compared, compare, open_baselines, registered
from sceneprint_lab.evaluation.judgement import (
    Candidate,
    Judged,
    QueryTask,
    Ranked,
    judge,
    open_judge,
    rank,
)
from sceneprint_lab.evaluation.measures import OVERLAP, metres_apart
from sceneprint_lab.evaluation.protocol import (
    AnyView,
    EvaluationProtocol,
    FrameStore,
    Overlaps,
    Prepared,
    QueryOutcome,
    SignedFrame,
    Use,
    Watch,
    map_over,
    overlap,
    prepare_all,
    travelled,
    unwatched,
    view_of,
)

#: A sample lies in a plane within this, metres.
OFF_PLANE = 0.05
#: A frame is planar where one plane holds at least this share of its samples.
PLANAR = 0.6
#: Planes that are tried, each through three samples.
_TRIES = 200


def plane_share(samples: Floats, off: float = OFF_PLANE) -> float:
    """Return the share of samples in the plane that holds most; the same each time.

    It uses no normals and patches: the choice of frames is independent of the method that is
    judged on them.

    Parameters
    ----------
    samples : (N, 3) metres, as of `view_of`
    off : how far from its plane a sample may lie, metres
    """
    n = len(samples)
    if n < 3:
        return 0.0
    rng = np.random.default_rng(n)
    corners = samples[rng.integers(0, n, (_TRIES, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1)
    fixed = length > off * off  # else the three lie on a line, or are two
    if not fixed.any():
        return 0.0
    normals = normals[fixed] / length[fixed, None]
    offsets = (corners[fixed, 0] * normals).sum(axis=1)
    inside = np.abs(samples @ normals.T - offsets) < off
    best = samples[inside[:, inside.sum(axis=0).argmax()]]
    centre = best.mean(axis=0)  # its own least squares: three noisy samples tilt a plane
    normal = np.linalg.svd(best - centre, full_matrices=False)[2][2]
    fitted = np.abs((samples - centre) @ normal) < off
    return float(max(fitted.mean(), inside.mean(axis=0).max()))


#: Frames of queries, and of the database, that are in memory at once.
BLOCK = 256


@dataclass(frozen=True)
class EvaluationSettings:
    """The settings of an evaluation.

    Parameters
    ----------
    metric : of signatures; None for the model's
    levels : of psi to use, finest first; None for all
    mode, matching : of validation
    candidates : size of C, and of the part of R that is validated
    max_overlap : a query may find only database frames that overlap it by less (by the smaller
        direction, within 10 cm); None for all
    absent : a query may find only frames of other scenes
    gap_m : a query may find only frames more than so much travel before it, or of other runs;
        None for all
    within_m : a frame is the query's place where it was taken within so many metres; None: where
        the two overlap by half
    baselines : names of other ways to rank; see BASELINES
    seed : of every pair that is validated
    jobs : processes; no figure depends on it
    cache_dir : of derived files of the model; None for the user's
    """

    metric: Metric | None = None
    levels: int | None = None
    mode: Mode = "full"
    matching: Matching = "histograms"
    candidates: int = 10
    max_overlap: float | None = None
    absent: bool = False
    gap_m: float | None = None
    within_m: float | None = None
    baselines: tuple[str, ...] = ()
    seed: int = 0
    jobs: int = 1
    cache_dir: Path | None = None


@dataclass(frozen=True, eq=False)
class Evaluation:
    """The outcomes of all queries.

    Parameters
    ----------
    prepared : the frames
    outcomes : of all queries, against the whole database
    alone : of a 7-Scenes table of several scenes, the outcomes of each scene with a database of
        its own; else empty
    allowed, relevant : (Q, N), whether a query may find a frame, and whether it shows its place
    within_m : see EvaluationSettings
    compared : of each baseline
    """

    prepared: Prepared
    outcomes: list[QueryOutcome]
    alone: dict[str, list[QueryOutcome]]
    allowed: NDArray[np.bool_]
    relevant: NDArray[np.bool_]
    within_m: float | None = None
    compared: tuple[Compared, ...] = ()


def evaluate(
    protocol: EvaluationProtocol, signer: Signer, store: FrameStore, settings: EvaluationSettings,
    watch: Watch = unwatched,
) -> Evaluation:  # fmt: skip
    """Sign all frames, ask every query, and judge the answers by the true poses.

    Parameters
    ----------
    protocol : see `choose`
    signer : see `open_signer`
    store : empty
    settings : see EvaluationSettings
    watch : follows the steps of every stage

    Raises
    ------
    DatasetError : no query or no database frame could be used.
    MissingDependency : a baseline needs a library that is absent.
    """
    baselines = open_baselines(
        settings.baselines, signer.model.parameters.depth.maximum_depth
    )  # before the work: a missing library must not cost it
    prepared = prepare_all(
        protocol.frames, signer, store, levels=settings.levels, jobs=settings.jobs,
        cache_dir=settings.cache_dir, watch=watch,
    )  # fmt: skip
    _check_used(protocol, prepared)
    truth = overlaps_of(prepared, store, watch)
    allowed = _allowed(prepared, truth, settings)
    every = np.arange(len(prepared.queries)), np.arange(len(prepared.database))
    outcomes = _evaluate_slice(prepared, truth, allowed, *every, store, settings, watch)
    alone = {
        scene: _evaluate_slice(prepared, truth, allowed, q, d, store, settings, watch)
        for scene, q, d in _scenes(protocol, prepared, settings)
    }
    if settings.within_m is None:
        relevant = truth.mean >= OVERLAP
    else:
        relevant = metres_apart(prepared.queries, prepared.database) <= settings.within_m
    opening = partial(
        open_judge, store, settings.mode, settings.seed, prepared.validation, settings.matching
    )
    compared = []
    for baseline in baselines:
        one = compare(baseline, prepared, store, allowed, signer, settings.seed, watch)
        first = registered(opening(), one.rankings, prepared, truth.mean, truth.least)
        compared.append(replace(one, first=first))
    return Evaluation(
        prepared, outcomes, alone, allowed, relevant, settings.within_m, tuple(compared)
    )


def _check_used(protocol: EvaluationProtocol, prepared: Prepared) -> None:
    """Raise DatasetError unless a query and a database frame can be used."""
    used: dict[Use, list[SignedFrame]] = {"query": prepared.queries, "database": prepared.database}
    for use, members in used.items():
        if not members:
            own = {one.name for one in protocol.frames if one.is_for(use)}
            name, reason = next(left for left in prepared.left_out if left[0] in own)
            raise DatasetError(
                f"No {use} frame can be used. The first that was left out is {name}: "
                f"{reason.rstrip('.')}. Choose other frames."
            )


def _scenes(
    protocol: EvaluationProtocol, prepared: Prepared, settings: EvaluationSettings
) -> Iterator[tuple[str, NDArray[np.intp], NDArray[np.intp]]]:
    """Yield the scenes to evaluate alone, with the numbers of their queries and database frames."""
    scenes = list(dict.fromkeys(q.scene for q in prepared.queries))
    if not protocol.split or len(scenes) < 2 or settings.absent:
        return
    for scene in scenes:
        q = np.flatnonzero([m.scene == scene for m in prepared.queries])
        d = np.flatnonzero([m.scene == scene for m in prepared.database])
        if len(d):
            yield scene, q, d


def _allowed(
    prepared: Prepared, truth: Overlaps, settings: EvaluationSettings
) -> NDArray[np.bool_]:
    """Return which database frames a query may find, (Q, N)."""
    allowed = np.ones(truth.mean.shape, np.bool_)
    if settings.absent:
        scenes = [np.array([m.scene for m in of]) for of in (prepared.queries, prepared.database)]
        allowed &= scenes[0][:, None] != scenes[1]
    if settings.max_overlap is not None:
        allowed &= truth.least < settings.max_overlap
    if settings.gap_m is not None:
        allowed &= travelled(prepared.queries, prepared.database) > settings.gap_m
    return allowed


def overlaps_of(prepared: Prepared, store: FrameStore, watch: Watch = unwatched) -> Overlaps:
    """Return the overlap of every query with every database frame; 0 between scenes."""
    queries, database = prepared.queries, prepared.database
    mean, least = np.zeros((2, len(queries), len(database)))
    total = len(queries) * -(-len(database) // BLOCK)
    for i, own, begin, views in watch(_steps(prepared, store), "overlap", total):
        for j, view in enumerate(views, begin):
            if database[j].scene == queries[i].scene:
                mean[i, j], least[i, j] = overlap(own, view)
    return Overlaps(mean, least)


def _steps(
    prepared: Prepared, store: FrameStore
) -> Iterator[tuple[int, AnyView, int, list[AnyView]]]:
    """Yield each query with each block of the database; two blocks are in memory at a time."""
    for first in range(0, len(prepared.queries), BLOCK):
        own = [view_of(store.frame(m)) for m in prepared.queries[first : first + BLOCK]]
        for begin in range(0, len(prepared.database), BLOCK):
            views = [view_of(store.frame(m)) for m in prepared.database[begin : begin + BLOCK]]
            for i, view in enumerate(own, first):
                yield i, view, begin, views


def _evaluate_slice(
    prepared: Prepared, truth: Overlaps, may: NDArray[np.bool_], of_queries: NDArray[np.intp],
    of_database: NDArray[np.intp], store: FrameStore, settings: EvaluationSettings, watch: Watch,
) -> list[QueryOutcome]:  # fmt: skip
    """Return ask some queries of some of the database."""
    queries, database = [prepared.queries[i] for i in of_queries], prepared.database
    same = np.array([q.scene for q in queries])[:, None] == np.array([d.scene for d in database])
    allowed = np.zeros(same.shape, np.bool_)
    allowed[:, of_database] = may[np.ix_(of_queries, of_database)]
    ranked = rank(
        np.stack([q.signature for q in queries]), np.stack([d.signature for d in database]),
        allowed, metric=settings.metric or prepared.metric, candidates=settings.candidates,
        watch=watch,
    )  # fmt: skip
    mean, least = truth.mean[of_queries], truth.least[of_queries]

    def task(i: int, of: Ranked) -> QueryTask:
        first = of.ranking[: settings.candidates]
        candidates = tuple(
            Candidate.of(database[j], j, float(mean[i, j]), float(least[i, j]))
            for j in sorted({*first, *of.selection})
        )
        return QueryTask(
            queries[i].number, queries[i].scene, queries[i].pose, first, of.selection, candidates,
            np.flatnonzero(allowed[i]), of.retrieved,
        )  # fmt: skip

    def outcome(i: int, of: Ranked, judged: Judged) -> QueryOutcome:
        query, index = queries[i], np.flatnonzero(allowed[i])
        spent = {"average": judged.milliseconds, "answer": judged.answer.milliseconds}
        return QueryOutcome(
            query.name, query.scene, query.pose, index, bool((allowed[i] & same[i]).any()),
            mean[i, index], least[i, index], of.ranking, of.distances, of.selection, judged.pairs,
            settings.candidates, judged.average, judged.average_of_ranking, judged.average_bound,
            of.milliseconds | spent, judged.answer,
        )  # fmt: skip

    tasks = [task(i, one) for i, one in enumerate(ranked)]
    opening = partial(
        open_judge, store, settings.mode, settings.seed, prepared.validation, settings.matching,
        database, prepared.answer, prepared.unrelated_distance,
    )  # fmt: skip
    judged = watch(map_over(tasks, judge, opening, settings.jobs), "validate", len(tasks))
    return [outcome(i, ranked[i], one) for i, one in enumerate(judged)]
