"""`sceneprint upload`: frames of a data set into a map of a service."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tqdm import tqdm

from sceneprint.cli.archive import import_all, is_archive_file
from sceneprint.cli.awaiting import STALL_S, wait_for_all
from sceneprint.cli.connection import add_service_options, open_client
from sceneprint.cli.numbers import positive
from sceneprint.cli.saying import base_of, priority_of, share_of
from sceneprint.cli.tally import Tally
from sceneprint.datasets import FrameReference, Sequence, find_sequences
from sceneprint.errors import (
    DatasetError,
    FrameConflict,
    FrameError,
    InvalidRequest,
    MapExists,
    MissingDependency,
    Refused,
    UnknownMap,
)
from sceneprint.models import PRESETS
from sceneprint.schemas.novelty import NOVEL

if TYPE_CHECKING:
    from sceneprint.client import Client
    from sceneprint.schemas import Added

#: What is wrong with one frame, and says nothing of the next.
_OF_FRAME = (
    FrameError, DatasetError, FrameConflict, InvalidRequest, MissingDependency, Refused,
)  # fmt: skip


def add_to(commands: Any) -> None:
    """Describe the command to the parser."""
    command = commands.add_parser(
        "upload",
        help="upload depth frames and point clouds to a map of a service",
        description="Upload every frame of the given files and folders (7-Scenes, TUM RGB-D or "
        "plain depth images, with an intrinsics.json beside them or above; or point clouds), and "
        "wait until they are signed. A zip or tar of them is sent whole, and unpacked by the "
        "service. A frame that is in the map already is not stored twice.",
    )
    command.add_argument("map", metavar="MAP", help="made where missing")
    command.add_argument("paths", nargs="+", type=Path, metavar="PATH")
    command.add_argument(
        "--robot", metavar="NAME", help="who took the frames, and whose the poses' frame is"
    )
    command.add_argument(
        "--session", metavar="NAME", help="in which run (default: the sequence's name)"
    )
    command.add_argument(
        "--tag", action="append", default=[], metavar="TAG", help="may be given several times"
    )
    command.add_argument(
        "--parent-frame",
        metavar="NAME",
        help="what all poses lead to: poses of several uploads are combined where they share it "
        "(default: the name of the scene's folder, with --robot ROBOT/SCENE)",
    )
    command.add_argument("--no-pose", action="store_true", help="leave known poses out")
    command.add_argument(
        "--base",
        type=base_of,
        metavar="TX,TY,TZ,QX,QY,QZ,QW",
        help="where the sensor sits on the robot: metres and a unit quaternion, sensor to base",
    )
    command.add_argument(
        "--base-frame", metavar="NAME", help="what the robot calls its base (default: base_link)"
    )
    command.add_argument(
        "--create",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="make the map where it is missing (default)",
    )
    command.add_argument(
        "--model", choices=PRESETS, help=f"of a map that is made (default: {PRESETS[0]})"
    )
    command.add_argument(
        "--every", type=positive, default=1, metavar="N", help="take every Nth frame"
    )
    command.add_argument(
        "--priority",
        type=priority_of,
        default=0,
        metavar="N",
        help="from -10 to 10: frames of a greater one are signed first (default: 0)",
    )
    command.add_argument(
        "--if-novel",
        nargs="?",
        type=share_of,
        const=True,
        metavar="D",
        help="keep a frame only if the map lacks its place: if the nearest frame is farther than D "
        f"of the distance of unrelated frames (without a number: {NOVEL:g})",
    )
    command.add_argument("--no-wait", action="store_true", help="do not wait until all are signed")
    command.add_argument(
        "--parallel", type=positive, default=4, metavar="N", help="in flight at once (default: 4)"
    )
    add_service_options(command)
    command.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Upload; returns 2 where a frame was not indexed."""
    archives = [path for path in options.paths if is_archive_file(path)]
    paths = [path for path in options.paths if path not in archives]
    found = list(_found(paths, options.every, one_frame=options.parent_frame is not None))
    if options.base is not None and options.base_frame is not None:
        options.base = options.base.model_copy(update={"base_frame": options.base_frame})
    tally, start, stalled = Tally(), time.perf_counter(), False
    with open_client(options) as client:
        _see_to_map(client, options)
        try:
            _send_all(client, options, found, tally)
            stalled = not import_all(client, options, archives, tally)
            if not options.no_wait and not stalled:
                novel = options.if_novel is not None
                stalled = not wait_for_all(client, options.map, tally, may_be_redundant=novel)
        finally:  # what was received stays, however the run ended
            counted = tally.new + tally.there + tally.refused
            tally.report(max(len(found), counted), time.perf_counter() - start)
            if stalled:
                print(
                    f"{len(tally.waiting)} frames are safe and wait, but none was signed for "
                    f"{STALL_S:.0f} s. See that workers run: `sceneprint work` starts some.",
                    file=sys.stderr,
                )
    return 2 if tally.errors or stalled else 0


def _found(
    paths: list[Path], every: int, *, one_frame: bool
) -> Iterator[tuple[Sequence, FrameReference]]:
    """Frames with their sequences.

    Parameters
    ----------
    paths, every : as given
    one_frame : whether all poses lead to one frame, as the user says

    Raises
    ------
    DatasetError : nothing is found at a path, or two places share the name of their poses' frame.
    """
    places: dict[str, Path] = {}
    for path in paths:
        for sequence in find_sequences(path):
            shared = sequence.parent_frame != sequence.name
            place = (sequence.folder.parent if shared else sequence.folder).resolve()
            if places.setdefault(sequence.parent_frame, place) != place and not one_frame:
                raise DatasetError(
                    f"{path}: Another place is called {sequence.parent_frame} too, "
                    f"{places[sequence.parent_frame]}, and poses of the two would be mixed. "
                    "Upload a folder above both, rename one, or where poses of both lead to one "
                    "frame, name it with --parent-frame."
                )
            for reference in sequence.frames[::every]:
                yield sequence, reference


def _see_to_map(client: Client, options: argparse.Namespace) -> None:
    try:
        model = client.map(options.map).model
    except UnknownMap:
        if not options.create:
            raise
        made = client.create_map(options.map, model=options.model or PRESETS[0])
        print(f"map {made.name} is made, with model {made.model}")
        return
    if options.model is not None and model.rpartition("-")[0] != options.model:
        raise MapExists(
            f"Map {options.map} is there, with model {model}. Leave --model out, or name another."
        )


def _send_all(
    client: Client,
    options: argparse.Namespace,
    found: list[tuple[Sequence, FrameReference]],
    tally: Tally,
) -> None:
    """Upload all, several at a time; what is wrong with the service ends it."""
    pool = ThreadPoolExecutor(options.parallel, thread_name_prefix="upload")
    sent = {pool.submit(_send, client, options, *one): one[1].name for one in found}
    try:
        with tqdm(total=len(sent), desc="upload", unit="frame", disable=None) as bar:
            for future in as_completed(tuple(sent)):
                name = sent.pop(future)
                try:
                    tally.count(name, *future.result())
                except _OF_FRAME as error:
                    tally.refuse(name, str(error))
                bar.update()
    finally:  # also where Ctrl-C ends it: what is in flight arrives, nothing follows it
        pool.shutdown(cancel_futures=True)
        for future, name in sent.items():
            if not future.cancelled() and future.exception() is None:
                tally.count(name, *future.result())


def _send(
    client: Client, options: argparse.Namespace, sequence: Sequence, reference: FrameReference
) -> tuple[Added, bool]:
    from sceneprint.datasets.metas import meta_of, parent_frame_of, session_of

    meta = meta_of(
        reference,
        robot=options.robot,
        session=options.session or session_of(sequence),
        tags=options.tag,
        with_pose=not options.no_pose,
        base=options.base,
        parent_frame=options.parent_frame or parent_frame_of(sequence, options.robot),
    )
    return client.add(
        options.map, reference, meta, priority=options.priority, if_novel=options.if_novel
    )
