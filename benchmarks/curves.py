"""Time, memory and disk of a map's index against its number of frames, and lines through them."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.encode import Clock
from benchmarks.recall import RANKING, TAIL
from sceneprint.index import SHORTLIST, Generation, Tail, publish, search
from sceneprint.types import Bytes

#: What is timed of a map, and what of a process's memory is told apart: what it holds of its
#: own, and pages of the mapped signatures, which the system may take back.
TIMES = ("search", "exact scan", "append 1,000", "refit", "open")
MEMORY = ("held", "mapped")

#: Opens a generation in a process of its own, searches, and says seconds and bytes.
_PROBE = """
import sys, time
import numpy as np
from pathlib import Path
from sceneprint.index import Tail, newest, search
folder, dimension, shortlist = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
asked = np.load(sys.argv[4])
import faiss
def held():
    lines = dict(line.split()[:2] for line in open('/proc/self/smaps_rollup') if 'kB' in line)
    anonymous = int(lines['Anonymous:'])
    return np.array([anonymous, int(lines['Rss:']) - anonymous]) * 1024
small = np.zeros((2, dimension), np.uint8)
search(asked[0], None, Tail(np.arange(2), small), 2)
begin, before = time.perf_counter(), held()
generation = newest(folder, 'bench', dimension)
opened = time.perf_counter() - begin
empty = Tail.empty(dimension)
for query in asked:
    search(query, generation, empty, 200, shortlist=shortlist)
after = held() - before
print(1e3 * opened, *after)
"""


@dataclass(frozen=True)
class Point:
    """What a map of so many frames costs.

    Parameters
    ----------
    frames : of the map
    milliseconds : by TIMES
    megabytes : by MEMORY: what a process that opened the map and searched holds beyond itself
    disk : bytes a frame of the index
    """

    frames: int
    milliseconds: dict[str, float]
    megabytes: dict[str, float]
    disk: float


@dataclass(frozen=True)
class Line:
    """y = fixed + each * n."""

    fixed: float
    each: float

    def at(self, n: float) -> float:
        """The value at n."""
        return self.fixed + self.each * n


def fit(ns: Sequence[float], values: Sequence[float]) -> Line:
    """The line of least squared relative error, with no part below zero.

    Relative, so that small maps count as much as large ones.

    Raises
    ------
    ValueError : fewer than two points, or values that are not positive.
    """
    n, y = np.asarray(ns, float), np.asarray(values, float)
    if len(n) < 2 or len(n) != len(y) or not (y > 0).all():
        raise ValueError(f"no line through {values} at {ns}")
    fixed, each = np.linalg.lstsq(np.column_stack([1 / y, n / y]), np.ones(len(y)), rcond=None)[0]
    if each < 0:
        fixed, each = (1 / y).sum() / (1 / y**2).sum(), 0.0
    elif fixed < 0:
        fixed, each = 0.0, (n / y).sum() / ((n / y) ** 2).sum()
    return Line(float(fixed), float(each))


def measure(
    signatures: Bytes,
    queries: Bytes,
    sizes: Sequence[int],
    folder: Path,
    *,
    runs: int = 9,
    shortlist: int = SHORTLIST,
) -> list[Point]:
    """A map at some sizes: published, searched, opened anew, and appended to.

    Parameters
    ----------
    signatures : (n, D), of which each size takes the first
    queries : (q, D)
    sizes : of the map, rising, no more than n
    folder : for indexes, removed one after the other
    runs : of every search
    shortlist : see `search`
    """
    folder.mkdir(parents=True, exist_ok=True)
    asked = folder / "queries.npy"
    np.save(asked, queries[:32])
    found = []
    for n in sizes:
        own = folder / str(n)
        generation = _published(own, signatures, 0, n, None)
        times = _searched(generation, queries, runs, shortlist)
        probed = [_probe(own, signatures.shape[1], shortlist, asked) for _ in range(3)]
        opened, *held = np.median(probed, axis=0).tolist()
        size = sum(path.stat().st_size for path in own.iterdir())
        times |= {"open": opened} | _appended(own, signatures, generation)
        found.append(
            Point(
                frames=n,
                milliseconds={name: times[name] for name in TIMES},
                megabytes={name: each / 1e6 for name, each in zip(MEMORY, held, strict=True)},
                disk=size / n,
            )
        )
        shutil.rmtree(own)
    return found


def _published(
    folder: Path, signatures: Bytes, low: int, high: int, previous: Generation | None
) -> Generation:
    """Frames `low` to `high` put behind a generation; beyond the last they begin anew."""
    blocks = (
        (keys, signatures[keys % len(signatures)])
        for keys in np.array_split(np.arange(low, high), -(-(high - low) // TAIL))
    )
    made = publish(folder, model_id="bench", revision=high, blocks=blocks, previous=previous)
    if made is None:
        raise RuntimeError(f"{folder} is being built in")
    return made


def _searched(
    generation: Generation, queries: Bytes, runs: int, shortlist: int
) -> dict[str, float]:
    """Median milliseconds of a search and of an exact scan, in turn."""
    empty, clocks = Tail.empty(generation.dimension), []
    for run in range(-2, runs):  # the first compile, and touch the mapping
        query, clock = queries[run % len(queries)], Clock()
        clock.run("search", partial(search, query, generation, empty, RANKING, shortlist=shortlist))
        clock.run("exact scan", partial(search, query, generation, empty, RANKING, exact=True))
        clocks += [clock] if run >= 0 else []
    return {
        name: float(np.median([clock.stages[name] for clock in clocks]))
        for name in ("search", "exact scan")
    }


def _appended(folder: Path, signatures: Bytes, generation: Generation) -> dict[str, float]:
    """Milliseconds to publish TAIL frames more by the code that is there, and by a new one."""
    n, clock = len(generation), Clock()
    # as if the code had been fitted just now, and then as if long ago
    fresh = replace(generation, fitted_on=n + 2 * TAIL)
    more = clock.run("append 1,000", lambda: _published(folder, signatures, n, n + TAIL, fresh))
    stale = replace(more, fitted_on=1)
    clock.run("refit", lambda: _published(folder, signatures, n + TAIL, n + 2 * TAIL, stale))
    return clock.stages


def _probe(folder: Path, length: int, shortlist: int, asked: Path) -> list[float]:
    """Milliseconds to open, and bytes held and mapped after some searches, of a new process."""
    done = subprocess.run(
        [sys.executable, "-c", _PROBE, str(folder), str(length), str(shortlist), str(asked)],
        check=True,
        capture_output=True,
        text=True,
    )
    return [float(word) for word in done.stdout.split()]
