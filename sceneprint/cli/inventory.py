"""`sceneprint maps`, `frames`, `queries` and `jobs`: the content of a service."""

from __future__ import annotations

import argparse
from datetime import datetime
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

from sceneprint.atomic_files import write_whole
from sceneprint.cli import positive
from sceneprint.cli.options import add_service_options, open_client, up_of
from sceneprint.cli.output import count_of, one_line, percent, print_error, print_rows, source_label
from sceneprint.cli.scenes import Scene, add_scene_options, check_scene, open_scene
from sceneprint.errors import InvalidRequest
from sceneprint_client.api.base import FrameState, JobState
from sceneprint_client.api.listing import Clock
from sceneprint_client.api.maps import PRESETS
from sceneprint_client.api.results import CLOUD_FRAMES, RECORD_STATUSES, VIEWS, WIDTH

if TYPE_CHECKING:
    from sceneprint_client import Client
    from sceneprint_client.api import Frame, Job, Map
    from sceneprint_client.api.results import QueryRecord

#: Options that write data of a frame to a file.
_FILES = ("cloud", "preview", "patches", "signature", "upload")


def add_frames(command: argparse.ArgumentParser) -> None:
    """Add the options of `sceneprint frames`."""
    command.add_argument("map", metavar="MAP")
    command.add_argument("frame_id", nargs="?", metavar="FRAME", help="id of one frame")
    group = command.add_argument_group("select frames or poses")
    for option, metavar, text in (
        ("--robot", "NAME", "repeatable: matches any"),
        ("--session", "NAME", "repeatable: matches any"),
        ("--tag", "TAG", "repeatable: matches all"),
    ):
        group.add_argument(option, action="append", metavar=metavar, help=text)
    group.add_argument(
        "--name", metavar="PREFIX", help="prefix of the original file name, case-sensitive"
    )
    group.add_argument("--find", metavar="PREFIX", help="prefix of the id, file name or session")
    group.add_argument("--state", choices=[str(state) for state in FrameState])
    group.add_argument("--parent-frame", metavar="NAME", help="parent frame of the poses")
    for option, text in (
        ("--after", "captured at or after this time: 2026-11-16T09:30:00Z"),
        ("--before", "captured at or before this time"),
    ):
        group.add_argument(option, type=_time, metavar="TIME", help=text)
    group.add_argument("--newest", action="store_true", help="newest first")
    group.add_argument("--limit", type=positive, metavar="N", help="maximum number to list")
    group.add_argument(
        "--trajectory", type=Path, metavar="FILE",
        help="write the poses of one --session as a TUM trajectory",
    )  # fmt: skip
    group.add_argument(
        "--clock", choices=get_args(Clock), default="taken",
        help="stamps of the trajectory: taken is captured_at, or sequence if no frame has a "
        "captured_at (default: taken)",
    )  # fmt: skip
    _add_files(command.add_argument_group("actions on one frame"))
    add_scene_options(command)
    command.add_argument("--json", action="store_true", help="print JSON")
    add_service_options(command)
    command.set_defaults(run=run_frames)


def _add_files(group: Any) -> None:
    for option, text in (
        ("--cloud", "write its point cloud as PLY"),
        ("--preview", "write a preview as PNG"),
        ("--patches", "write its patches as JSON"),
        ("--signature", "write its signature as JSON"),
        ("--upload", "write the uploaded file unchanged"),
    ):
        group.add_argument(option, type=Path, metavar="FILE", help=text)
    group.add_argument(
        "--within", choices=CLOUD_FRAMES, default="optical",
        help="coordinate frame of the cloud: the sensor, the parent frame of its pose, or the "
        "robot's base (default: optical)",
    )  # fmt: skip
    group.add_argument(
        "--view", choices=VIEWS, default="depth", help="view of the preview (default: depth)"
    )
    group.add_argument("--width", type=positive, default=WIDTH, metavar="PIXELS")
    group.add_argument(
        "--edit", type=_changes, metavar="JSON",
        help="edit its metadata: '{\"tags\": [\"door\"], \"robot\": null}'",
    )  # fmt: skip


def run_frames(options: argparse.Namespace) -> int:
    """List the frames of a map in the order of upload (for one session, in the order of capture),
    or write the trajectory of a session. With FRAME, show that frame, download its files, or edit
    its metadata.
    """
    of_one = [name for name in (*_FILES, "edit") if getattr(options, name) is not None]
    if options.frame_id is None and of_one:
        raise InvalidRequest(f"--{of_one[0]} applies to one frame. Add its id after the map.")
    one_session = len(options.session or ()) == 1
    if options.trajectory is not None and not one_session:
        raise InvalidRequest("--trajectory requires a session. Add --session NAME.")
    if options.trajectory is not None and options.mcap is not None:
        raise InvalidRequest(
            "--trajectory does not write a scene. Use a separate command for the scene."
        )
    check_scene(options)
    with open_client(options) as client, open_scene(options, client) as scene:
        if options.frame_id is not None:
            frame = _show_one(client, options)
            if scene is not None:
                scene.add_frame(frame)
        elif options.trajectory is not None:
            _write_trajectory(client, options)
        else:
            matching_frames = client.frames(
                options.map, None if options.state is None else FrameState(options.state),
                robot=options.robot or (), session=options.session or (), tags=options.tag or (),
                parent_frame=options.parent_frame, captured_after=options.after,
                captured_before=options.before, name=options.name, find=options.find,
                order="desc" if options.newest else "taken" if one_session else "asc",
            )  # fmt: skip
            frames = islice(matching_frames, options.limit)
            listed = frames if scene is None else list(frames)
            print_rows(
                listed, _frame_line, as_json=options.json, none="no frames match",
                header=f"{'frame':32}  state      captured             pose  sequence  "
                "robot/session  name  tags",
            )  # fmt: skip
            if scene is not None:
                _show_frames(scene, list(listed))
    return 0


def _show_frames(scene: Scene, frames: list[Frame]) -> None:
    """Write a scene of the listed frames; raise InvalidRequest if no frame has a pose."""
    posed = [frame for frame in frames if frame.pose is not None]
    if not posed:
        raise InvalidRequest(
            "No listed frame has a pose, so the scene would be empty. Specify one FRAME."
        )
    if len(posed) < len(frames):
        print_error(f"{len(frames) - len(posed)} frames without a pose are not shown")
    scene.add_frames(posed)


def _show_one(client: Client, options: argparse.Namespace) -> Frame:
    of = options.map, options.frame_id
    frame = client.frame(*of) if options.edit is None else client.edit_frame(*of, options.edit)
    readers = {
        "cloud": lambda: client.cloud(*of, options.within),
        "preview": lambda: client.preview(*of, options.view, options.width),
        "patches": lambda: client.patches(*of).model_dump_json().encode(),
        "signature": lambda: client.signature(*of).model_dump_json().encode(),
        "upload": lambda: client.upload_of(*of),
    }
    paths = [(name, path) for name in _FILES if (path := getattr(options, name)) is not None]
    for name, path in paths:
        write_whole(path, readers[name]())
    if options.json or not paths:
        print(frame.model_dump_json(indent=None if options.json else 2))
    else:
        print("\n".join(f"wrote {path}" for _, path in paths))
    return frame


def _write_trajectory(client: Client, options: argparse.Namespace) -> None:
    if len(options.robot or ()) > 1:
        raise InvalidRequest("--trajectory accepts only one robot. Specify --robot once.")
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


def _frame_line(frame: Frame) -> str:
    at = "" if frame.captured_at is None else f"{frame.captured_at:%Y-%m-%d %H:%M:%S}"
    pose = "no" if frame.pose is None else "yes"
    place = "" if frame.sequence is None else frame.sequence
    return (
        f"{frame.frame_id:32}  {frame.state:9}  {at:19}  {pose:4}  {place:>8}  "
        f"{source_label(frame)}  {one_line(frame.name or '-')}  {one_line(','.join(frame.tags))}"
    )


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
    from pydantic_core import from_json

    try:
        changes = from_json(text, allow_inf_nan=False)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"not JSON ({error})") from error
    if not isinstance(changes, dict):
        raise argparse.ArgumentTypeError("not a JSON object")
    return changes


# `sceneprint queries`.


def add_queries(command: argparse.ArgumentParser) -> None:
    """Add the options of `sceneprint queries`."""
    command.add_argument("map", nargs="?", metavar="MAP", help="only queries of this map")
    command.add_argument(
        "--status", action="append", default=[], choices=RECORD_STATUSES,
        help="only queries with this outcome; repeatable: matches any",
    )  # fmt: skip
    command.add_argument("--robot", metavar="NAME", help="only queries of this robot")
    command.add_argument("--kept", action="store_true", help="only queries with kept answers")
    for option, text in (
        ("--since", "only queries at or after this time: 2026-11-16T09:30:00Z"),
        ("--until", "only queries before this time"),
    ):
        command.add_argument(option, type=_time, metavar="TIME", help=text)
    command.add_argument(
        "--limit", type=positive, default=20, metavar="N", help="maximum number (default: 20)"
    )
    command.add_argument("--json", action="store_true", help="print JSON, one query per line")
    add_service_options(command)
    command.set_defaults(run=run_queries)


def run_queries(options: argparse.Namespace) -> int:
    """List the latest queries of a map or of all maps, newest first, with their times, outcomes,
    robots, and poses or reasons.
    """
    with open_client(options) as client:
        queries = client.queries(
            options.map, status=options.status, robot=options.robot, since=options.since,
            until=options.until, kept=options.kept,
        )  # fmt: skip
        print_rows(
            islice(queries, options.limit), _query_line, as_json=options.json,
            header=f"{'query':32}  {'time':19}  status          ms  map  robot/session  pose or "
            "reason", none="no queries match",
        )  # fmt: skip
    return 0


def _query_line(query: QueryRecord) -> str:
    if query.pose is None:
        result = one_line(query.reason)
    else:
        t = query.pose.translation
        sure = "" if query.confidence is None else f", {percent(query.confidence)}"
        result = (
            f"{t.x:.2f} {t.y:.2f} {t.z:.2f} m in {one_line(query.pose.parent_frame)}, "
            f"{count_of(query.support or 0, 'view')}{sure}"
        )
    return (
        f"{query.query_id}  {query.at:%Y-%m-%d %H:%M:%S}  {query.status:11}  "
        f"{query.milliseconds:5.0f}  {query.map}  {source_label(query)}  {result}"
    )


# `sceneprint jobs`.


def add_jobs(command: argparse.ArgumentParser) -> None:
    """Add the options of `sceneprint jobs`."""
    choice = command.add_mutually_exclusive_group()
    choice.add_argument("--retry", metavar="ID", help="retry a failed, dead or cancelled job")
    choice.add_argument(
        "--retry-dead", action="store_true", help="retry all dead jobs that were not retried yet"
    )
    choice.add_argument("--cancel", metavar="ID", help="cancel an unfinished job")
    choice.add_argument(
        "--state", choices=[str(state) for state in JobState], help="list only jobs in this state"
    )
    command.add_argument("--json", action="store_true", help="print JSON, including tracebacks")
    add_service_options(command)
    command.set_defaults(run=run_jobs)


def run_jobs(options: argparse.Namespace) -> int:
    """List the jobs of a service, newest first, or retry or cancel some."""
    with open_client(options) as client:
        if options.retry is not None:
            _print_job(client.retry_job(options.retry), as_json=options.json)
        elif options.cancel is not None:
            _print_job(client.cancel_job(options.cancel), as_json=options.json)
        elif options.retry_dead:
            return _retry_dead(client, as_json=options.json)
        else:
            state = None if options.state is None else JobState(options.state)
            print_rows(
                client.jobs(state), _job_line, as_json=options.json, none="no jobs match",
                header=f"{'job':32}  state      prio  tries  created              map  error",
            )  # fmt: skip
    return 0


def _retry_dead(client: Client, *, as_json: bool) -> int:
    """Retry all dead jobs that were not retried yet; return 2 if a job cannot be retried."""
    again, refused = 0, 0
    for done in client.retry_dead_jobs():
        again, refused = again + len(done.retried), refused + len(done.refused)
        for refusal in done.refused:
            print_error(f"sceneprint jobs: {one_line(refusal.reason)}")
        for job in done.retried:
            _print_job(job, as_json=as_json)
    if not as_json:
        print(f"{again} jobs queued again, {refused} cannot be retried")
    return 2 if refused else 0


def _print_job(job: Job, *, as_json: bool) -> None:
    print(job.model_dump_json() if as_json else f"job {job.job_id} of map {job.map}, {job.state}")


def _job_line(job: Job) -> str:
    return (
        f"{job.job_id:32}  {job.state:9}  {job.priority:4}  {job.attempts:5}  "
        f"{job.created_at:%Y-%m-%d %H:%M:%S}  {job.map}  {one_line(job.error or '')}"
    )


# `sceneprint maps`.

#: Value of an option that removes a limit.
NONE = "none"


def add_maps(command: argparse.ArgumentParser) -> None:
    """Add the options of `sceneprint maps`."""
    choice = command.add_mutually_exclusive_group()
    choice.add_argument(
        "--create", metavar="NAME", help="create a map; its name may contain a-z, 0-9, - and _"
    )
    choice.add_argument("--edit", metavar="NAME", help="edit title, limits or up vector of a map")
    choice.add_argument("--delete", metavar="NAME", help="delete a map with all its frames")
    command.add_argument("--title", help="human-readable title of the map")
    command.add_argument(
        "--model", choices=PRESETS, help=f"model of the new map (default: {PRESETS[0]})"
    )
    for option, metavar, kind, text in (
        ("--quota-frames", "N", int, "maximum number of frames in the map"),
        ("--quota-bytes", "N", int, "maximum total size of its uploads, bytes"),
        ("--retention-days", "DAYS", float, "delete frames this many days after their upload"),
    ):
        command.add_argument(
            option, metavar=metavar, type=_limit(kind), help=f"{text}; `{NONE}` for no limit"
        )
    command.add_argument(
        "--up", metavar="X,Y,Z", type=lambda text: NONE if text == NONE else up_of(text),
        help="up vector in the parent frames of the poses, such as 0,0,1; "
        f"`{NONE}` to estimate it from frames",
    )  # fmt: skip
    command.add_argument("--yes", action="store_true", help="confirm a deletion")
    command.add_argument("--json", action="store_true", help="print JSON")
    add_service_options(command)
    command.set_defaults(run=run_maps)


def run_maps(options: argparse.Namespace) -> int:
    """List the maps of a service, or create, edit or delete one. Quotas require a key with `admin`
    for `*`.
    """
    names = ("title", "quota_frames", "quota_bytes", "retention_days", "up")
    fields = {n: getattr(options, n) for n in names if getattr(options, n) is not None}
    limits = {n: None if value == NONE else value for n, value in fields.items() if n != "title"}
    if options.create is None and options.model is not None:
        raise InvalidRequest("--model applies only to a new map. Add --create NAME.")
    if fields and options.create is None and options.edit is None:
        raise InvalidRequest(
            f"--{next(iter(fields)).replace('_', '-')} applies only when you create or edit a "
            "map. Add --create NAME or --edit NAME."
        )
    with open_client(options) as client:
        if options.delete is not None:
            _delete(client, options.delete, confirmed=options.yes)
            return 0
        if options.edit is None and options.create is None:
            _print_maps(client.maps(), as_json=options.json)
            return 0
        if options.edit is not None:
            title = {"title": options.title or None} if "title" in fields else {}
            record = _edit(client, options.edit, title | limits, confirmed=options.yes)
        else:
            model = options.model or PRESETS[0]
            record = client.create_map(options.create, options.title, model, **limits)
        notes = ", ".join([f"map {record.name}", record.model, *_notes(record)])
        print(record.model_dump_json() if options.json else notes)
    return 0


def _limit(kind: type[int] | type[float]) -> Any:
    def read(text: str) -> float | str:
        return NONE if text == NONE else kind(text)

    read.__name__ = "number"  # argparse shows this name in errors
    return read


def _edit(client: Client, name: str, changes: dict[str, Any], *, confirmed: bool) -> Map:
    if not changes:
        raise InvalidRequest("There is nothing to change. Add --title, --up or a limit.")
    if changes.get("retention_days") is not None and not confirmed:
        preview = client.edit_map(name, changes, dry_run=True)
        if preview.overdue:
            raise InvalidRequest(
                f"This would permanently delete the {preview.overdue} frames of map {name} that "
                f"are older than {preview.retention_days:g} days. Nothing was changed. Add --yes "
                "to confirm."
            )
    return client.edit_map(name, changes)


def _delete(client: Client, name: str, *, confirmed: bool) -> None:
    n_frames = sum(client.map(name).frames.values())
    if not confirmed:
        raise InvalidRequest(
            f"This would permanently delete map {name} and its {n_frames} frames. Add --yes to "
            "confirm."
        )
    client.delete_map(name)
    print(f"deleted map {name} and its {n_frames} frames")


def _notes(record: Map) -> list[str]:
    """Return notes on poses, quotas, retention and up vector of a map."""
    parts = []
    if record.frames.get("indexed") and not record.posed_frames:
        parts.append("no poses")
    if record.parent_frames > 1:
        parts.append(f"{record.parent_frames} parent frames")
    if record.quota_frames is not None:
        parts.append(f"{record.used_frames} of {record.quota_frames} frames")
    if record.quota_bytes is not None:
        parts.append(f"{record.used_bytes / 1e6:.1f} of {record.quota_bytes / 1e6:.1f} MB")
    if record.retention_days is not None:
        parts.append(f"kept {record.retention_days:g} days")
    if record.up is not None:
        parts.append(f"up {record.up.x:g},{record.up.y:g},{record.up.z:g}")
    return parts


def _print_maps(maps: list[Map], *, as_json: bool) -> None:
    width = max(3, *(len(record.name) for record in maps)) if maps else 0

    def line(record: Map) -> str:
        n, notes = record.frames, ", ".join(_notes(record))
        waiting = n.get("received", 0) + n.get("signing", 0)
        label = one_line(record.title or "") + (f"  ({notes})" if notes else "")
        return (
            f"{record.name:{width}}  {n.get('indexed', 0):7}  {waiting:7}  "
            f"{n.get('rejected', 0):8}  {n.get('failed', 0):6}  {record.model:20}  {label.strip()}"
        )

    print_rows(
        maps, line, as_json=as_json,
        header=f"{'map':{width}}  indexed  waiting  rejected  failed  model                 title",
        none="no maps yet; create one with `sceneprint maps --create NAME` or `sceneprint upload`",
    )  # fmt: skip
