"""Measure the start with a large map, the speedup by a second worker, and the disk use."""

from __future__ import annotations

import shutil
import sqlite3
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.indexed_frames import fill
from benchmarks.machine import own_bytes, sum_over_processes
from benchmarks.search import signatures
from sceneprint.engine.context import open_context
from sceneprint.engine.maps.map_lifecycle import create_map
from sceneprint.engine.upkeep.index_upkeep import Upkeep
from sceneprint.formats.dataset import FrameReference
from sceneprint.models import read_model
from sceneprint.settings import Settings
from sceneprint.store.maps import find_map
from sceneprint_client import Client
from sceneprint_client.api import NewMap
from sceneprint_client.api.maps import Preset
from sceneprint_lab.cli.demo import serving

MAP = "bench"
#: Number of frames of the large map.
FRAMES = 10_000


def fill_map(data: Path, frames: int, model: Preset) -> None:
    """Create a map of `frames` frames, with clustered signatures as in real places."""
    with open_context(Settings(data_dir=data)) as context:
        store = context.store
        create_map(store, NewMap(name=MAP, model=model))
        if frames:
            vectors = signatures(np.arange(frames), read_model(model).signature_bytes)
            blob = store.blobs.put(b"none")
            fill(store.database, MAP, read_model(model), vectors, blob=blob)
            with store.database.read() as connection:
                row = find_map(connection, MAP)
            Upkeep(context).rebuild(row)


def measure(frame: FrameReference, to_sign: Sequence[FrameReference]) -> list[str]:
    """Start a service on a large map, query it, and let workers sign; return the table.

    Parameters
    ----------
    frame : query frame
    to_sign : frames for the workers
    """
    with TemporaryDirectory() as folder:
        data = Path(folder) / "large"
        fill_map(data, FRAMES, "depth")
        ready, first, memory = _start_times(data, frame)
        shutil.rmtree(data / "index")
        _, bare, bare_memory = _start_times(data, frame)
        signed = {n: _signing_rate(Path(folder) / f"by-{n}", to_sign, n) for n in (1, 2)}
    length = read_model("depth").signature_bytes
    return [
        f"### Start of a service with {FRAMES:,} frames of {length:,} bytes", "", "| | s, MB |",
        "|---|--:|", f"| until it is ready | {ready:.1f} |",
        f"| until the first query is answered | {first:.1f} |",
        f"| until the first exact answer without an index | {bare:.1f} |",
        f"| private memory after that | {memory:.0f} |",
        f"| private memory without an index | {bare_memory:.0f} |", "",
        f"One worker signs {signed[1]:.1f} frames per second, two sign {signed[2]:.1f}: "
        f"**{signed[2] / signed[1]:.2f}** times as many.",
        "",
    ]  # fmt: skip


def _start_times(data: Path, frame: FrameReference) -> tuple[float, float, float]:
    """Return the times until a service is ready and answers a query, s, and its memory, MB."""
    begun = time.perf_counter()
    with serving(data, workers=0) as url, Client(url) as client:
        while not client.healthy():
            time.sleep(0.02)
        ready = time.perf_counter() - begun
        client.query(MAP, frame, stages=("retrieve",))
        first = time.perf_counter() - begun
        return ready, first, sum_over_processes(own_bytes, data, "serve") / 1e6


def _signing_rate(data: Path, frames: Sequence[FrameReference], n: int) -> float:
    """Return the frames per second that `n` workers sign; raise ValueError for too few frames."""
    if len(frames) <= 16:
        raise ValueError(f"{len(frames)} frames are too few to time two workers.")
    with Client.embedded(data) as client:
        client.create_map(MAP, model="depth")
        for frame in frames:
            client.upload(MAP, frame)
        command = [sys.executable, "-m", "sceneprint", "work", "--data", str(data)]
        with subprocess.Popen([*command, "--workers", str(n)], stderr=subprocess.DEVNULL) as work:
            try:
                before, begun = _await_signed(client, 8 * n)
                after, ended = _await_signed(client, len(frames))
            finally:
                work.terminate()
    return (after - before) / (ended - begun)


def _await_signed(client: Client, signed: int) -> tuple[int, float]:
    """Wait until at least `signed` frames are signed; return their number and the time."""
    while (done := (client.status().jobs or {}).get("succeeded", 0)) < signed:
        time.sleep(0.05)
    return done, time.perf_counter()


def measure_disk(frames: Sequence[FrameReference]) -> list[str]:
    """Return a table of the disk use per frame: rows, upload and geometry artifact.

    `frames`: at least four frames; the first quarter creates the database.
    """
    lines = [
        "### Disk use per frame without the index, bytes", "",
        "| signature | rows of the database | upload | geometry artifact |", "|--:|--:|--:|--:|",
    ]  # fmt: skip
    first = max(len(frames) // 4, 1)
    n = len(frames) - first
    uploads = sum(frame.path.stat().st_size for frame in frames[first:])
    models: tuple[Preset, ...] = ("depth", "paper")
    for model in models:
        sizes = []
        with TemporaryDirectory() as name:
            folder = Path(name)
            for some in (frames[:first], frames[first:]):
                with Client.embedded(folder) as client:
                    client.create_map("disk", model=model)
                    added = [client.upload("disk", frame) for frame in some]
                    client.wait([upload.job_id for upload in added])
                blobs = [
                    path.stat().st_size for path in (folder / "blobs").rglob("*") if path.is_file()
                ]
                sizes.append((_used_bytes(folder / "sceneprint.db"), sum(blobs)))
        rows, written = np.subtract(sizes[1], sizes[0])
        lines.append(
            f"| {read_model(model).signature_bytes:,} | {rows / n:,.0f} | {uploads / n:,.0f} "
            f"| {(written - uploads) / n:,.0f} |"
        )
    return [*lines, ""]


def _used_bytes(database: Path) -> int:
    """Return the size of the used pages of a database, including its log, bytes."""
    with closing(sqlite3.connect(database)) as connection:
        count, free, size = (
            connection.execute(f"PRAGMA {name}").fetchone()[0]
            for name in ("page_count", "freelist_count", "page_size")
        )
    return int((count - free) * size)
