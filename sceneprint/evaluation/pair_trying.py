"""A pair of frames registered by us and by others, and judged by the true poses.

Drawn, Member, Member  --attempt-->  Tried
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sceneprint.evaluation.frames import Store
from sceneprint.evaluation.pair_drawing import Drawn
from sceneprint.evaluation.pairs import (
    Candidate,
    Judge,
    Task,
    open_judge,
    refined_from_truth,
    truth,
    validated,
)
from sceneprint.evaluation.records import Error, Member, Pair, pose_error
from sceneprint.evaluation.registration_baselines import points_of, register
from sceneprint.geometry.acceptance import Mode
from sceneprint.geometry.alignment import AlignmentParameters
from sceneprint.geometry.properties import PropertyParameters
from sceneprint.geometry.registration import refined_all
from sceneprint.geometry.sequences import Matching
from sceneprint.geometry.validation import refined_at
from sceneprint.libraries import open3d
from sceneprint.models import Model, ModelParameters
from sceneprint.pipeline import geometry_of
from sceneprint.signing import see
from sceneprint.types import AnyFrame, Cloud, Floats, Geometry


@dataclass(frozen=True, eq=False)
class Other:
    """What a baseline made of a pair.

    Parameters
    ----------
    start, icp, ours : errors: as found; after its own ICP; after our refinement in its place
    milliseconds : features of both frames, search and its own ICP
    """

    start: Error
    icp: Error
    ours: Error
    milliseconds: float


@dataclass(frozen=True, eq=False)
class Tried:
    """A pair that was validated.

    Parameters
    ----------
    drawn : see Drawn
    pair : see Pair; with `bound` where the two overlap
    others : by method; None where baselines were not asked for, or the two do not overlap, and
        empty where there were too few points for any
    milliseconds : beside others: of ours, features of both frames counted; else None
    """

    drawn: Drawn
    pair: Pair
    others: dict[str, Other] | None
    milliseconds: float | None


@dataclass(frozen=True, eq=False)
class Bench:
    """What a process needs to try pairs.

    Parameters
    ----------
    judging : see Judge
    store : of the frames
    model : for baselines: with the parameters of ours
    limits : metres and degrees to which a transform is to be right
    o3d : Open3D, or None where no baselines were asked for
    """

    judging: Judge
    store: Store
    model: Model
    limits: tuple[float, float]
    o3d: Any | None


def open_bench(
    store: Store,
    model: Model,
    mode: Mode,
    seed: int,
    limits: tuple[float, float],
    *,
    baselines: bool,
    matching: Matching = "histograms",
) -> Bench:
    """Make ready to try pairs of the frames of a store."""
    o3d = open3d("A baseline of registration") if baselines else None
    judging = open_judge(store, mode, seed, model.parameters.validation, matching)
    return Bench(judging, store, model, limits, o3d)


def attempt(bench: Bench, task: tuple[Drawn, Member, Member]) -> Tried:
    """Validate a pair; where the two overlap, see what registration could reach and others do."""
    drawn, query, match = task
    candidate = Candidate(
        drawn.match, match.number, match.scene, match.pose, drawn.overlap_mean, drawn.overlap_least
    )
    asked = Task(query.number, query.scene, query.pose, [], [], (candidate,))
    pair = replace(validated(bench.judging, asked, candidate), limits=bench.limits)
    if drawn.kind != "overlapping":
        return Tried(drawn, pair, None, None)
    T = refined_from_truth(bench.judging, asked, candidate)
    true = truth(asked, candidate)
    pair = replace(pair, bound=_error(T, true))
    if bench.o3d is None:
        return Tried(drawn, pair, None, None)
    others, spent = _others(bench, bench.store.frame(query), bench.store.frame(match), true)
    return Tried(drawn, pair, others, spent + pair.milliseconds)


def _others(
    bench: Bench, query: AnyFrame, match: AnyFrame, true: Floats
) -> tuple[dict[str, Other], float]:
    """What the baselines make of two frames, and the milliseconds of our geometry of both."""
    p = bench.model.parameters
    start = time.perf_counter()
    ours, its = (geometry_of(see(frame, p), bench.model) for frame in (query, match))
    spent = 1e3 * (time.perf_counter() - start)
    found = register(
        _points(query, bench.model),
        _points(match, bench.model),
        bench.o3d,
        seed=bench.judging.seed,
        scale=scale_of(p),
    )
    others = {}
    for name, one in found.items():
        refined = _refined_by_us(ours, its, one.start, bench.judging.p.alignment)
        others[name] = Other(
            _error(one.start, true),
            _error(one.refined, true),
            _error(refined, true),
            one.milliseconds,
        )
    return others, spent


def scale_of(p: ModelParameters) -> float:
    """How much longer the lengths of a model are than those for rooms, by its radius."""
    return p.properties.radius / PropertyParameters().radius


def _points(frame: AnyFrame, model: Model) -> Floats:
    """What baselines are given: all points, of a depth image those within the model's range."""
    if isinstance(frame, Cloud):
        return frame.points.astype(np.float64)
    p = model.parameters.depth
    return points_of(frame, p.minimum_depth, p.maximum_depth)


def _refined_by_us(
    query: Geometry, match: Geometry, T: Floats, p: AlignmentParameters
) -> Floats | None:
    """Our refinement of another's transform: with wide gates first, as our own hypotheses get."""
    coarse = refined_all(query.surface, match.surface, T[None], p.coarse)
    return refined_at(query, match, coarse[0] if len(coarse) else T, p.fine)


def _error(T: Floats | None, true: Floats) -> Error:
    return Error() if T is None else pose_error(T, true)
