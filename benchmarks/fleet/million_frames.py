"""What operators' requests and care of the store cost over a million frames, beside ten thousand.

`python -m benchmarks.fleet.million_frames [--frames N] [--page docs/performance.md]`: rows as
workers leave them, of random signatures, in SQLite. What is told is the wall time of the first
request, and the median of those that follow; the machine may be shared.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from sqlalchemy import insert, select
from tqdm import tqdm

from benchmarks.fleet.bulk_load import fill
from benchmarks.machine import describe_machine
from benchmarks.pages import put_between
from sceneprint.engine import Engine
from sceneprint.engine.admin.statistics import TOLD_S
from sceneprint.maintenance.fsck.check import fsck
from sceneprint.maintenance.scrub import Scrub
from sceneprint.maintenance.snapshot.creation import take_snapshot
from sceneprint.models import read_model
from sceneprint.settings import Settings
from sceneprint.store.tables import frames, jobs
from sceneprint_client.api import JobState

BEGIN, END = "<!-- million-frames:begin -->", "<!-- million-frames:end -->"
#: Maps, of which the first has half of the frames; frames put in at once; requests that are timed.
MAPS, BLOCK, REQUESTS = 50, 10_000, 9
FEW = 10_000
#: Frames that come after the first snapshot, and bytes of the upload of each.
LATER, UPLOAD = 100, 100_000
LENS = {"width": 640, "height": 480, "fx": 585.0, "fy": 585.0, "cx": 320.0, "cy": 240.0}


def measure(folder: Path, n: int) -> dict[str, tuple[float, float]]:
    """Milliseconds of the first request and of those that follow, by what is asked.

    Parameters
    ----------
    folder : empty
    n : frames
    """
    with Engine(Settings(data_dir=folder)) as engine:
        for start in tqdm(range(0, n, BLOCK), unit="block", disable=None, leave=False):
            name = "map-0" if start % (2 * BLOCK) == 0 else f"map-{1 + start // BLOCK % (MAPS - 1)}"
            _add(engine, name, min(BLOCK, n - start), start)
        _end_jobs(engine)
        operations = engine.operations
        page = operations.wanted()
        return {
            "`GET /metrics`": _timed(operations.statistics.figures, TOLD_S),
            "`GET /v1/stats`": _timed(operations.statistics.tell),
            "`GET /readyz` with a key": _timed(engine.counts),
            "page of 100 frames": _timed(lambda: engine.list_frames("map-0", limit=100)),
            "page of 100 events": _timed(lambda: operations.events(page, newest_first=True)),
            "removal of events, nothing due": _timed(operations.remove_spent),
            "retention, nothing due": _timed(engine.retiring.run),
        }


def _add(engine: Engine, name: str, n: int, seed: int) -> None:
    """Put frames into a map, all with the same upload, which is there."""
    model = read_model("depth")
    made = np.random.default_rng(seed).integers(0, 255, (n, model.signature_bytes), np.uint8)
    blob = engine.store.blobs.put(b"upload and artifact")
    fill(engine.store.database, name, model, made, [{"intrinsics": LENS}] * n, blob)


def maintain(folder: Path) -> dict[str, tuple[float, float | None]]:
    """Seconds and megabytes of what is done to the whole store, or a slice of it.

    Parameters
    ----------
    folder : as `measure` left it
    """
    settings, found = Settings(data_dir=folder), dict[str, tuple[float, float | None]]()
    full = folder.parent / "full.tar"
    begun = time.perf_counter()
    take_snapshot(settings, full)
    found["snapshot"] = time.perf_counter() - begun, full.stat().st_size / 1e6
    with Engine(settings) as engine:
        for i in range(LATER):
            _add_upload(engine, i)
        begun = time.perf_counter()
        slice_ = Scrub(settings, engine.store).run(now=True)
        found["one slice of the workers' scrub"] = time.perf_counter() - begun, None
        if slice_ is None or slice_.position == 0:
            raise RuntimeError("nothing was scrubbed")
    begun = time.perf_counter()
    wrong = {one.finding.kind for one in fsck(settings)}
    found["`sceneprint fsck` of everything"] = time.perf_counter() - begun, None
    if wrong - {"other-use"}:  # rows that no upload has counted
        raise RuntimeError(f"the store is not sound: {wrong}")
    return found


def _add_upload(engine: Engine, number: int) -> None:
    """A frame with an upload of its own, which no worker signs."""
    model = read_model("depth")
    rng = np.random.default_rng([1, number])
    blob = engine.store.blobs.put(rng.bytes(UPLOAD))
    made = rng.integers(0, 255, (1, model.signature_bytes), np.uint8)
    fill(engine.store.database, "map-0", model, made, [{"intrinsics": LENS}], blob)


def _end_jobs(engine: Engine) -> None:
    """A job that succeeded for each frame."""
    with engine.store.database.write() as connection:
        found = connection.execute(select(frames.c.number, frames.c.map_number, frames.c.id)).all()
        common = {
            "kind": "sign", "state": JobState.SUCCEEDED, "priority": 0, "attempts": 1,
            "failures": 0, "token": 1, "run_after": 0.0, "created_at": 0.0, "finished_at": 1.0,
            "tenant": "",
        }  # fmt: skip
        for start in range(0, len(found), BLOCK):
            some = found[start : start + BLOCK]
            connection.execute(
                insert(jobs),
                [
                    {"id": f"{number:032x}", "frame_number": number, "map_number": of_map, **common}
                    for number, of_map, _ in some
                ],
            )


def _timed(ask: Callable[[], object], pause_s: float = 0.0) -> tuple[float, float]:
    taken = []
    for _ in range(1 + REQUESTS):
        begun = time.perf_counter()
        ask()
        taken.append(1e3 * (time.perf_counter() - begun))
        time.sleep(pause_s)  # what is told for a moment is looked at again
    return taken[0], statistics.median(taken[1:])


def _told(figures: tuple[float, float | None]) -> str:
    seconds, megabytes = figures
    return f"{seconds:.2f}" + ("" if megabytes is None else f", {megabytes:,.0f}")


def main(arguments: list[str] | None = None) -> int:
    """Measure, and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=1_000_000)
    parser.add_argument("--page", type=Path, help="whose figures to replace")
    options = parser.parse_args(arguments)
    found, cared = [], []
    for n in (FEW, options.frames):
        with tempfile.TemporaryDirectory(prefix="sceneprint-million-") as folder:
            found.append(measure(Path(folder) / "data", n))
            cared.append(maintain(Path(folder) / "data"))
    machine = describe_machine()
    lines = [
        "",
        f"Measured {datetime.now(UTC):%Y-%m-%d} on {machine.processor}, {machine.cores} "
        "processors; `python -m benchmarks.fleet.million_frames`.",
        "",
        f"| milliseconds: first, then | {FEW:,} frames | {options.frames:,} frames |",
        "|---|--:|--:|",
        *(
            f"| {name} | {few[0]:.1f}, {few[1]:.1f} | {many[0]:.1f}, {many[1]:.1f} |"
            for name, few, many in ((name, few, found[1][name]) for name, few in found[0].items())
        ),
        "",
        f"| seconds, megabytes | {FEW:,} frames | {options.frames:,} frames |",
        "|---|--:|--:|",
        *(f"| {name} | {_told(few)} | {_told(cared[1][name])} |" for name, few in cared[0].items()),
        "",
    ]
    print("\n".join(lines))
    if options.page is not None:
        put_between(options.page, BEGIN, END, lines)
    return 0


if __name__ == "__main__":
    sys.exit(main())
