"""`sceneprint demo`: the main job of this version, start to end, on frames it makes itself."""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from sceneprint.cli.signer import add_model_options, open_for
from sceneprint.datasets import find_sequences
from sceneprint.errors import DatasetError, FrameError
from sceneprint.geometry.retrieval import distances
from sceneprint.pipeline import Signer, sign
from sceneprint.settings import Settings
from sceneprint.types import Frame

#: Of a data set, no more frames than this are taken, evenly spread.
MAXIMUM_FRAMES = 48


def add_to(commands: Any) -> None:
    """Describe the command to the parser."""
    command = commands.add_parser(
        "demo",
        help="sign frames, find each one's nearest, draw three of them",
        description="Sign the frames of a small synthetic building (or of --dataset), tell for "
        "each which other frame is nearest, and draw three of them.",
    )
    command.add_argument("--out", type=Path, default=Path("demo"), metavar="DIR")
    command.add_argument(
        "--dataset", type=Path, metavar="PATH", help="frames of your own, as for `sign`"
    )
    command.add_argument("--rooms", type=int, default=5, help=argparse.SUPPRESS)
    add_model_options(command)
    command.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Show what signatures can do."""
    from sceneprint.pictures import save_picture

    options.out.mkdir(parents=True, exist_ok=True)
    frames = _given(options.dataset) if options.dataset else _synthetic(options.rooms)
    if len(frames) < 2:
        raise DatasetError(f"{options.dataset}: the demo compares frames; give two or more.")
    signer = open_for(options, Settings())
    stored, seconds = _sign_all(frames, signer)
    _print_nearest(frames, stored, signer)
    for number in sorted({0, len(frames) // 2, len(frames) - 1}):
        path = options.out / f"frame-{number:02d}.png"
        save_picture(frames[number][1], signer.model, path)
        print(f"picture: {path}")
    print(
        f"{len(frames)} frames signed in {seconds:.1f} s "
        f"({1e3 * seconds / len(frames):.0f} ms each, {signer.model.signature_bytes} bytes each) "
        f"with model {signer.model.label}"
    )
    print("next: sceneprint sign PATH, with an intrinsics.json beside your frames (README.md)")
    return 0


def _synthetic(rooms: int) -> list[tuple[str, Frame]]:
    """Six views of each room, some twenty centimetres and degrees apart on a hand-held path."""
    from sceneprint.synth import KINECT, take, trajectory
    from sceneprint.synth.synthesis import room_and_rng

    frames = []
    for number in tqdm(range(rooms), desc="synthetic building", unit="room", disable=None):
        room, rng = room_and_rng(11, number)
        for i, pose in enumerate(trajectory(room, 61, rng)[::12]):
            depth = take(room, pose, KINECT, rng)
            name = f"room-{number}/view-{i}"
            frames.append((f"room {number}", Frame(depth, KINECT, name, pose)))
    return frames


def _given(path: Path) -> list[tuple[str, Frame]]:
    found = [(s.parent_frame, r) for s in find_sequences(path) for r in s.frames]
    step = max(-(-len(found) // MAXIMUM_FRAMES), 1)
    frames = []
    for place, reference in found[::step]:
        try:
            frames.append((place, reference.read()))
        except FrameError as error:
            print(f"left out: {error}")
    return frames


def _sign_all(
    frames: list[tuple[str, Frame]], signer: Signer
) -> tuple[np.ndarray[Any, np.dtype[np.uint8]], float]:
    start = time.perf_counter()
    bar = tqdm(frames, desc="sign", unit="frame", disable=None)
    stored = np.stack([sign(frame, signer).vector for _, frame in bar])
    return stored, time.perf_counter() - start


def _print_nearest(
    frames: list[tuple[str, Frame]], stored: np.ndarray[Any, np.dtype[np.uint8]], signer: Signer
) -> None:
    d0 = signer.model.unrelated_distance
    table = np.stack([distances(one, stored) for one in stored]).astype(float)
    np.fill_diagonal(table, np.inf)
    nearest = table.argmin(axis=1)
    width = max(len(frame.name) for _, frame in frames)
    print(f"{'frame':{width}}  {'nearest other frame':{width}}  similarity  same place")
    hits = 0
    for i, (place, frame) in enumerate(frames):
        j = int(nearest[i])
        same = frames[j][0] == place
        hits += same
        similarity = float(np.clip(1.0 - table[i, j] / d0, 0.0, 1.0))
        print(
            f"{frame.name:{width}}  {frames[j][1].name:{width}}  {similarity:10.2f}  "
            f"{'yes' if same else 'no'}"
        )
    print(f"the nearest frame is of the same place for {hits} of {len(frames)} frames")
