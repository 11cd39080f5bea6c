"""The demo's building: rooms walked through once, some frames for the map and some to look up."""

from __future__ import annotations

import os
from collections.abc import Generator
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path

from sceneprint.datasets import Camera, write_depth_png, write_intrinsics, write_pose

SEED = 11
#: Frames of a walk, 3 to 8 cm apart. Of every ten, those of the map and those that are looked up,
#: which are 10 to 30 cm away from any of the map.
WALK, TEN, MAP, QUERIES = 100, 10, (0, 2, 4), (7, 8)
DEPTH_SCALE = 1000.0


def write_building(folder: Path, rooms: int) -> Generator[None]:
    """Write rooms in 7-Scenes layout with split files, and yield after each.

    Parameters
    ----------
    folder : new
    rooms : how many
    """
    with ProcessPoolExecutor(
        min(os.cpu_count() or 1, rooms), mp_context=get_context("spawn")
    ) as pool:
        yield from pool.map(partial(_write_room, folder), range(rooms))


def _write_room(folder: Path, number: int) -> None:
    from sceneprint.synth import KINECT, take, trajectory
    from sceneprint.synth.synthesis import room_and_rng

    room, rng = room_and_rng(SEED, number)
    scene = folder / f"room-{number}"
    for name in ("seq-01", "seq-02"):
        (scene / name).mkdir(parents=True)
    write_intrinsics(scene, Camera(KINECT, DEPTH_SCALE, along_ray=False))
    (scene / "TrainSplit.txt").write_text("sequence1\n")
    (scene / "TestSplit.txt").write_text("sequence2\n")
    for i, pose in enumerate(trajectory(room, WALK, rng)):
        if i % TEN in MAP + QUERIES:
            run = scene / ("seq-01" if i % TEN in MAP else "seq-02")
            depth = take(room, pose, KINECT, rng)
            write_depth_png(run / f"frame-{i:06d}.depth.png", depth, DEPTH_SCALE)
            write_pose(run / f"frame-{i:06d}.pose.txt", pose)
