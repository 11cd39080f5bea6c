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

import numpy as np

from sceneprint.cli.served import serving
from sceneprint.client import Client
from sceneprint.datasets import FrameReference, find_sequences
from sceneprint.engine import Engine
from sceneprint.schemas import NewMap
from sceneprint.schemas.maps import Preset
from sceneprint.settings import Settings
from sceneprint.store.frames import add_frame
from sceneprint.store.maps import find_map
from sceneprint.store.signatures import StoredSignature, index_frame

MAP = "bench"
#: Frames that are written in one commit.
_BLOCK = 500


@dataclass(frozen=True)
class ReadinessFigures:
    """Seconds from starting the command; frames a second.

    `ready`: until it answers; `first`: until the first query is answered; `bare`: the same with
    the index deleted, so that all signatures are read from the database; `bare_exact`: whether
    that answer compared every frame. `signed`: frames a second by workers.
    """

    frames: int
    signature_bytes: int
    ready: float
    first: float
    bare: float
    bare_exact: bool
    signed: dict[int, float]

    @property
    def gain(self) -> float:
        """Of two workers over one."""
        return self.signed[2] / self.signed[1]


def measure(
    frame: FrameReference, to_sign: list[FrameReference], frames: int = 10_000,
    model: Preset = "paper",
) -> ReadinessFigures:  # fmt: skip
    """Fill a map with random signatures, start a service on it, and ask; then let workers sign.

    Parameters
    ----------
    frame : that is asked for
    to_sign : frames that workers sign
    frames : of the map
    model : a preset
    """
    with TemporaryDirectory() as folder:
        data = Path(folder) / "large"
        length = _fill(data, frames, model)
        ready, first, _ = _start(data, frame)
        shutil.rmtree(data / "index")
        _, bare, exact = _start(data, frame)
        signed = {n: _sign(Path(folder) / f"by-{n}", to_sign, n, model) for n in (1, 2)}
    return ReadinessFigures(frames, length, ready, first, bare, exact, signed)


def _fill(data: Path, frames: int, model: Preset) -> int:
    rng = np.random.default_rng(0)
    with Engine(Settings(data_dir=data)) as engine:
        engine.create_map(NewMap(name=MAP, model=model))
        artifact = engine.store.blobs.put(b"none")
        length = engine.view(MAP)[1].signature_bytes
        for start in range(0, frames, _BLOCK):
            with engine.store.database.write() as connection:
                row = find_map(connection, MAP)
                for i in range(start, min(start + _BLOCK, frames)):
                    values = {
                        "content_id": f"{i:064x}", "blob": artifact, "bytes": 4, "robot": None,
                        "intrinsics": {}, "depth_scale": 1000.0, "depth_along_ray": False,
                        "session": None, "captured_at": None, "tags": [], "pose_parent": None,
                        "pose": None,
                    }  # fmt: skip
                    added = add_frame(connection, row.number, values)
                    vector = rng.integers(0, 256, length, np.uint8).tobytes()
                    made = StoredSignature(row.model_id, vector, artifact, (1,), (1,))
                    index_frame(connection, added, made)
        engine.rebuild_index(MAP)
    return length


def _start(data: Path, frame: FrameReference) -> tuple[float, float, bool]:
    """Seconds until the service answers, and until it has answered a query; whether exactly."""
    begun = time.perf_counter()
    with serving(data, workers=0) as url, Client(url) as client:
        while not client.healthy():
            time.sleep(0.02)
        ready = time.perf_counter() - begun
        answer = client.query(MAP, frame, stages=("retrieve",))
        return ready, time.perf_counter() - begun, answer.exact


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
        "| | s |",
        "|---|--:|",
        f"| until it answers | {f.ready:.1f} |",
        f"| until the first query is answered | {f.first:.1f} |",
        f"| the same with its index deleted, from the database, exactly | {f.bare:.1f} |",
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
