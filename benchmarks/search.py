"""Measure exhaustive searches and searches with sketches, by number of frames in a map.

Signatures are clustered like those of a building: random places, with fifty frames each. Times
refer to one warm thread, memory to a separate process that opens the index and searches.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sceneprint.index.index_version import IndexVersion, Tail, publish, search
from sceneprint.models import PRESETS, read_model
from sceneprint.types import Bytes
from sceneprint_lab.evaluation.pair_run import Clock

#: Number of hits of a search, the maximum length of a ranking.
SIZE = 200
#: Number of frames of a place, and of a block.
PLACE, BLOCK = 50, 1 << 16
#: Numbers of frames of the maps.
FRAMES = (10_000, 100_000, 1_000_000)
#: Sizes from which sketches are built, bytes: never, and always.
FLAT, SKETCHES = 1 << 62, 0

#: Script that opens an index, searches, and prints milliseconds and bytes.
_PROBE = """
import sys, time
from pathlib import Path
import numpy as np
from sceneprint.index.index_version import Tail, newest, search
folder, queries = Path(sys.argv[1]), np.load(sys.argv[2])
def held():
    lines = dict(line.split()[:2] for line in open("/proc/self/smaps_rollup") if "kB" in line)
    anonymous = int(lines["Anonymous:"])
    return np.array([anonymous, int(lines["Rss:"]) - anonymous]) * 1024
small = Tail(np.arange(2), queries[:2])
search(queries[0], None, small, 2, metric="l2")
import faiss
before, begin = held(), time.perf_counter()
version = newest(folder, "bench", queries.shape[1])
opened = time.perf_counter() - begin
for query in queries:
    search(query, version, Tail.empty(queries.shape[1]), 200, metric="l2")
print(1e3 * opened, *(held() - before))
"""


def signatures(keys: NDArray[np.int64], length: int) -> Bytes:
    """Return the signatures (n, length) of the frames with the numbers `keys`, fifty per place."""
    places, frame = np.divmod(keys, PLACE)
    rows = np.empty((len(keys), length))
    for place in np.unique(places):
        own = np.flatnonzero(places == place)
        rng = np.random.default_rng(place)
        centre = rng.normal(size=length)
        rows[own] = centre + 0.7 * rng.normal(size=(PLACE, length))[frame[own]]
    rows *= 26.0 * length**0.5 / np.linalg.norm(rows, axis=1, keepdims=True)
    quantised: Bytes = (np.clip(np.rint(rows), -127, 127) + 128).astype(np.uint8)
    return quantised


def measure(frames: int, flat_bytes: int = FLAT, runs: int = 15) -> str:
    """Alternately search a map as a service does and exhaustively; return a table row.

    Parameters
    ----------
    frames : number of frames of the map
    flat_bytes : see `publish`; FLAT or SKETCHES
    runs : number of queries, none of which is in the map
    """
    length = read_model(PRESETS[0]).signature_bytes
    tail = Tail.empty(length)
    # The queries show mapped places, but are not in the map.
    seen = (np.arange(runs + 1) * max(frames // (runs + 1), 1)) // PLACE * PLACE
    queries = signatures(seen, length)

    def blocks(first: int, last: int) -> Iterator[tuple[NDArray[np.int64], Bytes]]:
        for start in range(first, last, BLOCK):
            keys = np.arange(start, min(start + BLOCK, last))
            keys = keys[keys % PLACE != 0]
            if len(keys):
                yield keys, signatures(keys, length)

    def published(
        folder: Path, previous: IndexVersion | None, first: int, last: int
    ) -> IndexVersion:
        version = publish(
            folder, model_id="bench", revision=last, blocks=blocks(first, last), previous=previous,
            flat_bytes=flat_bytes,
        )  # fmt: skip
        if version is None:
            raise RuntimeError(f"Another process is publishing in {folder}.")
        return version

    whole = Clock()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "index"
        folder.mkdir()
        version = whole.run("publish", lambda: published(folder, None, 0, frames))
        opened, held, shared = _probe_memory(folder, queries)
        grown = frames + 1000
        whole.run("append", lambda: published(folder, version, frames, grown))
        rows: dict[str, Callable[[Bytes], object]] = {
            "search": lambda query: search(query, version, tail, SIZE, metric="l2"),
            "exact": lambda query: search(query, version, tail, SIZE, metric="l2", exact=True),
        }
        times: dict[str, list[float]] = {name: [] for name in rows}
        for run, query in enumerate(queries, -1):  # the first query warms up
            clock = Clock()
            for name, call in rows.items():
                clock.run(name, partial(call, query))
                if run >= 0:
                    times[name].append(clock.stages[name])
    searched, every = (np.array(times[name]) for name in rows)
    recall, stages = version.manifest.recall, whole.stages
    return (
        f"| {len(version):,} | {length} | {'by sketches' if recall.probes else 'all'} "
        f"| {np.median(searched):.2f} | {np.median(every):.2f} "
        f"| {np.median(searched / every):.2f} | {recall.share:.4f} "
        f"| {stages['publish'] / 1e3:.1f} | {stages['append'] / 1e3:.1f} | {opened / 1e3:.2f} "
        f"| {held / 1e6:.0f}, {shared / 1e6:.0f} |"
    )


def table() -> list[str]:
    """Return the table of all map sizes."""
    return [
        f"### Search for the {SIZE} nearest frames: one thread, warm", "",
        "| frames | bytes | compared | search, ms | all, ms | search / all | recall@10 "
        "| publish, s | append 1,000, s | open and verify, s | memory: own, shared, MB |",
        "|--:|--:|---|--:|--:|--:|--:|--:|--:|--:|--:|",
        *(measure(n, kind) for kind in (FLAT, SKETCHES) for n in FRAMES), "",
        "A service compares all frames of a map up to 16 MiB of signatures, and selects frames by "
        "sketches beyond.",
        "",
    ]  # fmt: skip


def _probe_memory(folder: Path, queries: Bytes) -> list[float]:
    file = folder.parent / "queries.npy"
    np.save(file, queries)
    command = [sys.executable, "-c", _PROBE, str(folder), str(file)]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    return [float(value) for value in done.stdout.split()]
