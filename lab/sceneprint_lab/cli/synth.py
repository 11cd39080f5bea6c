"""The command `sceneprint synth`: synthetic rooms or laser-scanned sites as a data set."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING

from tqdm import tqdm

from sceneprint.cli import positive, whole_number
from sceneprint.errors import DatasetError
from sceneprint.formats.dataset import Camera, write_depth_png, write_intrinsics, write_pose
from sceneprint.formats.export import write_ply
from sceneprint.types import AnyFrame, Cloud

if TYPE_CHECKING:
    from sceneprint_lab.synth import LookalikeSite

#: Stored units per metre.
DEPTH_SCALE = 1000.0
#: Kinds of look-alike sites for each sensor.
LOOKALIKES = {
    "kinect": ("object", "offices", "unmapped", "kitchens", "opposite", "absent"),
    "lidar": ("bays", "streets", "halls", "unmapped", "absent", "sites"),
}


def add_synth(command: argparse.ArgumentParser) -> None:
    """Add the options of `sceneprint synth`."""
    command.add_argument("out", type=Path, metavar="OUT", help="output folder, new or empty")
    command.add_argument(
        "--sensor", choices=("kinect", "lidar"), default="kinect", help="default: kinect"
    )
    command.add_argument(
        "--lookalikes",
        choices=sorted({kind for kinds in LOOKALIKES.values() for kind in kinds}),
        metavar="KIND",
        help="object: a circle around a symmetric object on a bare floor; offices: a row of equal "
        "rooms, or a hall of equal bays; unmapped: such a row, with queries from an unmapped "
        "room; kitchens: queries from another kitchen with the same furniture; opposite: "
        "furniture in a room, with queries from its other side; absent: queries from other rooms. "
        "With --sensor lidar: bays: a hall of equal bays; streets: a street of equal blocks; "
        "halls: a hall with a symmetry of half a turn; unmapped: equal halls or streets, with "
        "queries from an unmapped hall or street; absent: queries from other halls and streets; "
        "sites: ordinary halls, storeys and blocks without repetition",
    )
    command.add_argument(
        "--rooms", type=positive, default=4, metavar="N",
        help="number of rooms or sites (default: 4)",
    )  # fmt: skip
    command.add_argument(
        "--views", type=positive, default=25, metavar="M",
        help="number of views per room or, with --lookalikes, of queries per site (default: 25)",
    )  # fmt: skip
    command.add_argument("--seed", type=whole_number, default=0, metavar="S", help="default: 0")
    command.add_argument(
        "--path",
        action="store_true",
        help="place views along a hand-held path, a few centimetres apart, instead of at "
        "random; with --sensor lidar along a walk, 1.5 m apart",
    )
    command.add_argument("--perfect", action="store_true", help="omit sensor noise")
    command.add_argument(
        "--jobs", type=positive, default=os.cpu_count() or 1, metavar="N", help="processes"
    )
    command.set_defaults(run=run_synth)


def run_synth(options: argparse.Namespace) -> int:
    """Render Kinect frames of furnished rooms in 7-Scenes layout:
    OUT/room-000/seq-01/frame-000000.depth.png and .pose.txt. With --sensor lidar: laser scans of
    halls, storeys and blocks, OUT/site-000/scan-000000.ply and .pose.txt. With --lookalikes:
    ambiguous sites as scenes whose TrainSplit.txt and TestSplit.txt separate map and queries, so
    that `sceneprint evaluate OUT` measures wrong answers.
    """
    if options.lookalikes and options.path:
        raise DatasetError(
            "--lookalikes and --path: look-alike sites have their own paths. Omit --path."
        )
    kinds = LOOKALIKES[options.sensor]
    if options.lookalikes and options.lookalikes not in kinds:
        raise DatasetError(
            f"--lookalikes {options.lookalikes}: There is no such kind for --sensor "
            f"{options.sensor}. Choose from {', '.join(kinds)}."
        )
    if options.out.exists() and any(options.out.iterdir()):
        raise DatasetError(
            f"{options.out}: The folder is not empty, and frames of two runs must not be mixed. "
            "Use a new folder, or empty this one."
        )
    options.out.mkdir(parents=True, exist_ok=True)
    with tqdm(total=options.rooms, desc="synth", unit="room", disable=None) as bar:
        for _ in _rooms(options):
            bar.update()
    scenes = "sites" if options.lookalikes or options.sensor == "lidar" else "rooms"
    views = "queries" if options.lookalikes else "views"
    print(f"{options.rooms} {scenes} of {options.views} {views} in {options.out}")
    return 0


def _rooms(options: argparse.Namespace) -> Iterator[None]:
    """Write all rooms or sites; yield after each."""
    common = options.out, options.seed, options.views, options.sensor == "lidar", options.perfect
    write: Callable[[int], None] = partial(_write_room, *common, options.path)
    if options.lookalikes:
        write = partial(_write_lookalike, *common, options.lookalikes)
    jobs = min(options.jobs, options.rooms)
    if jobs == 1:  # a child process would import all modules again
        yield from map(write, range(options.rooms))
        return
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        yield from pool.map(write, range(options.rooms))


def _write_room(
    out: Path, seed: int, views: int, lidar: bool, perfect: bool, along_path: bool, index: int
) -> None:
    """Write the frames of room `index`, or the scans of site `index`, to a folder of `out`."""
    from sceneprint_lab.synth import KinectNoise, synthesise_room, synthesise_survey

    if lidar:
        survey = synthesise_survey(seed, index, views, along_path=along_path, perfect=perfect)
        _write_sequence(out / survey.name, survey.clouds)
        return
    noise = None if perfect else KinectNoise()
    room = synthesise_room(seed, index, views, along_path=along_path, noise=noise)
    _write_sequence(out / room.name / "seq-01", room.frames)


def _write_lookalike(
    out: Path, seed: int, queries: int, lidar: bool, perfect: bool, kind: str, index: int
) -> None:
    """Write the map and the queries of a site, as two scenes if their poses are not comparable."""
    from sceneprint_lab.synth import KinectNoise, synthesise_lookalike, synthesise_lookalike_survey

    noise = None if perfect else KinectNoise()
    site: LookalikeSite[AnyFrame] = (
        synthesise_lookalike_survey(kind, seed, index, queries=queries, perfect=perfect)
        if lidar
        else synthesise_lookalike(kind, seed, index, queries=queries, noise=noise)
    )
    of_map = out / site.name
    of_queries = of_map if site.same_frame else out / f"{site.name}-elsewhere"
    _write_sequence(of_map / "seq-01", site.map)
    _write_sequence(of_queries / "seq-02", site.queries)
    (of_map / "TrainSplit.txt").write_text("sequence1\n")
    (of_queries / "TestSplit.txt").write_text("sequence2\n")


def _write_sequence(folder: Path, frames: Sequence[AnyFrame]) -> None:
    """Write scans, or depth images and their camera, to a new folder, together with their poses."""
    folder.mkdir(parents=True)
    for number, frame in enumerate(frames):
        if isinstance(frame, Cloud):
            name = f"scan-{number:06d}"
            (folder / f"{name}.ply").write_bytes(write_ply(frame.points))
        else:
            name = f"frame-{number:06d}"
            write_depth_png(folder / f"{name}.depth.png", frame.depth, DEPTH_SCALE)
            if number == 0:
                camera = Camera(frame.intrinsics, DEPTH_SCALE, along_ray=False)
                write_intrinsics(folder.parent, camera)
        if frame.pose is not None:
            write_pose(folder / f"{name}.pose.txt", frame.pose)
