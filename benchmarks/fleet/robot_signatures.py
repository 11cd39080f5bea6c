"""What a worker saves where robots send signatures with their frames.

`python -m benchmarks.fleet.robot_signatures`: processor time of a worker for each frame that it
signs, that it takes from a robot, and that it signs to compare; in turn, as the machine is shared.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sceneprint.engine import Engine
from sceneprint.engine.ingest.uploads import Upload
from sceneprint.engine.jobs.robot_signatures import FIRST
from sceneprint.formats.dataset import write_depth_png
from sceneprint.lab.synth import synthesise_room
from sceneprint.settings import Settings
from sceneprint.store.keys import find_named_key
from sceneprint.store.sender_rows import add_verified
from sceneprint_client.api import CameraIntrinsics, FrameMeta, JobState, NewMap

#: Far below any share that is drawn.
_NONE = 1e-12


@dataclass(frozen=True)
class RobotFigures:
    """Median processor time of a worker for a frame, milliseconds."""

    frames: int
    signed: float
    taken: float
    compared: float

    def ratio(self, sample: float) -> float:
        """Frames that a worker takes in the time of one that it signs, of a share sampled."""
        return self.signed / (sample * self.compared + (1 - sample) * self.taken)


def measure(frames: int, folder: Path) -> RobotFigures:
    """Let a worker of this process do uploads of three kinds."""
    uploads = _uploads(frames, folder)
    spent: dict[str, list[float]] = {"signed": [], "taken": [], "compared": []}
    engines = {name: _engine(folder / name, 1.0 if name == "compared" else _NONE) for name in spent}
    for data, meta in uploads:
        for name, engine in engines.items():
            with engine.store.database.read() as connection:
                sender = find_named_key(connection, "robot").id
            package = None if name == "signed" else engine.sign_frame("hall", data, meta)
            engine.uploads.add("hall", Upload(data, meta, signed=package, sender=sender))
            start = time.process_time()
            claimed = engine.claim("here")
            if claimed is None or engine.run(claimed) != JobState.SUCCEEDED:
                raise RuntimeError("a frame was not signed")
            spent[name].append(1e3 * (time.process_time() - start))
    for engine in engines.values():
        engine.close()
    return RobotFigures(frames, *(float(np.median(one)) for one in spent.values()))


def _uploads(frames: int, folder: Path) -> list[tuple[bytes, FrameMeta]]:
    found = []
    for frame in synthesise_room(21, 0, frames, along_path=True).frames:
        k, path = frame.intrinsics, folder / "depth.png"
        write_depth_png(path, frame.depth, 1000.0)
        camera = CameraIntrinsics(
            width=k.width, height=k.height, fx=k.fx, fy=k.fy, cx=k.cx, cy=k.cy
        )
        found.append((path.read_bytes(), FrameMeta(intrinsics=camera)))
    return found


def _engine(folder: Path, sample: float) -> Engine:
    engine = Engine(
        Settings(data_dir=folder, decoders=0, trust_signatures=True, signed_sample=sample)
    )
    engine.create_map(NewMap(name="hall", model="depth"))
    engine.create_key("robot")
    engine.warm()
    with engine.store.database.write() as connection:
        for _ in range(FIRST):
            add_verified(connection, find_named_key(connection, "robot").id)
    return engine


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=40)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        found = measure(options.frames, Path(folder))
    print(f"Processor time of a worker for a frame, ms (median of {found.frames}):")
    print(f"signed {found.signed:.1f}, taken {found.taken:.1f}, compared {found.compared:.1f}")
    for sample in (0.0, 1 / 16, 1 / 4):
        print(f"{found.ratio(sample):.1f} times as many frames with {sample:.4g} sampled")
    return 0


if __name__ == "__main__":
    sys.exit(main())
