"""What a shortlist misses of a map: recall beside the exact scan, and how crowded the map is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sceneprint.geometry.retrieval import cross_distances
from sceneprint.index import Generation, Tail, newest, publish, search
from sceneprint.types import Bytes, Floats

#: The neighbours that recall counts, and the longest ranking.
NEAREST, RANKING = 10, 200
SHORTLISTS = (50, 100, 200, 300, 500, 1000)
#: Frames that production appends at once: TAIL_FRAMES of the settings.
TAIL = 1000
#: Queries that share a pass of the exact scan, and frames of such a pass.
_TOGETHER, _ROWS = 16, 4000


@dataclass(frozen=True, eq=False)
class Case:
    """A map, and frames that are asked for and are not in it.

    Parameters
    ----------
    name : for the table
    signatures : (n, D) of the map, in the order in which they came
    queries : (q, D)
    """

    name: str
    signatures: Bytes
    queries: Bytes


@dataclass(frozen=True)
class RecallFigures:
    """Of all queries of some cases.

    Parameters
    ----------
    name : of the cases
    frames : of the map, of each case
    signature_bytes : of a signature
    queries : of all cases
    tenth : median ratio of the distance of the 10th neighbour to that of the first
    hundredth : of the 100th to that of the 10th; its quartiles
    recall : share of the NEAREST that a shortlist of so many finds, and its standard error
    coverage : share of the RANKING that a shortlist of so many finds
    appended : recall where the map grew by 1000 frames at a time
    """

    name: str
    frames: int
    signature_bytes: int
    queries: int
    tenth: float
    hundredth: float
    quartiles: tuple[float, float]
    recall: dict[int, tuple[float, float]]
    coverage: dict[int, float]
    appended: dict[int, float]


def published(folder: Path, signatures: Bytes, step: int) -> Generation:
    """A map published `step` frames at a time, each time after what was published before."""
    made: Generation | None = None
    for start in range(0, len(signatures), step):
        keys = np.arange(start, min(start + step, len(signatures)))
        blocks = ((some, signatures[some[0] : some[-1] + 1]) for some in np.array_split(
            keys, -(-len(keys) // TAIL)))  # fmt: skip
        made = publish(
            folder, model_id="bench", revision=start + step, blocks=blocks, previous=made
        )
        if made is None:
            raise RuntimeError(f"{folder} is being built in")
    found = newest(folder, "bench", signatures.shape[1])
    if found is None:
        raise RuntimeError(f"{folder} has no generation of {len(signatures)} frames")
    return found


def exact(case: Case) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows (q, RANKING) of the nearest frames, ties by row, and their distances."""
    keep = min(RANKING, len(case.signatures))
    rows = np.empty((len(case.queries), keep), np.int64)
    found = np.empty_like(rows)
    for start in range(0, len(case.queries), _TOGETHER):
        some = case.queries[start : start + _TOGETHER]
        parts = [
            cross_distances(some, case.signatures[low : low + _ROWS])
            for low in range(0, len(case.signatures), _ROWS)
        ]
        every = np.concatenate(parts, axis=1)
        for q, own in enumerate(every, start):
            near = np.flatnonzero(own <= np.partition(own, keep - 1)[keep - 1])
            rows[q] = near[np.argsort(own[near], kind="stable")][:keep]
            found[q] = own[rows[q]]
    return rows, found


def shares(
    case: Case, right: NDArray[np.int64], generation: Generation, shortlist: int
) -> tuple[Floats, Floats]:
    """Share of the NEAREST, and of the RANKING, that is found for each query."""
    empty = Tail.empty(case.queries.shape[1])
    size = NEAREST if shortlist < RANKING else RANKING
    first, all_ = np.empty(len(case.queries)), np.full(len(case.queries), np.nan)
    for q, query in enumerate(case.queries):
        hits = search(query, generation, empty, size, shortlist=shortlist)
        first[q] = np.isin(right[q, :NEAREST], hits.keys[:NEAREST]).mean()
        if size == RANKING:
            all_[q] = np.isin(right[q], hits.keys).mean()
    return first, all_


def measure(
    cases: Sequence[Case],
    folder: Path,
    shortlists: Sequence[int] = SHORTLISTS,
    *,
    appended: bool = True,
) -> RecallFigures:
    """Search every case with every shortlist.

    Parameters
    ----------
    cases : of one size and kind, of 100 frames or more; their queries are counted together
    folder : for indexes; it must be empty
    shortlists : see `search`
    appended : measure also where the map grew by 1000 frames at a time
    """
    first: dict[int, list[Floats]] = {s: [] for s in shortlists}
    all_: dict[int, list[Floats]] = {s: [] for s in shortlists}
    grown: dict[int, list[Floats]] = {s: [] for s in shortlists}
    ratios: list[Floats] = []
    for number, case in enumerate(cases):
        right, distances = exact(case)
        at = distances[:, [0, NEAREST - 1, 10 * NEAREST - 1]].astype(np.float64)
        ratios.append(np.maximum(at, 1.0))
        whole = published(folder / f"{number}-whole", case.signatures, len(case.signatures))
        for s in shortlists:
            found = shares(case, right, whole, s)
            first[s].append(found[0])
            all_[s].append(found[1])
        if appended:
            parts = published(folder / f"{number}-grown", case.signatures, TAIL)
            for s in shortlists:
                grown[s].append(shares(case, right, parts, s)[0])
    d1, d10, d100 = np.concatenate(ratios).T
    return RecallFigures(
        name=cases[0].name,
        frames=round(float(np.mean([len(case.signatures) for case in cases]))),
        signature_bytes=cases[0].queries.shape[1],
        queries=len(d1),
        tenth=float(np.median(d10 / d1)),
        hundredth=float(np.median(d100 / d10)),
        quartiles=(
            float(np.quantile(d100 / d10, 0.25)),
            float(np.quantile(d100 / d10, 0.75)),
        ),
        recall={s: _mean_and_error(np.concatenate(own)) for s, own in first.items()},
        coverage={s: float(np.concatenate(own).mean()) for s, own in all_.items() if s >= RANKING},
        appended={s: float(np.concatenate(own).mean()) for s, own in grown.items() if own},
    )


def _mean_and_error(values: Floats) -> tuple[float, float]:
    """Mean, and its standard error."""
    return float(values.mean()), float(values.std(ddof=1) / np.sqrt(len(values)))
