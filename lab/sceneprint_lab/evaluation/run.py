"""Evaluation on recordings: signatures of frames, answers to queries, and their errors.

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

#: Maximum distance of a sample from its plane, metres.
OFF_PLANE = 0.05
#: Minimum share of samples that lie in one plane if a frame is planar.
PLANAR = 0.6
#: Number of planes that are tested, each through three random samples.
_TRIES = 200


def plane_share(samples: Floats, off: float = OFF_PLANE) -> float:
    """Return the share of samples in the largest plane, deterministically.

    Normals and patches are not used, so the result does not depend on the method under evaluation.

    Parameters
    ----------
    samples : (N, 3) metres; see `view_of`
    off : maximum distance of a sample from the plane, metres
    """
    n = len(samples)
    if n < 3:
        return 0.0
    rng = np.random.default_rng(n)
    corners = samples[rng.integers(0, n, (_TRIES, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1)
    fixed = length > off * off  # exclude samples on a line
    if not fixed.any():
        return 0.0
    normals = normals[fixed] / length[fixed, None]
    offsets = (corners[fixed, 0] * normals).sum(axis=1)
    inside = np.abs(samples @ normals.T - offsets) < off
    best = samples[inside[:, inside.sum(axis=0).argmax()]]
    centre = best.mean(axis=0)  # refit by least squares: three noisy samples tilt a plane
    normal = np.linalg.svd(best - centre, full_matrices=False)[2][2]
    fitted = np.abs((samples - centre) @ normal) < off
    return float(max(fitted.mean(), inside.mean(axis=0).max()))


#: Number of queries, and of database frames, that are in memory at a time.
BLOCK = 256


@dataclass(frozen=True)
class EvaluationSettings:
    """The settings of an evaluation.

    Parameters
    ----------
    metric : metric of signatures; None selects the metric of the model
    levels : number of levels of psi, finest first; None selects all levels
    mode, matching : arguments of `validate`
    candidates : size of C, and number of validated members of R
    max_overlap : maximum overlap (`Overlaps.least`) of the database frames that a query may find;
        None: no limit
    absent : whether a query may find only frames of other scenes
    gap_m : minimum distance of travel from a database frame of the same run to a query that may
        find it, metres; None: no limit
    within_m : maximum distance of a frame that shows the query's place, metres; with None, an
        overlap of half is required instead
    baselines : names of baselines; see BASELINES
    jobs : number of processes; figures do not depend on it
    cache_dir : folder for files derived from the model; None selects the user's cache folder
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
    prepared : frames of the evaluation
    alone : for a 7-Scenes table of several scenes, the outcomes of each with a separate database;
        otherwise empty
    allowed, relevant : (Q, N) masks of the frames that a query may find, and of those that show its
        place
    compared : answers of each baseline
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
    """Sign all frames, answer all queries, and return the outcomes with their errors.

    Parameters
    ----------
    protocol : result of `choose`
    signer : result of `open_signer`
    store : empty store; it receives the depth and the geometry of all frames
    settings : settings of the evaluation
    watch : callback for progress

    Raises
    ------
    DatasetError : If no query or no database frame is usable
    MissingDependency : If the library of a baseline is missing
    """
    # Detect missing libraries before the work.
    baselines = open_baselines(settings.baselines, signer.model.parameters.depth.maximum_depth)
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
        comparison = compare(baseline, prepared, store, allowed, signer, settings.seed, watch)
        first = registered(opening(), comparison.rankings, prepared, truth.mean, truth.least)
        compared.append(replace(comparison, first=first))
    return Evaluation(
        prepared, outcomes, alone, allowed, relevant, settings.within_m, tuple(compared)
    )


def _check_used(protocol: EvaluationProtocol, prepared: Prepared) -> None:
    """Raise DatasetError if no query or no database frame is usable."""
    used: dict[Use, list[SignedFrame]] = {"query": prepared.queries, "database": prepared.database}
    for use, members in used.items():
        if not members:
            own = {frame.name for frame in protocol.frames if frame.is_for(use)}
            name, reason = next(left for left in prepared.left_out if left[0] in own)
            raise DatasetError(
                f"No {use} frame is usable. The first omitted frame is {name}: "
                f"{reason.rstrip('.')}. Select other frames."
            )


def _scenes(
    protocol: EvaluationProtocol, prepared: Prepared, settings: EvaluationSettings
) -> Iterator[tuple[str, NDArray[np.intp], NDArray[np.intp]]]:
    """Yield name, query indices and database indices of each scene of a 7-Scenes table."""
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
    """Return a mask (Q, N) of the database frames that a query may find."""
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
    """Return the overlaps of all queries with all database frames; 0 between scenes."""
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
    """Yield, for each query and database block: query index and view, first index and views.

    All pairs of a query and a block occur; at most two blocks of views are in memory.
    """
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
    """Answer the queries `of_queries` with the database frames `of_database`; return outcomes."""
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

    tasks = [task(i, ranking) for i, ranking in enumerate(ranked)]
    opening = partial(
        open_judge, store, settings.mode, settings.seed, prepared.validation, settings.matching,
        database, prepared.answer, prepared.unrelated_distance,
    )  # fmt: skip
    judged = watch(map_over(tasks, judge, opening, settings.jobs), "validate", len(tasks))
    return [outcome(i, ranked[i], result) for i, result in enumerate(judged)]
