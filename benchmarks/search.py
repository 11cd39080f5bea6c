"""What a search of a published map costs from a shortlist, beside an exact scan of all of it.

`python -m benchmarks.search`
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.encode import Clock
from benchmarks.machine import pin_to_one_processor
from sceneprint.index import SHORTLIST, Generation, Tail, publish, search
from sceneprint.index.segments import Block
from sceneprint.types import Bytes

#: Hits that are asked for: the longest ranking.
SIZE = 200


@dataclass(frozen=True)
class SearchFigures:
    """Medians over all runs, of one query against a map of `frames`; milliseconds.

    `ratio` is the time of the search over that of the exact scan within one run, of a query that
    neither has seen; below 1 the shortlist pays. `spread` has its quartiles: the machine is shared,
    and one turn of another process is longer than a search. `publish` is of one run.
    """

    frames: int
    signature_bytes: int
    shortlist: int
    publish: float
    exact: float
    search: float
    code: float
    nearest: float
    ratio: float
    spread: tuple[float, float]


def measure(
    frames: int = 10_000, length: int = 12_800, runs: int = 15, shortlist: int = SHORTLIST
) -> SearchFigures:
    """Search a map of random signatures, and scan it, in turn.

    Parameters
    ----------
    frames : of the map
    length : of a signature, bytes
    runs : of every row
    shortlist : see `search`
    """
    rng = np.random.default_rng(0)
    queries: Bytes = rng.integers(0, 256, (runs + 1, length), np.uint8)
    none, tail = np.empty(0, np.int64), Tail.empty(length)

    def blocks() -> Iterator[Block]:
        for keys in np.array_split(np.arange(frames), max(frames * length >> 23, 1)):
            yield keys, rng.integers(0, 256, (len(keys), length), np.uint8)

    def published(folder: Path) -> Generation:
        made = publish(folder, model_id="bench", revision=0, blocks=blocks(), previous=None)
        if made is None:
            raise RuntimeError(f"{folder} is being built in")
        return made

    whole = Clock()
    with tempfile.TemporaryDirectory() as folder:
        generation = whole.run("publish", lambda: published(Path(folder)))
    code = generation.code.encode(queries[:1])[0]
    rows: dict[str, Callable[[Bytes], object]] = {
        "exact": lambda query: search(query, generation, tail, SIZE, exact=True),
        "search": lambda query: search(query, generation, tail, SIZE, shortlist=shortlist),
        "code": lambda query: generation.code.encode(query[None]),
        "nearest": lambda _: generation.coarse.nearest(code, shortlist, none),
    }
    times: dict[str, list[float]] = {name: [] for name in rows}
    for run, query in enumerate(queries, -1):  # the first compiles, and touches the mapping
        clock = Clock()
        for name, call in rows.items():
            clock.run(name, partial(call, query))
            if run >= 0:
                times[name].append(clock.stages[name])
    ratios = np.divide(times["search"], times["exact"])
    medians = {name: float(np.median(own)) for name, own in times.items()}
    return SearchFigures(
        frames=frames,
        signature_bytes=length,
        shortlist=shortlist,
        publish=whole.stages["publish"],
        ratio=float(np.median(ratios)),
        spread=tuple(np.quantile(ratios, (0.25, 0.75))),
        **medians,
    )


def table(figures: list[SearchFigures]) -> list[str]:
    """The figures as lines of Markdown."""
    return [
        f"### Search for {SIZE} frames from a shortlist, beside an exact scan: one thread, warm",
        "",
        "| frames | bytes | shortlist | exact, ms | search, ms | of it code | of it FAISS "
        "| search / exact | quartiles |",
        "|--:|--:|--:|--:|--:|--:|--:|--:|--:|",
        *(
            f"| {f.frames:,} | {f.signature_bytes:,} | {f.shortlist:,} | {f.exact:.2f} "
            f"| {f.search:.2f} | {f.code:.2f} | {f.nearest:.2f} | **{f.ratio:.3f}** "
            f"| {f.spread[0]:.3f} to {f.spread[1]:.3f} |"
            for f in figures
        ),
        "",
        "A map no larger than the shortlist is compared whole, without code and FAISS.",
        "",
    ]


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, nargs="+", default=[1000, 10_000, 100_000])
    parser.add_argument("--bytes", type=int, default=12_800, help="of a signature")
    parser.add_argument("--runs", type=int, default=15)
    options = parser.parse_args()
    pin_to_one_processor()
    figures = [measure(n, options.bytes, options.runs) for n in options.frames]
    print("\n".join(table(figures)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
