"""What an exact scan of stored signatures costs, beside a plain read of the same bytes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from benchmarks.encode import Clock
from sceneprint.geometry.retrieval.ranking import cross_distances, distances

#: Queries that share one pass over the database.
TOGETHER = 8
#: Signatures, bytes of each and runs: far more than caches hold, whitened and of psi.
SCANNED = ((1_000_000, 448, 9), (4096, 125_000, 9))


@dataclass(frozen=True)
class ScanFigures:
    """Medians over all runs.

    `milliseconds` and `shares` are of one query; a share is of the bandwidth of the read, the
    time of the read over that of the scan within one run: 1 where memory alone sets the pace.
    `spread` has the quartiles of the shares: the machine is shared.
    """

    signatures: int
    signature_bytes: int
    read: float
    milliseconds: dict[str, float]
    shares: dict[str, float]
    spread: dict[str, tuple[float, float]]


def measure(signatures: int = 500, length: int = 125_000, runs: int = 15) -> ScanFigures:
    """Scan random signatures, and read them, in turn.

    Parameters
    ----------
    signatures : in the database
    length : of each, bytes; a multiple of 8
    runs : of every row
    """
    rng = np.random.default_rng(0)
    database = rng.integers(0, 256, (signatures, length), np.uint8)
    queries = rng.integers(0, 256, (TOGETHER, length), np.uint8)
    words = database.reshape(-1).view(np.uint64)
    scans: dict[str, tuple[int, Callable[[], object]]] = {
        "L1, one query": (1, lambda: distances(queries[0], database, "l1")),
        f"L1, {TOGETHER} queries at once": (
            TOGETHER,
            lambda: cross_distances(queries, database, "l1"),
        ),
        "L2, one query": (1, lambda: distances(queries[0], database, "l2")),
        f"L2, {TOGETHER} queries at once": (
            TOGETHER,
            lambda: cross_distances(queries, database, "l2"),
        ),
    }
    reads: list[float] = []
    times: dict[str, list[float]] = {name: [] for name in scans}
    for run in range(-1, runs):  # the first compiles and warms up
        clock = Clock()
        # the sum of eight bytes at a time costs less than fetching them
        clock.run("read", words.sum)
        for name, (_, scan) in scans.items():
            clock.run(name, scan)
        if run >= 0:
            reads.append(clock.stages["read"])
            for name, (number, _) in scans.items():
                times[name].append(clock.stages[name] / number)
    shares = {name: np.divide(reads, own) for name, own in times.items()}
    return ScanFigures(
        signatures=signatures,
        signature_bytes=length,
        read=float(np.median(reads)),
        milliseconds={name: float(np.median(own)) for name, own in times.items()},
        shares={name: float(np.median(own)) for name, own in shares.items()},
        spread={name: tuple(np.quantile(own, (0.25, 0.75))) for name, own in shares.items()},
    )


def table(f: ScanFigures) -> list[str]:
    """The figures as lines of Markdown."""
    megabytes = f.signatures * f.signature_bytes / 1e6
    return [
        f"### Exact scan of {f.signatures} signatures of {f.signature_bytes:,} bytes "
        f"({megabytes:.1f} MB), one thread, warm",
        "",
        "| | ms a query | of the bandwidth of the read | quartiles |",
        "|---|--:|--:|--:|",
        f"| plain read (sum of 64-bit words) | {f.read:.2f} | 1 | |",
        *(
            f"| {name} | {ms:.2f} | {f.shares[name]:.2f} "
            f"| {f.spread[name][0]:.2f} to {f.spread[name][1]:.2f} |"
            for name, ms in f.milliseconds.items()
        ),
        "",
    ]
