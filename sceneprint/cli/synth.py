"""`sceneprint synth`: synthetic rooms, or sites scanned by a laser, as a data set."""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from tqdm import tqdm

from sceneprint.cli.numbers import positive, whole
from sceneprint.clouds import write_ply
from sceneprint.datasets import Camera, write_depth_png, write_intrinsics, write_pose
from sceneprint.errors import DatasetError

#: Stored units per metre.
DEPTH_SCALE = 1000.0


def add_to(commands: Any) -> None:
    """Describe the command to the parser."""
    command = commands.add_parser(
        "synth",
        help="make synthetic rooms with known poses",
        description="Ray-cast furnished rooms as a Kinect would see them, and write them in "
        "7-Scenes layout: OUT/room-000/seq-01/frame-000000.depth.png and .pose.txt. With "
        "--sensor lidar: halls, storeys and blocks as a spinning laser would see them, "
        "OUT/site-000/scan-000000.ply and .pose.txt.",
    )
    command.add_argument("out", type=Path, metavar="OUT", help="folder; new or empty")
    command.add_argument(
        "--sensor", choices=("kinect", "lidar"), default="kinect", help="default: kinect"
    )
    command.add_argument(
        "--rooms", type=positive, default=4, metavar="N", help="or sites (default: 4)"
    )
    command.add_argument(
        "--views", type=positive, default=25, metavar="M", help="of each room (default: 25)"
    )
    command.add_argument("--seed", type=whole, default=0, metavar="S", help="default: 0")
    command.add_argument(
        "--path",
        action="store_true",
        help="views along a hand-held path, a few centimetres apart, not scattered; with "
        "--sensor lidar a walk, 1.5 m apart",
    )
    command.add_argument("--perfect", action="store_true", help="without sensor noise")
    command.add_argument(
        "--jobs", type=positive, default=os.cpu_count() or 1, metavar="N", help="processes"
    )
    command.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Make the rooms."""
    if options.out.exists() and any(options.out.iterdir()):
        raise DatasetError(
            f"{options.out}: is not empty, and frames of two runs must not mix. "
            "Name a new folder, or empty this one."
        )
    options.out.mkdir(parents=True, exist_ok=True)
    with tqdm(total=options.rooms, desc="synth", unit="room", disable=None) as bar:
        for _ in _rooms(options):
            bar.update()
    made = "sites" if options.sensor == "lidar" else "rooms"
    print(f"{options.rooms} {made} of {options.views} views in {options.out}")
    return 0


def _rooms(options: argparse.Namespace) -> Iterator[None]:
    make = partial(
        _write_site if options.sensor == "lidar" else _write_room,
        options.out,
        options.seed,
        options.views,
        along_path=options.path,
        perfect=options.perfect,
    )
    jobs = min(options.jobs, options.rooms)
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        yield from pool.map(make, range(options.rooms))


def _write_room(
    out: Path, seed: int, views: int, index: int, *, along_path: bool, perfect: bool
) -> None:
    from sceneprint.synth import KinectNoise, synthesise_room

    noise = None if perfect else KinectNoise()
    room = synthesise_room(seed, index, views, along_path=along_path, noise=noise)
    folder = out / room.name
    sequence = folder / "seq-01"
    sequence.mkdir(parents=True)
    write_intrinsics(folder, Camera(room.frames[0].intrinsics, DEPTH_SCALE, along_ray=False))
    for number, frame in enumerate(room.frames):
        write_depth_png(sequence / f"frame-{number:06d}.depth.png", frame.depth, DEPTH_SCALE)
        if frame.pose is not None:
            write_pose(sequence / f"frame-{number:06d}.pose.txt", frame.pose)


def _write_site(
    out: Path, seed: int, views: int, index: int, *, along_path: bool, perfect: bool
) -> None:
    from sceneprint.synth import synthesise_survey

    survey = synthesise_survey(seed, index, views, along_path=along_path, perfect=perfect)
    folder = out / survey.name
    folder.mkdir(parents=True)
    for number, cloud in enumerate(survey.clouds):
        (folder / f"scan-{number:06d}.ply").write_bytes(write_ply(cloud.points))
        if cloud.pose is not None:
            write_pose(folder / f"scan-{number:06d}.pose.txt", cloud.pose)
