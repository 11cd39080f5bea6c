"""Walks that robots replay: frames of recordings, downsampled to different grids."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from sceneprint.errors import DatasetError
from sceneprint.formats.dataset import FrameReference, find_sequences, write_depth_png
from sceneprint.types import DepthFrame
from sceneprint_client.api import CameraIntrinsics, FrameMeta
from sceneprint_client.frame_files import meta_of
from sceneprint_lab.cli.demo import write_building

#: A grid contains every fourth row and column of a frame, so signing is cheap. Different grids of a
#: frame have different content.
STRIDE = 4
GRIDS = STRIDE**2
#: Number of frames of a synthetic room.
ROOM_FRAMES = 30


@dataclass(frozen=True, eq=False)
class Shot:
    """A frame as a robot sends it: its file, camera and pose."""

    png: bytes
    meta: FrameMeta


@contextmanager
def recordings(data: Path | None, frames: int) -> Iterator[Path]:
    """Yield a folder of recordings, or of synthetic rooms with `frames` frames."""
    if data is not None:
        yield data
        return
    with tempfile.TemporaryDirectory(prefix="sceneprint-walks-") as folder:
        for _ in write_building(Path(folder), -(-frames // (ROOM_FRAMES * GRIDS))):
            pass
        yield Path(folder)


def walks(data: Path, n: int, frames: int) -> list[list[Shot]]:
    """Return `n` walks of `frames` frames each, the same in each call.

    Raise DatasetError if the recordings have too few frames.

    Parameters
    ----------
    data : folder of recordings
    n, frames : number of walks, and of the frames of each
    """
    recorded = [
        [frame for frame in sequence.frames if frame.kind == "depth"]
        for sequence in find_sequences(data)
    ]
    # Robots start at different places; robots of one recording have different grids.
    places = [(sequence, grid) for grid in range(GRIDS) for sequence in recorded if sequence]
    walked: list[list[tuple[FrameReference, int]]] = [[] for _ in range(n)]
    while any(len(walk) < frames for walk in walked):
        for walk in walked:
            if len(walk) >= frames:
                continue
            if not places:
                raise DatasetError(
                    f"{data} has fewer than {n * frames} frames in {GRIDS} grids. Use fewer "
                    "robots, a shorter time or more recordings."
                )
            sequence, grid = places.pop(0)
            room = frames - len(walk)
            walk += [(frame, grid) for frame in sequence[:room]]
            if len(sequence) > room:  # another robot may use the rest
                places.append((sequence[room:], grid))
    return [[thinned(*pair) for pair in walk] for walk in walked]


def thinned(frame: FrameReference, grid: int) -> Shot:
    """Return a frame, downsampled to a grid from 0 to GRIDS - 1."""
    read, meta = _read(frame), meta_of(frame)
    k, (y, x) = read.intrinsics, divmod(grid, STRIDE)
    depth = np.ascontiguousarray(read.depth[y::STRIDE, x::STRIDE])
    height, width = depth.shape
    camera = CameraIntrinsics(
        width=width, height=height, fx=k.fx / STRIDE, fy=k.fy / STRIDE,
        cx=(k.cx - x) / STRIDE, cy=(k.cy - y) / STRIDE,
    )  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "frame.png"
        write_depth_png(path, depth, 1000.0)
        lens = {"intrinsics": camera, "depth_scale": 1000.0, "depth_along_ray": False}
        return Shot(path.read_bytes(), meta.model_copy(update=lens))


@lru_cache(maxsize=128)  # robots of one recording use the same frames consecutively
def _read(frame: FrameReference) -> DepthFrame:
    return frame.read_depth()
