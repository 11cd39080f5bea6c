"""What diversifying a ranking costs, beside the determinants that it stands for."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from benchmarks.encode import Clock
from sceneprint.geometry.retrieval.ranking import (
    DiversityParameters,
    Ints64,
    Ranking,
    distances,
    diversify,
    kernel_matrix,
    pairwise_distances,
    rank,
)
from sceneprint.types import Bytes


@dataclass(frozen=True)
class DppFigures:
    """Medians over all runs, milliseconds.

    `share` is the greedy steps' of the naive selection's time; `agrees` whether both selected
    the same.
    """

    ranking: int
    selected: int
    signature_bytes: int
    pairwise: float
    greedy: float
    naive: float
    share: float
    agrees: bool


def views(n: int, length: int, places: int = 12) -> Bytes:
    """Signatures (n, length) like those of a walk: most bytes of one place, some of the next."""
    rng = np.random.default_rng(0)
    stops = rng.integers(0, 256, (places + 1, length), np.uint8)
    at = np.linspace(0, places - 1e-9, n)
    mixed = [rng.random(length) < p - int(p) for p in at]
    return np.stack(
        [np.where(m, stops[int(p) + 1], stops[int(p)]) for m, p in zip(mixed, at, strict=True)]
    )


def naive_selection(ranking: Ranking, among: Ints64, k: int) -> list[int]:
    """Greedy by recomputing det L_C of Eq. (3) for every candidate at every step."""
    p, n = DiversityParameters(), len(ranking)
    sigma = p.sigma * float(np.median(among[np.triu_indices(n, 1)]))
    omega = p.omega * float(ranking.distances[-1] - ranking.distances[0])
    # counted from the nearest: a factor common to all entries, lest they underflow
    kernel = kernel_matrix(ranking.distances - ranking.distances[0], among, sigma, omega)
    taken: list[int] = []
    for _ in range(k):
        rest = [i for i in range(n) if i not in taken]
        values = [np.linalg.slogdet(kernel[np.ix_([*taken, i], [*taken, i])])[1] for i in rest]
        taken.append(rest[int(np.argmax(values))])
    return sorted(taken)


def measure(size: int = 125, k: int = 10, length: int = 448, runs: int = 9) -> DppFigures:
    """Diversify the nearest `size` of a map, by us and naively, in turn.

    Parameters
    ----------
    size : of the ranking, |R|
    k : how many to select
    length : of a signature, bytes
    runs : of each
    """
    database = views(2 * size, length)
    ranking = rank(distances(database[size], database, "l2"), size, 1.0)
    ranked = database[ranking.indices]
    among = pairwise_distances(ranked, "l2")
    found = diversify(ranking.distances, among, k)
    rows: list[dict[str, float]] = []
    for _ in range(runs):
        clock = Clock()
        clock.run("pairwise", lambda: pairwise_distances(ranked, "l2"))
        clock.run("greedy", lambda: diversify(ranking.distances, among, k))
        clock.run("naive", lambda: naive_selection(ranking, among, k))
        rows.append(clock.stages)
    median = {stage: float(np.median([row[stage] for row in rows])) for stage in rows[0]}
    return DppFigures(
        ranking=size,
        selected=len(found.indices),
        signature_bytes=length,
        pairwise=median["pairwise"],
        greedy=median["greedy"],
        naive=median["naive"],
        share=float(np.median([row["greedy"] / row["naive"] for row in rows])),
        agrees=found.indices.tolist() == naive_selection(ranking, among, k),
    )


def table(f: DppFigures) -> list[str]:
    """The figures as lines of Markdown."""
    return [
        f"### Diversifying: {f.selected} of a ranking of {f.ranking}, signatures of "
        f"{f.signature_bytes:,} bytes, one thread, warm",
        "",
        "| | ms |",
        "|---|--:|",
        f"| distances within the ranking | {f.pairwise:.2f} |",
        f"| greedy selection | {f.greedy:.2f} |",
        f"| **sum** | **{f.pairwise + f.greedy:.2f}** |",
        f"| the same selection by determinants | {f.naive:.1f} |",
        f"| **greedy selection / by determinants** | **{f.share:.3f}** |",
        "",
        *([] if f.agrees else ["The two selections differ.", ""]),
    ]
