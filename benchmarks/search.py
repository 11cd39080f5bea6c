"""What a search costs by the number of frames in a map: all compared, and by sketches; and what
it costs to keep its index while the map grows.

`python -m benchmarks.search`

Frames are clustered as a building is: places at random, and some fifty frames about each. Times are
of one thread, warm. Memory is of a process of its own that opens the index and searches.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.encode import Clock
from benchmarks.machine import pin_to_one_processor
from sceneprint.index import Generation, Tail, publish, search
from sceneprint.models import PRESETS, read_model
from sceneprint.types import Bytes

#: Hits that are asked for: the longest ranking.
SIZE = 200
#: Frames of a place, and of a block.
PLACE, BLOCK = 50, 1 << 16
#: Equal steps in which a map grows: after them it has as many segments as it ever has.
STEPS = 127
#: Bytes of a map from which sketches are made: never, and always.
FLAT, SKETCHES = 1 << 62, 0

#: Opens an index in a process of its own, searches, and prints milliseconds and bytes.
_PROBE = """
import sys, time
from pathlib import Path
import numpy as np
from sceneprint.index import Tail, newest, search
folder, asked = Path(sys.argv[1]), np.load(sys.argv[2])
def held():
    lines = dict(line.split()[:2] for line in open("/proc/self/smaps_rollup") if "kB" in line)
    anonymous = int(lines["Anonymous:"])
    return np.array([anonymous, int(lines["Rss:"]) - anonymous]) * 1024
small = Tail(np.arange(2), asked[:2])
search(asked[0], None, small, 2, metric="l2")
import faiss
before, begin = held(), time.perf_counter()
generation = newest(folder, "bench", asked.shape[1])
opened = time.perf_counter() - begin
for query in asked:
    search(query, generation, Tail.empty(asked.shape[1]), 200, metric="l2")
print(1e3 * opened, *(held() - before))
"""


@dataclass(frozen=True)
class SearchFigures:
    """Of one query against a map of `frames`, medians over all runs; milliseconds and megabytes.

    `search` is as a service searches; `exact` compares every frame. `ratio` is the time of the one
    over that of the other within one run. `probes` is 0 where there are no sketches; then `recall`
    is 1 without being measured. `publish`, `append` (of a thousand frames) and `open` (all
    files read and verified) are of one run. `held` is memory of the process alone, `shared` what
    processes have in common.
    """

    frames: int
    signature_bytes: int
    probes: int
    recall: float
    publish: float
    append: float
    open: float
    search: float
    exact: float
    ratio: float
    held: float
    shared: float


@dataclass(frozen=True)
class GrowthFigures:
    """Of a map that grew to `frames` in STEPS equal steps; milliseconds.

    `segments` is how many it has in the end, `written` the bytes of all files written on the way,
    in times the size of the index in the end, and `share` what the median publication of the last
    half writes of the index. `append` is the median time of these, `largest` that of the dearest;
    `whole`, the median of five, writes all of it anew, and `append_ratio` is `append` over `whole`.
    `search` is of the segments and `one` of the same frames in one segment, medians; `search_ratio`
    is the median of the one over the other, in turn. `recall` and `recall_one` are the shares of
    the ten nearest that these find.
    """

    frames: int
    signature_bytes: int
    segments: int
    written: float
    share: float
    append: float
    largest: float
    whole: float
    append_ratio: float
    search: float
    one: float
    search_ratio: float
    recall: float
    recall_one: float


def signatures(keys: NDArray[np.int64], length: int) -> Bytes:
    """Signatures (n, length) of frames by their numbers: fifty about each place, none twice."""
    places, frame = np.divmod(keys, PLACE)
    rows = np.empty((len(keys), length))
    for place in np.unique(places):
        own = np.flatnonzero(places == place)
        rng = np.random.default_rng(place)
        centre = rng.normal(size=length)
        rows[own] = centre + 0.7 * rng.normal(size=(PLACE, length))[frame[own]]
    rows *= 26.0 * length**0.5 / np.linalg.norm(rows, axis=1, keepdims=True)
    found: Bytes = (np.clip(np.rint(rows), -127, 127) + 128).astype(np.uint8)
    return found


def measure(
    frames: int = 10_000, length: int | None = None, flat_bytes: int = FLAT, runs: int = 15
) -> SearchFigures:
    """Publish a map, and search it as a service does and by comparing every frame, in turn.

    Parameters
    ----------
    frames : of the map
    length : bytes of a signature; default: of the default preset
    flat_bytes : see `publish`; FLAT or SKETCHES
    runs : queries, of which none is in the map
    """
    length = read_model(PRESETS[0]).signature_bytes if length is None else length
    tail = Tail.empty(length)
    # of places that the map has, but of frames that it has not
    seen = (np.arange(runs + 1) * max(frames // (runs + 1), 1)) // PLACE * PLACE
    queries = signatures(seen, length)

    def blocks(first: int, last: int) -> Iterator[tuple[NDArray[np.int64], Bytes]]:
        for start in range(first, last, BLOCK):
            keys = np.arange(start, min(start + BLOCK, last))
            keys = keys[keys % PLACE != 0]
            if len(keys):
                yield keys, signatures(keys, length)

    def published(folder: Path, previous: Generation | None, first: int, last: int) -> Generation:
        made = publish(
            folder, model_id="bench", revision=last, blocks=blocks(first, last), previous=previous,
            flat_bytes=flat_bytes,
        )  # fmt: skip
        if made is None:
            raise RuntimeError(f"{folder} is being built in")
        return made

    whole = Clock()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "index"
        folder.mkdir()
        generation = whole.run("publish", lambda: published(folder, None, 0, frames))
        opened, held, shared = _probed(folder, queries)
        grown = frames + 1000
        whole.run("append", lambda: published(folder, generation, frames, grown))
        rows: dict[str, Callable[[Bytes], object]] = {
            "search": lambda query: search(query, generation, tail, SIZE, metric="l2"),
            "exact": lambda query: search(query, generation, tail, SIZE, metric="l2", exact=True),
        }
        times: dict[str, list[float]] = {one: [] for one in rows}
        for run, query in enumerate(queries, -1):  # the first warms up
            clock = Clock()
            for one, call in rows.items():
                clock.run(one, partial(call, query))
                if run >= 0:
                    times[one].append(clock.stages[one])
    return SearchFigures(
        frames=len(generation),
        signature_bytes=length,
        probes=generation.manifest.recall.probes,
        recall=generation.manifest.recall.share,
        publish=whole.stages["publish"],
        append=whole.stages["append"],
        open=opened,
        search=float(np.median(times["search"])),
        exact=float(np.median(times["exact"])),
        ratio=float(np.median(np.divide(times["search"], times["exact"]))),
        held=held / 1e6,
        shared=shared / 1e6,
    )


def measure_growth(
    frames: int = 100_000, length: int | None = None, flat_bytes: int = FLAT, runs: int = 15
) -> GrowthFigures:
    """Let a map grow, publish it anew as a whole, and search both in turn; see `measure`."""
    length = read_model(PRESETS[0]).signature_bytes if length is None else length
    keys = np.arange(frames)
    keys = keys[keys % PLACE != 0]  # the others are asked
    step = len(keys) // STEPS
    keys = keys[: STEPS * step]
    rows, clock = signatures(keys, length), Clock()
    queries = signatures((np.arange(runs) * len(keys) // runs) // PLACE * PLACE, length)

    def published(folder: Path, previous: Generation | None, some: slice) -> Generation:
        made = publish(
            folder, model_id="bench", revision=0, blocks=[(keys[some], rows[some])],
            previous=previous, flat_bytes=flat_bytes,
        )  # fmt: skip
        if made is None:
            raise RuntimeError(f"{folder} is being built in")
        return made

    with tempfile.TemporaryDirectory() as name:
        folder, made, known = Path(name), None, set[str]()
        appends, written = list[float](), list[int]()
        for first in range(0, len(keys), step):
            before, some = made, slice(first, first + step)
            made = clock.run("append", partial(published, folder / "map", before, some))
            appends.append(clock.stages.pop("append"))
            written.append(sum(size for file, size in made.manifest.files if file not in known))
            known = {file for file, _ in made.manifest.files}
        assert made is not None
        wholes = list[float]()
        for _ in range(5):
            one = clock.run("whole", partial(published, folder / "one", None, slice(None)))
            wholes.append(clock.stages.pop("whole"))
        times, found = _in_turn(made, one, queries)
    size, late = sum(size for _, size in made.manifest.files), STEPS // 2
    median, append, whole = np.median(times, axis=0), median_of(appends[late:]), median_of(wholes)
    return GrowthFigures(
        frames=len(made),
        signature_bytes=length,
        segments=len(made.segments),
        written=sum(written) / size,
        share=median_of(written[late:]) / size,
        append=append,
        largest=max(appends),
        whole=whole,
        append_ratio=append / whole,
        search=float(median[0]),
        one=float(median[1]),
        search_ratio=float(np.median(times[:, 0] / times[:, 1])),
        recall=found[0],
        recall_one=found[1],
    )


def median_of(values: Sequence[float]) -> float:
    """Of some values."""
    return float(np.median(values))


def _in_turn(
    several: Generation, one: Generation, queries: Bytes
) -> tuple[NDArray[np.float64], tuple[float, float]]:
    """Milliseconds (n, 2) of searches of two indexes of the same frames, and what each finds."""
    times, found, none = [], [0.0, 0.0], Tail.empty(queries.shape[1])
    for query in [queries[0], *queries]:  # the first warms up
        right = set(search(query, one, none, 10, metric="l2", exact=True).keys.tolist())
        own = list[float]()
        for which, generation in enumerate((several, one)):
            clock = Clock()
            hits = clock.run("search", partial(search, query, generation, none, SIZE, metric="l2"))
            own.append(clock.stages["search"])
            found[which] += len(right & set(hits.keys[:10].tolist())) / 10
        times.append(own)
    share = found[0] / len(times), found[1] / len(times)
    return np.array(times[1:]), share


def _probed(folder: Path, queries: Bytes) -> list[float]:
    asked = folder.parent / "asked.npy"
    np.save(asked, queries)
    command = [sys.executable, "-c", _PROBE, str(folder), str(asked)]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    return [float(value) for value in done.stdout.split()]


def table(figures: list[SearchFigures]) -> list[str]:
    """The figures as lines of Markdown."""
    return [
        f"### Search for the {SIZE} nearest frames: one thread, warm",
        "",
        "| frames | bytes | compared | search, ms | all, ms | search / all | recall@10 "
        "| publish, s | append 1,000, s | open and verify, s | memory: own, shared, MB |",
        "|--:|--:|---|--:|--:|--:|--:|--:|--:|--:|--:|",
        *(
            f"| {f.frames:,} | {f.signature_bytes} "
            f"| {'by sketches' if f.probes else 'all'} | {f.search:.2f} | {f.exact:.2f} "
            f"| {f.ratio:.2f} | {f.recall:.4f} | {f.publish / 1e3:.1f} | {f.append / 1e3:.1f} "
            f"| {f.open / 1e3:.2f} | {f.held:.0f}, {f.shared:.0f} |"
            for f in figures
        ),
        "",
        "A service compares all frames of a map up to 16 MiB of signatures, and selects frames by "
        "sketches beyond.",
        "",
    ]


def growth_table(figures: list[GrowthFigures]) -> list[str]:
    """The figures as lines of Markdown."""
    return [
        f"### An index that grows to its size in {STEPS} equal steps",
        "",
        "| frames | bytes | segments | written, times its size | an append writes of it "
        "| append, ms: median, dearest | whole, ms | append / whole | search, ms: segments, one "
        "| segments / one | recall@10: segments, one |",
        "|--:|--:|--:|--:|--:|--:|--:|--:|--:|--:|--:|",
        *(
            f"| {f.frames:,} | {f.signature_bytes} | {f.segments} | {f.written:.1f} "
            f"| {f.share:.3f} | {f.append:.0f}, {f.largest:.0f} | {f.whole:.0f} "
            f"| {f.append_ratio:.3f} | {f.search:.2f}, {f.one:.2f} | {f.search_ratio:.2f} "
            f"| {f.recall:.4f}, {f.recall_one:.4f} |"
            for f in figures
        ),
        "",
    ]


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, nargs="+", default=[10_000, 100_000, 1_000_000])
    parser.add_argument("--sketches", action="store_true", help="by sketches as well")
    parser.add_argument("--growth", action="store_true", help="only what a growing index costs")
    parser.add_argument("--runs", type=int, default=15)
    options = parser.parse_args()
    pin_to_one_processor()
    kinds = (FLAT, SKETCHES) if options.sketches else (FLAT,)
    sizes = [(n, kind) for kind in kinds for n in options.frames]
    if options.growth:
        grown = [measure_growth(n, flat_bytes=kind, runs=options.runs) for n, kind in sizes]
        print("\n".join(growth_table(grown)))
        return 0
    figures = [measure(n, flat_bytes=kind, runs=options.runs) for n, kind in sizes]
    print("\n".join(table(figures)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
