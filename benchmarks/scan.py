"""Measure an exact scan of stored signatures beside a plain read of the same bytes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sceneprint.geometry.retrieval.ranking import cross_distances, distances
from sceneprint_lab.evaluation.pair_run import Clock

#: Number of queries that share a pass over the database.
TOGETHER = 8
#: Numbers of signatures, their bytes, and runs; far larger than caches, whitened and psi.
SCANNED = ((1_000_000, 448, 9), (4096, 125_000, 9))


def measure(signatures: int, length: int, runs: int) -> list[str]:
    """Scan and read random signatures in turn; return the table.

    Parameters
    ----------
    signatures : number of signatures in the database
    length : bytes per signature, a multiple of 8
    runs : number of runs of every row
    """
    rng = np.random.default_rng(0)
    database = rng.integers(0, 256, (signatures, length), np.uint8)
    queries = rng.integers(0, 256, (TOGETHER, length), np.uint8)
    words = database.reshape(-1).view(np.uint64)
    scans: dict[str, tuple[int, Callable[[], object]]] = {
        "L1, one query": (1, lambda: distances(queries[0], database, "l1")),
        f"L1, {TOGETHER} queries at once": (
            TOGETHER, lambda: cross_distances(queries, database, "l1"),
        ),
        "L2, one query": (1, lambda: distances(queries[0], database, "l2")),
        f"L2, {TOGETHER} queries at once": (
            TOGETHER, lambda: cross_distances(queries, database, "l2"),
        ),
    }  # fmt: skip
    reads: list[float] = []
    times: dict[str, list[float]] = {name: [] for name in scans}
    for run in range(-1, runs):  # the first run compiles and warms up
        clock = Clock()
        # Summing words of eight bytes costs less than fetching them.
        clock.run("read", words.sum)
        for name, (_, scan) in scans.items():
            clock.run(name, scan)
        if run >= 0:
            reads.append(clock.stages["read"])
            for name, (number, _) in scans.items():
                times[name].append(clock.stages[name] / number)
    lines = [
        f"### Exact scan of {signatures} signatures of {length:,} bytes "
        f"({signatures * length / 1e6:.1f} MB), one thread, warm",
        "", "| | ms a query | of the bandwidth of the read | quartiles |", "|---|--:|--:|--:|",
        f"| plain read (sum of 64-bit words) | {np.median(reads):.2f} | 1 | |",
    ]  # fmt: skip
    for name, own in times.items():
        low, share, high = np.quantile(np.divide(reads, own), (0.25, 0.5, 0.75))
        lines.append(f"| {name} | {np.median(own):.2f} | {share:.2f} | {low:.2f} to {high:.2f} |")
    return [*lines, ""]
