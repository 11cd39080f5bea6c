"""`sceneprint frames`: what a map holds, and frames out of it as files."""

from __future__ import annotations

import argparse
import itertools
import sys
from datetime import datetime
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

from pydantic_core import from_json

from sceneprint.atomic_files import write_whole
from sceneprint.cli import positive
from sceneprint.cli.options import (
    add_service_options,
    one_line,
    open_client,
    percent,
    up_of,
)
from sceneprint.cli.scenes import Scene, add_scene_options, check_scene, open_scene
from sceneprint.errors import InvalidRequest
from sceneprint_client.api.base import FrameState, JobState
from sceneprint_client.api.listing import Clock
from sceneprint_client.api.maps import PRESETS
from sceneprint_client.api.results import CLOUD_FRAMES, RECORD_STATUSES, VIEWS, WIDTH

if TYPE_CHECKING:
    from collections.abc import Iterable

    from sceneprint_client import Client
    from sceneprint_client.api import Frame, Job, Map
    from sceneprint_client.api.results import QueryRecord

#: Options that take a file for something of one frame.
_FILES = ("cloud", "preview", "patches", "signature", "upload")


def add_frames(command: argparse.ArgumentParser) -> None:
    """Add the options of `sceneprint frames`."""
    command.add_argument("map", metavar="MAP")
    command.add_argument("frame_id", nargs="?", metavar="FRAME", help="id of one frame")
    _add_listing(command.add_argument_group("select frames or poses"))
    _add_files(command.add_argument_group("actions on one frame"))
    add_scene_options(command)
    command.add_argument("--json", action="store_true", help="print JSON")
    add_service_options(command)
    command.set_defaults(run=run_frames)


def _add_listing(group: Any) -> None:
    group.add_argument("--robot", action="append", metavar="NAME", help="repeatable: matches any")
    group.add_argument("--session", action="append", metavar="NAME", help="repeatable: matches any")
    group.add_argument("--tag", action="append", metavar="TAG", help="repeatable: matches all")
    group.add_argument(
        "--name", metavar="PREFIX", help="original file name starts with this; case matters"
    )
    group.add_argument("--find", metavar="PREFIX", help="id, file name or session starts with this")
    group.add_argument("--state", choices=[str(state) for state in FrameState])
    group.add_argument("--parent-frame", metavar="NAME", help="parent frame of the poses")
    group.add_argument(
        "--after",
        type=_time,
        metavar="TIME",
        help="captured at or after this time: 2026-11-16T09:30:00Z",
    )
    group.add_argument(
        "--before", type=_time, metavar="TIME", help="captured at or before this time"
    )
    group.add_argument("--newest", action="store_true", help="newest first")
    group.add_argument("--limit", type=positive, metavar="N", help="maximum number to list")
    group.add_argument(
        "--trajectory",
        type=Path,
        metavar="FILE",
        help="write the poses of one --session as a TUM trajectory",
    )
    group.add_argument(
        "--clock",
        choices=get_args(Clock),
        default="taken",
        help="stamps of the trajectory: taken is captured_at, or sequence if no frame has a "
        "captured_at (default: taken)",
    )


def _add_files(group: Any) -> None:
    group.add_argument("--cloud", type=Path, metavar="FILE", help="write its point cloud as PLY")
    group.add_argument(
        "--within", choices=CLOUD_FRAMES, default="optical",
        help="coordinate frame of the cloud: the sensor, the parent frame of its pose, or the "
        "robot's base (default: optical)",
    )  # fmt: skip
    group.add_argument("--preview", type=Path, metavar="FILE", help="write a preview as PNG")
    group.add_argument(
        "--view", choices=VIEWS, default="depth", help="view of the preview (default: depth)"
    )
    group.add_argument("--width", type=positive, default=WIDTH, metavar="PIXELS")
    group.add_argument("--patches", type=Path, metavar="FILE", help="write its patches as JSON")
    group.add_argument("--signature", type=Path, metavar="FILE", help="write its signature as JSON")
    group.add_argument(
        "--upload", type=Path, metavar="FILE", help="write the uploaded file unchanged"
    )
    group.add_argument(
        "--edit", type=_changes, metavar="JSON",
        help="edit its metadata: '{\"tags\": [\"door\"], \"robot\": null}'",
    )  # fmt: skip


def run_frames(options: argparse.Namespace) -> int:
    """List the frames of a map in order of upload, those of one session in the order they were
    taken, or write the trajectory of a session. With FRAME: show that frame, download its files,
    or edit its metadata.
    """
    of_one = [name for name in (*_FILES, "edit") if getattr(options, name) is not None]
    if options.frame_id is None and of_one:
        raise InvalidRequest(f"--{of_one[0]} applies to one frame. Give its id after the map.")
    if options.trajectory is not None and len(options.session or ()) != 1:
        raise InvalidRequest("--trajectory needs a session. Name it with --session.")
    if options.trajectory is not None and options.mcap is not None:
        raise InvalidRequest("--trajectory writes no scene. Run the command once for each.")
    check_scene(options)
    with open_client(options) as client, open_scene(options, client) as scene:
        if options.frame_id is not None:
            frame = _one(client, options)
            if scene is not None:
                scene.add_frame(frame)
        elif options.trajectory is not None:
            _trajectory(client, options)
        else:
            found = client.frames(
                options.map, None if options.state is None else FrameState(options.state),
                robot=options.robot or (), session=options.session or (), tags=options.tag or (),
                parent_frame=options.parent_frame, captured_after=options.after,
                captured_before=options.before, name=options.name, find=options.find,
                order=_order(options),
            )  # fmt: skip
            found = itertools.islice(found, options.limit)
            if scene is None:
                _print_frames(found, as_json=options.json)
            else:
                frames = list(found)
                _print_frames(frames, as_json=options.json)
                _show_frames(scene, frames)
    return 0


def _order(options: argparse.Namespace) -> Literal["asc", "desc", "taken"]:
    if options.newest:
        return "desc"
    return "taken" if len(options.session or ()) == 1 else "asc"


def _show_frames(scene: Scene, frames: list[Frame]) -> None:
    """Write the scene of frames that are listed.

    Raises
    ------
    InvalidRequest : none has a pose.
    """
    posed = [one for one in frames if one.pose is not None]
    if not posed:
        raise InvalidRequest(
            "No listed frame has a pose, so a scene has no place for them. Name one FRAME."
        )
    if len(posed) < len(frames):
        print(f"{len(frames) - len(posed)} frames without a pose are not shown", file=sys.stderr)
    scene.add_frames(posed)


def _one(client: Client, options: argparse.Namespace) -> Frame:
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
    return frame


def _trajectory(client: Client, options: argparse.Namespace) -> None:
    if len(options.robot or ()) > 1:
        raise InvalidRequest("--trajectory accepts one robot only. Give --robot once.")
    text = client.trajectory_text(
        options.map, options.session[0], robot=(options.robot or [None])[0],
        parent_frame=options.parent_frame, captured_after=options.after,
        captured_before=options.before, clock=options.clock,
    )  # fmt: skip
    write_whole(options.trajectory, text.encode())
    lines = text.splitlines()
    poses = sum(not line.startswith("#") for line in lines)
    why = [line.removeprefix("# empty") for line in lines if line.startswith("# empty: ")]
    print(f"wrote {options.trajectory}: {poses} poses{one_line(''.join(why[:1]))}")


def _print_frames(frames: Iterable[Frame], *, as_json: bool) -> None:
    any_yet = False
    for one in frames:
        if as_json:
            print(one.model_dump_json())
            continue
        if not any_yet:
            print(
                f"{'frame':32}  state      captured             pose  sequence  "
                "robot/session  name  tags"
            )
            any_yet = True
        at = "" if one.captured_at is None else f"{one.captured_at:%Y-%m-%d %H:%M:%S}"
        who = one_line(f"{one.robot or '-'}/{one.session or '-'}")
        pose = "no" if one.pose is None else "yes"
        tags = one_line(",".join(one.tags))
        place = "" if one.sequence is None else one.sequence
        name = one_line(one.name or "-")
        print(
            f"{one.frame_id:32}  {one.state:9}  {at:19}  {pose:4}  {place:>8}  {who}  {name}  "
            f"{tags}".rstrip()
        )
    if not any_yet and not as_json:
        print("no frames match")


def _time(text: str) -> datetime:
    try:
        when = datetime.fromisoformat(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(
            f"{text!r} is not a time such as 2026-11-16T09:30:00Z"
        ) from error
    if when.tzinfo is None:
        raise argparse.ArgumentTypeError(
            f"{text!r} has no time zone: append Z or an offset such as +01:00"
        )
    return when


def _changes(text: str) -> dict[str, Any]:
    try:
        given = from_json(text, allow_inf_nan=False)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"not JSON ({error})") from error
    if not isinstance(given, dict):
        raise argparse.ArgumentTypeError("not a JSON object")
    return given


# `sceneprint queries`: what robots asked, and what came of it.


def add_queries(command: argparse.ArgumentParser) -> None:
    """Add the options of `sceneprint queries`."""
    command.add_argument("map", nargs="?", metavar="MAP", help="only queries of this map")
    command.add_argument(
        "--status", action="append", default=[], choices=RECORD_STATUSES,
        help="only queries with this outcome; repeatable: matches any",
    )  # fmt: skip
    command.add_argument("--robot", metavar="NAME", help="only queries of this robot")
    command.add_argument(
        "--kept", action="store_true", help="only queries whose answers somebody keeps"
    )
    command.add_argument(
        "--since", type=_time, metavar="TIME",
        help="only queries that came at or after this time: 2026-11-16T09:30:00Z",
    )  # fmt: skip
    command.add_argument(
        "--until", type=_time, metavar="TIME", help="only queries that came before this time"
    )
    command.add_argument(
        "--limit", type=positive, default=20, metavar="N",
        help="maximum number to list (default: 20)",
    )  # fmt: skip
    command.add_argument("--json", action="store_true", help="print JSON, one query per line")
    add_service_options(command)
    command.set_defaults(run=run_queries)


def run_queries(options: argparse.Namespace) -> int:
    """List the latest queries of a map, or of all maps, newest first: when each came, what came
    of it, who asked, where that is, and why it failed.
    """
    with open_client(options) as client:
        found = client.queries(
            options.map, status=options.status, robot=options.robot, since=options.since,
            until=options.until, kept=options.kept,
        )  # fmt: skip
        _print_queries(islice(found, options.limit), as_json=options.json)
    return 0


def _print_queries(queries: Iterable[QueryRecord], *, as_json: bool) -> None:
    any_yet = False
    for one in queries:
        if as_json:
            print(one.model_dump_json())
            continue
        if not any_yet:
            columns = "status          ms  map  robot/session  where or why"
            print(f"{'query':32}  {'came':19}  {columns}")
            any_yet = True
        who = one_line(f"{one.robot or '-'}/{one.session or '-'}")
        came = f"{one.at:%Y-%m-%d %H:%M:%S}  {one.status:11}  {one.milliseconds:5.0f}"
        print(f"{one.query_id}  {came}  {one.map}  {who}  {_where_or_why(one)}")
    if not any_yet and not as_json:
        print("no queries match")


def _where_or_why(one: QueryRecord) -> str:
    if one.pose is None:
        return one_line(one.reason)
    t = one.pose.translation
    place = f"{t.x:.2f} {t.y:.2f} {t.z:.2f} m in {one_line(one.pose.parent_frame)}"
    views = "1 view" if one.support == 1 else f"{one.support} views"
    sure = "" if one.confidence is None else f", {percent(one.confidence)}"
    return f"{place}, {views}{sure}"


# `sceneprint jobs`: the jobs of a service, given up or tried again.


def add_jobs(command: argparse.ArgumentParser) -> None:
    """Add the options of `sceneprint jobs`."""
    choice = command.add_mutually_exclusive_group()
    choice.add_argument("--retry", metavar="ID", help="retry a dead or cancelled job")
    choice.add_argument(
        "--retry-dead",
        action="store_true",
        help="retry all dead jobs that were not retried yet",
    )
    choice.add_argument("--cancel", metavar="ID", help="cancel an unfinished job")
    command.add_argument(
        "--state", choices=[str(state) for state in JobState], help="list only jobs in this state"
    )
    command.add_argument("--json", action="store_true", help="print JSON, tracebacks included")
    add_service_options(command)
    command.set_defaults(run=run_jobs)


def run_jobs(options: argparse.Namespace) -> int:
    """List the jobs of a service, newest first, or retry or cancel some."""
    asked = options.retry is not None or options.retry_dead or options.cancel is not None
    if asked and options.state is not None:
        raise InvalidRequest(
            "--state only filters the list. Leave it out with --retry or --cancel."
        )
    with open_client(options) as client:
        if options.retry is not None:
            _print_job(client.retry_job(options.retry), as_json=options.json)
        elif options.cancel is not None:
            _print_job(client.cancel_job(options.cancel), as_json=options.json)
        elif options.retry_dead:
            return _retry_dead(client, as_json=options.json)
        else:
            state = None if options.state is None else JobState(options.state)
            _print_jobs(client.jobs(state), as_json=options.json)
    return 0


def _retry_dead(client: Client, *, as_json: bool) -> int:
    """Retry the dead; a job that was followed by another of its frame is history, and stays.

    Returns
    -------
    code : 2 where one cannot be tried again
    """
    again, refused = 0, 0
    for done in client.retry_dead_jobs():
        again, refused = again + len(done.retried), refused + len(done.refused)
        for one in done.refused:
            print(f"sceneprint jobs: {one_line(one.reason)}", file=sys.stderr)
        for job in done.retried:
            _print_job(job, as_json=as_json)
    if not as_json:
        print(f"{again} jobs queued again, {refused} cannot be retried")
    return 2 if refused else 0


def _print_job(job: Job, *, as_json: bool) -> None:
    print(job.model_dump_json() if as_json else f"job {job.job_id} of map {job.map}, {job.state}")


def _print_jobs(jobs: Iterable[Job], *, as_json: bool) -> None:
    if as_json:
        for job in jobs:
            print(job.model_dump_json())
        return
    any_yet = False
    for job in jobs:
        if not any_yet:
            print(f"{'job':32}  state      prio  tries  created              map  error")
            any_yet = True
        print(
            f"{job.job_id:32}  {job.state:9}  {job.priority:4}  {job.attempts:5}  "
            f"{job.created_at:%Y-%m-%d %H:%M:%S}  {job.map}  {one_line(job.error or '')}".rstrip()
        )
    if not any_yet:
        print("no jobs match")


# `sceneprint maps`: the maps of a service.

#: What a limit is called that takes one away.
NONE = "none"


def add_maps(command: argparse.ArgumentParser) -> None:
    """Add the options of `sceneprint maps`."""
    choice = command.add_mutually_exclusive_group()
    choice.add_argument(
        "--create", metavar="NAME", help="create a map; its name may contain a-z, 0-9, - and _"
    )
    choice.add_argument("--edit", metavar="NAME", help="edit title, limits or up of a map")
    choice.add_argument("--delete", metavar="NAME", help="delete a map with all its frames")
    command.add_argument("--title", help="human-readable title of the map")
    command.add_argument(
        "--model", choices=PRESETS, help=f"model of the new map (default: {PRESETS[0]})"
    )
    for name, metavar, kind, told in (
        ("--quota-frames", "N", int, "maximum number of frames in the map"),
        ("--quota-bytes", "N", int, "maximum size of its uploads in bytes"),
        ("--retention-days", "DAYS", float, "delete frames this many days after their upload"),
    ):
        command.add_argument(
            name, metavar=metavar, type=_limit(kind), help=f"{told}; `{NONE}` for no limit"
        )
    command.add_argument(
        "--up",
        metavar="X,Y,Z",
        type=_map_up,
        help="up in the parent frames of the poses, 0,0,1 where z points up; "
        f"`{NONE}` to learn it from frames",
    )
    command.add_argument("--yes", action="store_true", help="confirm a deletion")
    command.add_argument("--json", action="store_true", help="print JSON")
    add_service_options(command)
    command.set_defaults(run=run_maps)


def run_maps(options: argparse.Namespace) -> int:
    """List the maps of a service, or create, edit or delete one. Only operators can set quotas:
    that needs a key with `admin` for `*`.
    """
    names = ("title", "quota_frames", "quota_bytes", "retention_days", "up")
    given = {n: getattr(options, n) for n in names if getattr(options, n) is not None}
    limits = {n: None if value == NONE else value for n, value in given.items() if n != "title"}
    if options.create is None and options.model is not None:
        raise InvalidRequest("--model applies only to a new map. Add --create NAME.")
    if given and options.create is None and options.edit is None:
        raise InvalidRequest(
            f"--{next(iter(given)).replace('_', '-')} applies only when you create or edit a "
            "map. Add --create NAME or --edit NAME."
        )
    with open_client(options) as client:
        if options.delete is not None:
            _delete(client, options.delete, sure=options.yes)
        elif options.edit is not None:
            title = {"title": options.title or None} if "title" in given else {}
            edited = _edit(client, options.edit, title | limits, sure=options.yes)
            print(edited.model_dump_json() if options.json else _line(edited))
        elif options.create is not None:
            model = options.model or PRESETS[0]
            made = client.create_map(options.create, options.title, model, **limits)
            print(made.model_dump_json() if options.json else _line(made))
        else:
            _print_maps(client.maps(), as_json=options.json)
    return 0


def _limit(kind: type[int] | type[float]) -> Any:
    def read(given: str) -> float | str:
        return NONE if given == NONE else kind(given)

    read.__name__ = "number"  # argparse tells it
    return read


def _map_up(given: str) -> list[float] | str:
    return NONE if given == NONE else up_of(given)


def _edit(client: Client, name: str, changes: dict[str, Any], *, sure: bool) -> Map:
    if not changes:
        raise InvalidRequest("There is nothing to change. Add --title, --up or a limit.")
    if changes.get("retention_days") is not None and not sure:
        told = client.edit_map(name, changes, dry_run=True)
        if told.overdue:
            raise InvalidRequest(
                f"This would permanently delete the {told.overdue} frames of map {name} that are "
                f"older than {told.retention_days:g} days. Nothing was changed. Add --yes to go "
                "ahead."
            )
    return client.edit_map(name, changes)


def _delete(client: Client, name: str, *, sure: bool) -> None:
    n_frames = sum(client.map(name).frames.values())
    if not sure:
        raise InvalidRequest(
            f"This would permanently delete map {name} and its {n_frames} frames. Add --yes to "
            "go ahead."
        )
    client.delete_map(name)
    print(f"deleted map {name} and its {n_frames} frames")


def _line(one: Map) -> str:
    notes = _notes(one)
    return f"map {one.name}, {one.model}{notes and ', '}{notes}"


def _notes(one: Map) -> str:
    """Return notes on the quotas, the retention and the parent frames of a map."""
    parts = []
    if one.frames.get("indexed") and not one.posed_frames:
        parts.append("no poses")
    if one.parent_frames > 1:
        parts.append(f"{one.parent_frames} parent frames")
    if one.quota_frames is not None:
        parts.append(f"{one.used_frames} of {one.quota_frames} frames")
    if one.quota_bytes is not None:
        parts.append(f"{one.used_bytes / 1e6:.1f} of {one.quota_bytes / 1e6:.1f} MB")
    if one.retention_days is not None:
        parts.append(f"kept {one.retention_days:g} days")
    if one.up is not None:
        parts.append(f"up {one.up.x:g},{one.up.y:g},{one.up.z:g}")
    return ", ".join(parts)


def _print_maps(maps: list[Map], *, as_json: bool) -> None:
    if as_json:
        for one in maps:
            print(one.model_dump_json())
        return
    if not maps:
        print("no maps yet; create one with `sceneprint maps --create NAME` or `sceneprint upload`")
        return
    width = max(3, *(len(one.name) for one in maps))
    print(f"{'map':{width}}  indexed  waiting  rejected  failed  model                 title")
    for one in maps:
        n = one.frames
        waiting = n.get("received", 0) + n.get("signing", 0)
        title, notes = one_line(one.title or ""), _notes(one)
        label = f"{title}  ({notes})".strip() if notes else title
        print(
            f"{one.name:{width}}  {n.get('indexed', 0):7}  {waiting:7}  {n.get('rejected', 0):8}  "
            f"{n.get('failed', 0):6}  {one.model:20}  {label}".rstrip()
        )
