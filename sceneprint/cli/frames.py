"""`sceneprint frames`: what a map holds, and frames out of it as files."""

from __future__ import annotations

import argparse
import itertools
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic_core import from_json

from sceneprint.cli.connection import add_service_options, one_line, open_client
from sceneprint.cli.numbers import positive
from sceneprint.errors import InvalidRequest
from sceneprint.schemas.outputs import CLOUD_FRAMES, VIEWS, WIDTH
from sceneprint.schemas.states import FrameState
from sceneprint.writing import write_whole

if TYPE_CHECKING:
    from collections.abc import Iterable

    from sceneprint.client import Client
    from sceneprint.schemas import Frame
    from sceneprint.schemas.browsing import Session

#: Options that take a file for something of one frame.
_FILES = ("cloud", "preview", "patches", "signature", "upload")


def add_to(commands: Any) -> None:
    """Describe the command to the parser."""
    command = commands.add_parser(
        "frames",
        help="list the frames and sessions of a map, write them to files, edit their metadata",
        description="List the frames of a map, in the order they came; or its sessions, or the "
        "trajectory of one. With FRAME: tell of that one, write what it is made of, or edit it.",
    )
    command.add_argument("map", metavar="MAP")
    command.add_argument("frame_id", nargs="?", metavar="FRAME", help="id of one frame")
    _add_listing(command.add_argument_group("which frames, sessions or poses"))
    _add_files(command.add_argument_group("of one frame"))
    command.add_argument("--json", action="store_true", help="print JSON")
    add_service_options(command)
    command.set_defaults(run=run)


def _add_listing(group: Any) -> None:
    group.add_argument("--robot", action="append", metavar="NAME", help="several: any of them")
    group.add_argument("--session", action="append", metavar="NAME", help="several: any of them")
    group.add_argument("--tag", action="append", metavar="TAG", help="several: all of them")
    group.add_argument("--state", choices=[str(state) for state in FrameState])
    group.add_argument("--parent-frame", metavar="NAME", help="where their poses lead")
    group.add_argument(
        "--after", type=_time, metavar="TIME", help="taken then or later: 2026-11-16T09:30:00Z"
    )
    group.add_argument("--before", type=_time, metavar="TIME", help="taken then or earlier")
    group.add_argument("--newest", action="store_true", help="the newest first")
    group.add_argument("--limit", type=positive, metavar="N", help="so many at most")
    group.add_argument("--sessions", action="store_true", help="list sessions instead")
    group.add_argument(
        "--trajectory", type=Path, metavar="FILE", help="write the poses of one --session as TUM"
    )


def _add_files(group: Any) -> None:
    group.add_argument("--cloud", type=Path, metavar="FILE", help="write its surface as PLY")
    group.add_argument(
        "--within", choices=CLOUD_FRAMES, default="optical",
        help="coordinates of the cloud: of the sensor, the parent frame of its pose, or the "
        "robot's base (default: optical)",
    )  # fmt: skip
    group.add_argument("--preview", type=Path, metavar="FILE", help="write a picture as PNG")
    group.add_argument(
        "--view", choices=VIEWS, default="depth", help="of the picture (default: depth)"
    )
    group.add_argument("--width", type=positive, default=WIDTH, metavar="PIXELS")
    group.add_argument("--patches", type=Path, metavar="FILE", help="write its patches as JSON")
    group.add_argument("--signature", type=Path, metavar="FILE", help="write its signature as JSON")
    group.add_argument("--upload", type=Path, metavar="FILE", help="write its upload as it came")
    group.add_argument(
        "--edit", type=_changes, metavar="JSON",
        help='change its metadata: \'{"tags": ["door"], "robot": null}\'',
    )  # fmt: skip


def run(options: argparse.Namespace) -> int:
    """List, write or edit."""
    of_one = [name for name in (*_FILES, "edit") if getattr(options, name) is not None]
    if options.frame_id is None and of_one:
        raise InvalidRequest(f"--{of_one[0]} is of one frame. Give its id after the map.")
    if options.trajectory is not None and len(options.session or ()) != 1:
        raise InvalidRequest("--trajectory is of one session. Give it with --session.")
    with open_client(options) as client:
        if options.frame_id is not None:
            _one(client, options)
        elif options.trajectory is not None:
            _trajectory(client, options)
        elif options.sessions:
            _sessions(client.sessions(options.map), as_json=options.json)
        else:
            found = client.frames(
                options.map, None if options.state is None else FrameState(options.state),
                robot=options.robot or (), session=options.session or (), tags=options.tag or (),
                parent_frame=options.parent_frame, captured_after=options.after,
                captured_before=options.before, order="desc" if options.newest else "asc",
            )  # fmt: skip
            _list(itertools.islice(found, options.limit), as_json=options.json)
    return 0


def _one(client: Client, options: argparse.Namespace) -> None:
    of = options.map, options.frame_id
    frame = client.frame(*of) if options.edit is None else client.edit_frame(*of, options.edit)
    makers = {
        "cloud": lambda: client.cloud(*of, options.within),
        "preview": lambda: client.preview(*of, options.view, options.width),
        "patches": lambda: client.patches(*of).model_dump_json().encode(),
        "signature": lambda: client.signature(*of).model_dump_json().encode(),
        "upload": lambda: client.upload_of(*of),
    }
    written = []
    for name in _FILES:
        path = getattr(options, name)
        if path is not None:
            write_whole(path, makers[name]())
            written.append(path)
    if options.json or not written:
        print(frame.model_dump_json(indent=None if options.json else 2))
    else:
        print("\n".join(f"wrote {path}" for path in written))


def _trajectory(client: Client, options: argparse.Namespace) -> None:
    if len(options.robot or ()) > 1:
        raise InvalidRequest("--trajectory is of one robot. Give --robot once.")
    text = client.trajectory_text(
        options.map, options.session[0], robot=(options.robot or [None])[0],
        parent_frame=options.parent_frame, captured_after=options.after,
        captured_before=options.before,
    )  # fmt: skip
    write_whole(options.trajectory, text.encode())
    poses = sum(not line.startswith("#") for line in text.splitlines())
    print(f"wrote {options.trajectory}: {poses} poses")


def _list(frames: Iterable[Frame], *, as_json: bool) -> None:
    any_yet = False
    for one in frames:
        if as_json:
            print(one.model_dump_json())
            continue
        if not any_yet:
            print(f"{'frame':32}  state      captured             pose  robot/session  tags")
            any_yet = True
        at = "" if one.captured_at is None else f"{one.captured_at:%Y-%m-%d %H:%M:%S}"
        who = one_line(f"{one.robot or '-'}/{one.session or '-'}")
        pose = "no" if one.pose is None else "yes"
        tags = one_line(",".join(one.tags))
        print(f"{one.frame_id:32}  {one.state:9}  {at:19}  {pose:4}  {who}  {tags}".rstrip())
    if not any_yet and not as_json:
        print("no such frames")


def _sessions(sessions: Iterable[Session], *, as_json: bool) -> None:
    any_yet = False
    for one in sessions:
        if as_json:
            print(one.model_dump_json())
            continue
        if not any_yet:
            print("frames  indexed  poses  first captured       last captured        robot/session")
            any_yet = True
        first, last = (
            "" if at is None else f"{at:%Y-%m-%d %H:%M:%S}"
            for at in (one.first_captured_at, one.last_captured_at)
        )
        who = one_line(f"{one.robot or '-'}/{one.session or '-'}")
        n = sum(one.frames.values())
        print(
            f"{n:6}  {one.frames.get('indexed', 0):7}  {one.with_pose:5}  {first:19}  {last:19}  "
            f"{who}"
        )
    if not any_yet and not as_json:
        print("no sessions yet")


def _time(text: str) -> datetime:
    try:
        when = datetime.fromisoformat(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(
            f"{text!r} is no time like 2026-11-16T09:30:00Z"
        ) from error
    if when.tzinfo is None:
        raise argparse.ArgumentTypeError(f"{text!r} has no time zone: end it with Z or +01:00")
    return when


def _changes(text: str) -> dict[str, Any]:
    try:
        given = from_json(text, allow_inf_nan=False)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"not JSON ({error})") from error
    if not isinstance(given, dict):
        raise argparse.ArgumentTypeError("no JSON object")
    return given
