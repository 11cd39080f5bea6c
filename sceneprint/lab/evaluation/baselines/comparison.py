"""The baselines asked what the signatures were asked.

Prepared, allowed  --compare-->  Compared: each baseline's ranking of every query, and its time
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sceneprint.errors import FrameError
from sceneprint.lab.evaluation.baselines.baseline import Baseline
from sceneprint.lab.evaluation.judgement import Candidate, Judge, QueryTask, validated
from sceneprint.lab.evaluation.measures import FIRST
from sceneprint.lab.evaluation.protocol import (
    FrameStore,
    Prepared,
    SignedFrame,
    ValidatedPair,
    Watch,
    unwatched,
)
from sceneprint.pipeline import Signer, sign
from sceneprint.types import Floats32

#: Queries that are described and signed once more, to time a baseline beside the signature.
TIMED = 10


@dataclass(frozen=True, eq=False)
class Compared:
    """What a baseline made of the queries.

    Parameters
    ----------
    name : of the baseline
    reason : why it could not be asked; empty where it was
    rankings : of each query the nearest database indices, nearest first; none where refused
    first : of each query the pair with the nearest, validated as ours; None without a ranking
    milliseconds : processor time, medians of a query: to `describe` it, to `sign` it for the
        signature, and to `rank` the database
    """

    name: str
    reason: str
    rankings: list[list[int]]
    first: list[ValidatedPair | None]
    milliseconds: dict[str, float]


def compare(
    baseline: Baseline,
    prepared: Prepared,
    store: FrameStore,
    allowed: NDArray[np.bool_],
    signer: Signer,
    seed: int,
    watch: Watch = unwatched,
) -> Compared:
    """Rank the database for every query by a baseline.

    One process and one thread, in which the signature is timed as well.

    Parameters
    ----------
    baseline : see there
    prepared, store : frames
    allowed : (Q, N), which frames a query may find
    signer : of the signatures, to be timed
    seed : of what is learnt
    watch : told of every frame
    """
    from threadpoolctl import threadpool_limits

    def refused(reason: str) -> Compared:
        return Compared(baseline.name, reason, [[] for _ in prepared.queries], [], {})

    for member in (*prepared.queries, *prepared.database):
        if not baseline.takes(store.frame(member)):
            return refused(f"it is not made for frames such as {member.name}")
    with threadpool_limits(1):
        try:
            found = _compared(baseline, prepared, store, allowed, seed, watch)
            spent = timed(baseline, prepared, store, signer)
            return replace(found, milliseconds=found.milliseconds | spent)
        except FrameError as error:
            return refused(str(error))


def _compared(
    baseline: Baseline,
    prepared: Prepared,
    store: FrameStore,
    allowed: NDArray[np.bool_],
    seed: int,
    watch: Watch,
) -> Compared:
    def kept(member: SignedFrame) -> Path:
        return store.folder / f"{member.number}.{baseline.name}.npy"

    members = {m.number: m for m in (*prepared.queries, *prepared.database)}
    for member in watch(members.values(), baseline.name, len(members)):
        np.save(kept(member), baseline.read(store.frame(member)))

    def database() -> Iterator[Floats32]:
        return (np.load(kept(m)) for m in prepared.database)

    baseline.learn(database(), len(prepared.database), seed)
    stack = np.stack([baseline.finish(one) for one in database()])
    rankings, ranking_ms = [], []
    for i, member in enumerate(prepared.queries):
        descriptor = baseline.finish(np.load(kept(member)))
        index = np.flatnonzero(allowed[i])
        start = time.process_time()
        order = np.argsort(baseline.distances(descriptor, stack[index]), kind="stable")
        ranking_ms.append(1e3 * (time.process_time() - start))
        rankings.append(index[order[: FIRST[-1]]].tolist())
    return Compared(baseline.name, "", rankings, [], {"rank": float(np.median(ranking_ms))})


def registered(
    judge: Judge,
    rankings: Sequence[Sequence[int]],
    prepared: Prepared,
    overlap_mean: NDArray[np.float64],
    overlap_least: NDArray[np.float64],
) -> list[ValidatedPair | None]:
    """The nearest frame of each query validated as ours is: what R would be by this ranking."""
    found: list[ValidatedPair | None] = []
    for i, (query, ranking) in enumerate(zip(prepared.queries, rankings, strict=True)):
        if not ranking:
            found.append(None)
            continue
        j = ranking[0]
        match = prepared.database[j]
        candidate = Candidate(
            j, match.number, match.scene, match.pose,
            float(overlap_mean[i, j]), float(overlap_least[i, j]),
        )  # fmt: skip
        task = QueryTask(query.number, query.scene, query.pose, [j], [], (candidate,))
        found.append(validated(judge, task, candidate))
    return found


def timed(
    baseline: Baseline, prepared: Prepared, store: FrameStore, signer: Signer
) -> dict[str, float]:
    """Processor time to describe a query by a baseline, and to sign it: medians, milliseconds.

    Some evenly chosen queries, each described and signed in turn, so that both meet the same
    machine; after `compare`.
    """
    n = len(prepared.queries)
    chosen = sorted({round(i) for i in np.linspace(0, n - 1, min(TIMED, n))})
    spent: dict[str, list[float]] = {"describe": [], "sign": []}
    frames = [store.frame(prepared.queries[i]) for i in chosen]
    for frame in (frames[0], *frames):  # the first once more: libraries loaded, loops compiled
        start = time.process_time()
        baseline.finish(baseline.read(frame))
        between = time.process_time()
        sign(frame, signer)
        spent["describe"].append(1e3 * (between - start))
        spent["sign"].append(1e3 * (time.process_time() - between))
    return {name: float(np.median(of[1:])) for name, of in spent.items()}
