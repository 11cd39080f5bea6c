"""`sceneprint demo`: the main job of this version, start to end, on frames it makes itself."""

from __future__ import annotations

import argparse
import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from sceneprint.cli.signer import add_model_options, open_for
from sceneprint.datasets import find_sequences
from sceneprint.errors import DatasetError, FrameError
from sceneprint.geometry.rigid import difference
from sceneprint.matches import Match, associate, locate
from sceneprint.pipeline import Signature, Signer, diversify, prepare, retrieve
from sceneprint.settings import Settings
from sceneprint.types import Frame, Geometry


@dataclass(frozen=True, eq=False)
class Known:
    """A frame of the demo with all that is made of it."""

    place: str  #: frames of one place share a parent frame
    frame: Frame
    signature: Signature
    geometry: Geometry


#: Of a data set, no more frames than this are taken, evenly spread.
MAXIMUM_FRAMES = 48


def add_to(commands: Any) -> None:
    """Describe the command to the parser."""
    command = commands.add_parser(
        "demo",
        help="sign frames, find each one among the others with its pose, draw three of them",
        description="Sign the frames of a small synthetic building (or of --dataset), find each "
        "among the others, validated and with a pose, and draw three of them.",
    )
    command.add_argument("--out", type=Path, default=Path("demo"), metavar="DIR")
    command.add_argument(
        "--dataset", type=Path, metavar="PATH", help="frames of your own, as for `sign`"
    )
    command.add_argument("--rooms", type=int, default=5, help=argparse.SUPPRESS)
    add_model_options(command)
    command.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Show retrieval, diversification, validation and the pose."""
    from sceneprint.pictures import save_picture

    options.out.mkdir(parents=True, exist_ok=True)
    frames = _given(options.dataset) if options.dataset else _synthetic(options.rooms)
    if len(frames) < 2:
        raise DatasetError(f"{options.dataset}: the demo compares frames; give two or more.")
    signer = open_for(options, Settings())
    start = time.perf_counter()
    known = _prepare_all(frames, signer)
    seconds = time.perf_counter() - start
    last = _ask_all(known, signer)
    for number in sorted({0, len(frames) // 2, len(frames) - 1}):
        path = options.out / f"frame-{number:02d}.png"
        save_picture(frames[number][1], signer.model, path)
        print(f"picture: {path}")
    for line in last:
        print(line)
    print(
        f"{len(frames)} frames signed in {seconds:.1f} s "
        f"({1e3 * seconds / len(frames):.0f} ms each, {signer.model.signature_bytes} bytes each) "
        f"with model {signer.model.label}"
    )
    print(
        "next: sceneprint sign PATH, or sceneprint evaluate PATH, on frames of your own (README.md)"
    )
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


def _prepare_all(frames: list[tuple[str, Frame]], signer: Signer) -> list[Known]:
    bar = tqdm(frames, desc="sign", unit="frame", disable=None)
    return [Known(place, frame, *prepare(frame, signer)) for place, frame in bar]


def _ask_all(known: list[Known], signer: Signer) -> list[str]:
    """Ask for each frame among all others, and print what came back; returns the last lines."""
    width = max(len(one.frame.name) for one in known)
    print(
        f"{'query':{width}}  {'nearest frame':{width}}  similarity  "
        f"{'validated match':{width}}  strength  pose off by"
    )
    nearest, found, right, milliseconds = 0, 0, 0, []
    for i, query in enumerate(tqdm(known, desc="ask", unit="query", disable=None)):
        database = known[:i] + known[i + 1 :]
        start = time.perf_counter()
        signatures = [one.signature for one in database]
        ranking = retrieve(query.signature, signatures, signer.model)
        selection = diversify(ranking, signatures)
        matches = associate(
            query.geometry,
            ranking,
            selection.indices.tolist(),
            [one.geometry for one in database].__getitem__,
            k=3,
        )
        milliseconds.append(1e3 * (time.perf_counter() - start))
        first = database[int(ranking.indices[0])]
        nearest += first.place == query.place
        line = f"{query.frame.name:{width}}  {first.frame.name:{width}}  "
        line += f"{ranking.similarities[0]:10.2f}  "
        accepted = [match for match in matches if match.validation.status == "accepted"]
        if accepted:
            best = database[accepted[0].index]
            found += 1
            right += best.place == query.place
            line += f"{best.frame.name:{width}}  {accepted[0].validation.strength:8}  "
            line += _pose_error(query, matches, database)
        else:
            line += f"{'not found':{width}}"
        tqdm.write(line.rstrip())
    return [
        f"the nearest frame is of the same place for {nearest} of {len(known)} queries; a match "
        f"was validated for {found}, and {right} of these are of the same place",
        f"{np.median(milliseconds):.0f} ms a query among {len(known) - 1} frames, validation "
        "included (median)",
    ]


def _pose_error(query: Known, matches: list[Match], database: list[Known]) -> str:
    """How far the pose averaged over the matches is from the known one, where it is known."""
    if query.frame.pose is None or any(one.frame.pose is None for one in database):
        return ""
    poses = [one.frame.pose for one in database if one.frame.pose is not None]
    location = locate(matches, poses, [one.place for one in database])
    if location is None or location.parent != query.place:
        return "another place"
    metres, radians = difference(location.average.T, query.frame.pose)
    return f"{100 * metres:.1f} cm, {math.degrees(radians):.1f} deg"
