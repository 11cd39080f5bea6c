"""Our own search beside Qdrant's engine, over the same maps: what it costs, and that it agrees.

`python -m benchmarks.fleet.qdrant_search --page docs/performance.md`: two maps, of short signatures
and of those of the paper, each on two nodes with one SQLite database, asked in turn.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

import numpy as np

from benchmarks.fleet.bulk_load import fill, walk
from benchmarks.machine import describe_machine
from benchmarks.pages import put_between
from sceneprint.engine import Engine
from sceneprint.engine.admin.statistics import sizes_of_map
from sceneprint.errors import InvalidRequest
from sceneprint.models import read_model
from sceneprint.settings import Settings
from sceneprint.store.maps import find_map
from sceneprint_client.api import NamedFrame, Query

BEGIN, END = "<!-- qdrant-search:begin -->", "<!-- qdrant-search:end -->"
#: Presets and frames of their maps.
MAPS = (("depth", 100_000), ("paper", 3_000))
#: Queries of each node, in turn.
QUERIES = 30
#: Who searches: the setting, and what the page calls it.
NODES = (("local", "own"), ("qdrant", "Qdrant"))


@dataclass(frozen=True)
class Searched:
    """One node: milliseconds of the process's own CPU, but where it says otherwise.

    Parameters
    ----------
    publish_s : seconds for publishing its index; 0 where it has none
    first : the first query after it starts, which opens and verifies the index, or reads the map
    later : median of those that follow
    bytes_per_frame : of the index on its disk
    """

    publish_s: float
    first: float
    later: float
    bytes_per_frame: float


@dataclass(frozen=True)
class Compared:
    """Both nodes over one map; `ratio` is the median of those of two queries after each other, by
    the clock.
    """

    preset: str
    frames: int
    signature_bytes: int
    nodes: tuple[Searched, ...]
    ratio: float


def measure(preset: str, frames: int, folder: Path) -> Compared:
    """Fill a map, publish its index on both nodes, and ask them in turn.

    Raises
    ------
    RuntimeError : their answers differ.
    """
    model = read_model(preset)
    made = walk(frames, model.signature_bytes, seed=1, walks=max(frames // 1000, 1))
    published, sizes = [], []
    for setting, _ in NODES:
        with _node(folder, setting) as engine:
            if setting == NODES[0][0]:
                fill(engine.store.database, "hall", model, made)
                fill(engine.store.database, "small", model, made[:500])
            _published(engine, "small")  # compiles, and loads the libraries
            published.append(_published(engine, "hall"))
            with engine.store.database.read() as connection:
                row = find_map(connection, "hall")
                size = sizes_of_map(connection, engine.store, engine.settings.indexes, row).index
            sizes.append(size / frames)
    engines = [_node(folder, setting) for setting, _ in NODES]
    for engine in engines:  # compiles kernels and loads the libraries, over another map
        _ask(engine, "small", 1)
    numbers = np.linspace(1, frames, QUERIES + 1, dtype=int).tolist()
    times: list[list[float]] = [[] for _ in engines]
    costs: list[list[float]] = [[] for _ in engines]
    for number in numbers:
        answers = []
        for engine, own, cost in zip(engines, times, costs, strict=True):
            begun, used = time.perf_counter(), time.process_time()
            answers.append(_ask(engine, "hall", number))
            own.append(time.perf_counter() - begun)
            cost.append(1e3 * (time.process_time() - used))
        if answers[0] != answers[1]:
            raise RuntimeError(f"the answers to frame {number} of {frames} differ")
    for engine in engines:
        engine.close()
    nodes = tuple(
        Searched(publish_s, cost[0], statistics.median(cost[1:]), size)
        for publish_s, cost, size in zip(published, costs, sizes, strict=True)
    )
    ratio = statistics.median(b / a for a, b in zip(times[0][1:], times[1][1:], strict=True))
    return Compared(preset, frames, model.signature_bytes, nodes, ratio)


def _node(folder: Path, setting: str) -> Engine:
    given = {"data_dir": folder, "index_dir": folder / setting, "search": setting, "decoders": 0}
    return Engine(Settings.model_validate(given))


def _published(engine: Engine, name: str) -> float:
    """Seconds of CPU that it took; 0 where the map has no index."""
    begun = time.process_time()
    try:
        engine.rebuild_index(name)
    except InvalidRequest:
        return 0.0
    return time.process_time() - begun


def _ask(engine: Engine, name: str, number: int) -> list[tuple[str, int]]:
    query = Query(stages=("retrieve",), k=50, keep=False)
    named = NamedFrame(map=name, frame_id=f"{name}-{number}")
    answer = engine.queries.stored([name], named, query)
    return [(one.frame_id, one.distance) for one in answer.matches]


def table(figures: list[Compared]) -> list[str]:
    """The figures as lines of Markdown."""
    rows: list[tuple[str, Callable[[Searched], str]]] = [
        (
            "publish the index, CPU s",
            lambda one: f"{one.publish_s:.1f}" if one.publish_s else "none",
        ),
        ("first query after a start, CPU ms", lambda one: f"{one.first:,.0f}"),
        ("later queries, median, CPU ms", lambda one: f"{one.later:.1f}"),
        ("index on the disk, bytes a frame", lambda one: f"{one.bytes_per_frame:,.0f}"),
    ]
    heads = [
        f"{one.frames:,} x {one.signature_bytes:,} B, {name}"
        for one in figures
        for _, name in NODES
    ]
    return [
        f"| | {' | '.join(heads)} |",
        "|---|" + "--:|" * len(heads),
        *(
            f"| {name} | {' | '.join(tell(node) for one in figures for node in one.nodes)} |"
            for name, tell in rows
        ),
        "",
        f"A later query takes Qdrant {' and '.join(f'{one.ratio:.1f}' for one in figures)} "
        "times as long by the clock (medians of pairs). All answers were the same.",
        "",
    ]


def main(arguments: list[str] | None = None) -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--page", type=Path, help="whose figures to replace")
    parser.add_argument("--share", type=float, default=1.0, help="of the frames of both maps")
    options = parser.parse_args(arguments)
    found = []
    for preset, frames in MAPS:
        with tempfile.TemporaryDirectory(prefix="sceneprint-qdrant-") as folder:
            found.append(measure(preset, int(frames * options.share), Path(folder)))
    machine = describe_machine()
    lines = [
        "",
        f"Measured {datetime.now(UTC):%Y-%m-%d} on {machine.processor}, {machine.cores} "
        f"processors, qdrant-edge-py {version('qdrant-edge-py')}; "
        "`python -m benchmarks.fleet.qdrant_search`.",
        "",
        *table(found),
    ]
    print("\n".join(lines))
    if options.page is not None:
        put_between(options.page, BEGIN, END, lines)
    return 0


if __name__ == "__main__":
    sys.exit(main())
