"""How soon a service with a large map answers after a start, and what a second worker brings.

`python -m benchmarks.readiness` measures this row alone.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from zlib import crc32

import numpy as np
from sqlalchemy import insert, update

from benchmarks.machine import memory_of
from benchmarks.search import signatures as signatures_of
from sceneprint.engine import Engine
from sceneprint.formats.dataset import FrameReference, find_sequences
from sceneprint.settings import Settings
from sceneprint.store.maps import find_map
from sceneprint.store.tables import frames as frame_table
from sceneprint.store.tables import maps, signatures
from sceneprint_client import Client
from sceneprint_client.api import NewMap
from sceneprint_client.api.maps import Preset
from sceneprint_lab.cli.demo import serving

MAP = "bench"
#: Frames that are written in one commit.
_BLOCK = 5_000


@dataclass(frozen=True)
class ReadinessFigures:
    """Seconds from starting the command; frames a second.

    `ready`: until it answers; `first`: until the first query is answered; `bare`: the same with
    the index deleted, so that all signatures are read from the database; `bare_exact`: whether
    that answer compared every frame. `memory`: megabytes that the service has for itself then.
    `signed`: frames a second by workers.
    """

    frames: int
    signature_bytes: int
    ready: float
    first: float
    memory: float
    bare: float
    bare_memory: float
    bare_exact: bool
    signed: dict[int, float]

    @property
    def gain(self) -> float:
        """Of two workers over one."""
        return self.signed[2] / self.signed[1]


def measure(
    frame: FrameReference, to_sign: list[FrameReference], frames: int = 10_000,
    model: Preset = "depth",
) -> ReadinessFigures:  # fmt: skip
    """Fill a map with signatures, start a service on it, and ask; then let workers sign.

    Parameters
    ----------
    frame : that is asked for
    to_sign : frames that workers sign
    frames : of the map
    model : a preset
    """
    with TemporaryDirectory() as folder:
        data = Path(folder) / "large"
        length = fill_map(data, frames, model)
        ready, first, memory, _ = _start(data, frame)
        shutil.rmtree(data / "index", ignore_errors=True)  # of psi there is none
        _, bare, bare_memory, exact = _start(data, frame)
        signed = {n: _sign(Path(folder) / f"by-{n}", to_sign, n, model) for n in (1, 2)}
    return ReadinessFigures(frames, length, ready, first, memory, bare, bare_memory, exact, signed)


def fill_map(data: Path, frames: int, model: Preset) -> int:
    """Make the map of frames, whose signatures are in groups as those of places are; returns the
    bytes of each.
    """
    with Engine(Settings(data_dir=data)) as engine:
        engine.create_map(NewMap(name=MAP, model=model))
        artifact = engine.store.blobs.put(b"none")
        length = engine.view(MAP)[1].signature_bytes
        with engine.store.database.read() as connection:
            row = find_map(connection, MAP)
        frame = {
            "map_number": row.number, "state": "indexed", "blob": artifact, "bytes": 4,
            "intrinsics": {}, "depth_scale": 1000.0, "depth_along_ray": False, "tags": [],
            "received_at": time.time(), "indexed_at": time.time(),
        }  # fmt: skip
        stored = {"model_id": row.model_id, "geometry": artifact, "n_patches": [1], "n_pairs": [1]}
        for start in range(1, frames + 1, _BLOCK):
            numbers = range(start, min(start + _BLOCK, frames + 1))
            vectors = [row.tobytes() for row in signatures_of(np.asarray(numbers), length)]
            with engine.store.database.write() as connection:
                own = [{"number": n, "id": f"{n:032x}", "content_id": f"{n:064x}", "revision": n}
                       for n in numbers]  # fmt: skip
                connection.execute(insert(frame_table), [{**frame, **one} for one in own])
                signed = [{"frame_number": n, "vector": v, "checksum": crc32(v)}
                          for n, v in zip(numbers, vectors, strict=True)]  # fmt: skip
                connection.execute(insert(signatures), [{**stored, **one} for one in signed])
                now = {"revision": numbers[-1], "used_frames": numbers[-1]}
                connection.execute(update(maps).where(maps.c.number == row.number).values(**now))
        if frames and engine.view(MAP)[1].metric == "l2":
            engine.rebuild_index(MAP)
    return length


def _start(data: Path, frame: FrameReference) -> tuple[float, float, float, bool]:
    """Seconds until the service answers, and until it has answered a query; its memory; whether
    it compared all.
    """
    begun = time.perf_counter()
    with serving(data, workers=0) as url, Client(url) as client:
        while not client.healthy():
            time.sleep(0.02)
        ready = time.perf_counter() - begun
        answer = client.query(MAP, frame, stages=("retrieve",))
        first = time.perf_counter() - begun
        return ready, first, memory_of(data, "serve") / 1e6, answer.exact


def _sign(data: Path, frames: list[FrameReference], n: int, model: Preset) -> float:
    """Frames that so many workers sign in a second, from the first that is signed to the last."""
    if len(frames) <= 16:
        raise ValueError(f"{len(frames)} frames are too few to time two workers with")
    with Client.embedded(data) as client:
        client.create_map(MAP, model=model)
        for frame in frames:
            client.upload(MAP, frame)
        command = [sys.executable, "-m", "sceneprint", "work", "--data", str(data)]
        with subprocess.Popen([*command, "--workers", str(n)], stderr=subprocess.DEVNULL) as work:
            try:
                # all workers have begun before the clock does: each has signed something
                before, begun = _until(client, 8 * n)
                after, ended = _until(client, len(frames))
            finally:
                work.terminate()
    return (after - before) / (ended - begun)


def _until(client: Client, signed: int) -> tuple[int, float]:
    """How many frames are signed when so many are, and when; asked for rarely, as it costs."""
    while (found := (client.status().jobs or {}).get("succeeded", 0)) < signed:
        time.sleep(0.05)
    return found, time.perf_counter()


def table(f: ReadinessFigures) -> list[str]:
    """The figures as lines of Markdown."""
    return [
        f"### A service with {f.frames:,} frames of {f.signature_bytes:,} bytes starts",
        "",
        "| | s, MB |",
        "|---|--:|",
        f"| until it answers | {f.ready:.1f} |",
        f"| until the first query is answered | {f.first:.1f} |",
        f"| the same with its index deleted, from the database, exactly | {f.bare:.1f} |",
        f"| its own memory then | {f.memory:.0f} |",
        f"| the same without its index | {f.bare_memory:.0f} |",
        "",
        f"One worker signs {f.signed[1]:.1f} frames a second, two {f.signed[2]:.1f}: "
        f"**{f.gain:.2f}** times as many.",
        "",
    ]


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--frames", type=int, default=10_000)
    parser.add_argument("--sign", type=int, default=200)
    options = parser.parse_args()
    found = [frame for one in find_sequences(options.dataset) for frame in one.frames]
    print("\n".join(table(measure(found[0], found[1 : 1 + options.sign], options.frames))))
    return 0


if __name__ == "__main__":
    sys.exit(main())
