"""What a frame, a query and a commit of a fleet cost, so that more can be reckoned on paper.

`python -m benchmarks.fleet.costs [--frames N] [--model NAME] [--page docs/performance.md]`: real
PostgreSQL, fsync on, with a synchronous standby, blobs in a server of objects, and the engine in
this process: nothing waits for another but for the disk, so that what is measured is work.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, cast

import numpy as np

from benchmarks.fleet.paper import Costs, paper
from benchmarks.fleet.postgres_pair import DATABASE, Pair
from benchmarks.fleet.recordings import ROOM_FRAMES, recordings
from benchmarks.fleet.resource_usage import Meter, Work, memory_of
from benchmarks.fleet.s3 import ObjectServer
from benchmarks.machine import describe_machine
from benchmarks.pages import put_between
from sceneprint.engine import Engine
from sceneprint.formats.dataset import FrameReference, find_sequences
from sceneprint.models import read_model
from sceneprint.settings import Settings
from sceneprint.store.database import Database
from sceneprint.store.events import number_events
from sceneprint_client.api import NewMap, Query
from sceneprint_client.frame_files import meta_of

BEGIN, END = "<!-- fleet-costs:begin -->", "<!-- fleet-costs:end -->"
MAP = "costs"
#: Commits that are timed, and vectors that are linked.
COMMITS = 300


def measure(folder: Path, data: Path, n: int, model: str) -> Costs:
    """Measure all of it.

    Parameters
    ----------
    folder : empty
    data : folder of recordings
    n : frames
    model : name of a preset
    """
    frames = _frames(data, n + 1)
    pair = Pair(folder / "database", synchronous=True)
    objects = ObjectServer(log=folder / "requests")
    try:
        pair.begin()
        objects.start()
        os.environ.update(objects.env)
        settings = Settings(
            data_dir=folder / "host", database_url=cast(Any, pair.url),
            blob_url=cast(Any, objects.bucket("costs")),
        )  # fmt: skip
        with Engine(settings) as engine:
            engine.create_map(NewMap(name=MAP, model=model))
            _through(engine, frames[:1])  # what is opened once
            tables, blobs = _tables(pair), _blobs(engine)
            meter = Meter(pair, objects)
            uploaded = _upload(engine, meter, frames[1:])
            signed = _sign(engine, meter, n)
            number_events(engine.store.database)
            grown = {
                name: (size - tables.get(name, 0)) / n for name, size in _tables(pair).items()
                if name != "pending_events"  # which is empty again
            }  # fmt: skip
            kept = _blobs(engine) - blobs
            queried = _query(engine, meter, frames[1 :: max(n // 20, 1)])
            synchronous = _commits(engine.store.database)
            pair.primary.execute("ALTER SYSTEM SET synchronous_standby_names = ''")
            pair.primary.execute("SELECT pg_reload_conf()")
            alone = _commits(engine.store.database)
    finally:
        pair.end()
        objects.kill()
    uploads = sum(frame.path.stat().st_size for frame in frames[1:])
    return Costs(
        model=model,
        signature_bytes=read_model(model).signature_bytes,
        frames=n,
        upload=uploaded,
        sign=signed,
        query=queried,
        tables={name: size for name, size in grown.items() if size >= 10},
        blobs=(uploads / n, (kept - uploads) / n),
        commit_ms={"alone": alone, "with a synchronous standby": synchronous},
        memory=memory_of(folder, frames),
    )


def _frames(data: Path, n: int) -> list[FrameReference]:
    found = [
        one for sequence in find_sequences(data) for one in sequence.frames if one.kind == "depth"
    ]
    return found[:n]


def _through(engine: Engine, frames: Sequence[FrameReference]) -> None:
    for frame in frames:
        engine.add_frame(MAP, frame.path.read_bytes(), meta_of(frame))
    _sign_all(engine)


def _sign_all(engine: Engine) -> None:
    while (work := engine.claim("costs")) is not None:
        engine.run(work)


def _upload(engine: Engine, meter: Meter, frames: Sequence[FrameReference]) -> Work:
    seconds = []
    with meter.running() as told:
        for frame in frames:
            data, meta = frame.path.read_bytes(), meta_of(frame)
            begun = time.perf_counter()
            engine.add_frame(MAP, data, meta)
            seconds.append(time.perf_counter() - begun)
        return told(seconds)


def _sign(engine: Engine, meter: Meter, n: int) -> Work:
    seconds = []
    with meter.running() as told:
        for _ in range(n):
            begun = time.perf_counter()
            work = engine.claim("costs")
            if work is None:
                raise RuntimeError("a job is missing")
            engine.run(work)
            seconds.append(time.perf_counter() - begun)
        return told(seconds)


def _query(engine: Engine, meter: Meter, frames: Sequence[FrameReference]) -> Work:
    seconds = []
    engine.queries.upload([MAP], frames[0].path.read_bytes(), meta_of(frames[0]), Query())
    with meter.running() as told:
        for frame in frames:
            data, meta = frame.path.read_bytes(), meta_of(frame, with_pose=False)
            begun = time.perf_counter()
            engine.queries.upload([MAP], data, meta, Query())
            seconds.append(time.perf_counter() - begun)
        return told(seconds)


def _tables(pair: Pair) -> dict[str, int]:
    """Bytes of each table with its indexes and what is kept beside it."""
    found = pair.primary.execute(
        "SELECT relname, pg_total_relation_size(oid) FROM pg_class "
        "WHERE relkind = 'r' AND relnamespace = 'public'::regnamespace",
        DATABASE,
    )
    return {str(name): cast(int, size) for name, size in found}


def _blobs(engine: Engine) -> int:
    return sum(engine.store.blobs.size(one) or 0 for one in engine.store.blobs.digests())


def _commits(database: Database) -> tuple[float, float]:
    """p50 and p99 of the smallest write in its turn, milliseconds."""
    from sqlalchemy import text

    with database.write() as connection:
        connection.execute(text("CREATE TABLE IF NOT EXISTS commits_timed (n bigint)"))
    taken = []
    for number in range(COMMITS):
        begun = time.perf_counter()
        with database.write() as connection:
            connection.execute(text("INSERT INTO commits_timed VALUES (:n)"), {"n": number})
        taken.append(1e3 * (time.perf_counter() - begun))
    with database.write() as connection:
        connection.execute(text("DROP TABLE commits_timed"))
    p50, p99 = np.percentile(taken, (50, 99)).tolist()
    return p50, p99


def table(found: Costs) -> list[str]:
    """The figures as lines of Markdown."""
    lines = [
        f"### Of a frame and a query: {found.frames} frames of 640 x 480, `{found.model}` "
        f"({found.signature_bytes:,} bytes a signature)",
        "",
        "| | wall, ms | own CPU, ms | of the database, ms | in turn, ms | commits | WAL, bytes | "
        "requests of objects |",
        "|---|--:|--:|--:|--:|--:|--:|---|",
    ]
    for name, one in (("upload", found.upload), ("sign", found.sign), ("query", found.query)):
        lines.append(
            f"| {name} | {one.wall_ms:.1f} | {one.own_ms:.1f} | {one.database_ms:.1f} | "
            f"{one.turn_ms:.1f} | {one.commits[0]:.1f} + {one.commits[1]:.1f} | "
            f"{one.wal_bytes:,.0f} | "
            + ", ".join(f"{n:.1f} {method}" for method, n in sorted(one.requests.items()))
            + " |"
        )
    rows = sum(found.tables.values())
    told = ", ".join(
        f"`{name}` {size:,.0f}" for name, size in sorted(found.tables.items(), key=lambda o: -o[1])
    )
    lines += [
        "",
        "| | |",
        "|---|--:|",
        f"| database, bytes a frame ({told}) | {rows:,.0f} |",
        f"| blobs, bytes a frame: upload, geometry artifact | {found.blobs[0]:,.0f}, "
        f"{found.blobs[1]:,.0f} |",
    ]
    for name, (p50, p99) in found.commit_ms.items():
        lines.append(f"| smallest write in its turn, {name}: p50, p99 | {p50:.1f}, {p99:.1f} ms |")
    for name, size in sorted(found.memory.items()):
        lines.append(f"| memory of a {name}'s own, after some work | {size / 1e6:,.0f} MB |")
    return [*lines, ""]


def main(arguments: list[str] | None = None) -> int:
    """Measure, and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=100)
    parser.add_argument("--model", default="depth")
    parser.add_argument("--data", type=Path, help="folder of recordings; default: synthetic rooms")
    parser.add_argument("--page", type=Path, help="whose figures to replace")
    options = parser.parse_args(arguments)
    wanted = -(-(options.frames + 1) // ROOM_FRAMES)
    with (
        recordings(options.data, wanted * ROOM_FRAMES * 16) as data,
        tempfile.TemporaryDirectory(prefix="sceneprint-costs-") as folder,
    ):
        found = measure(Path(folder), data, options.frames, options.model)
    machine = describe_machine()
    when = (
        f"Measured {datetime.now(UTC):%Y-%m-%d} on {machine.processor}, {machine.cores} "
        "processors; `python -m benchmarks.fleet.costs`."
    )
    lines = ["", when, "", *table(found), *paper(found)]
    print("\n".join(lines))
    if options.page is not None:
        put_between(options.page, BEGIN, END, lines)
    return 0


if __name__ == "__main__":
    sys.exit(main())
