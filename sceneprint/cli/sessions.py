"""`sceneprint sessions` and `associate`: list and edit sessions, and join them."""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from tqdm import tqdm

from sceneprint.atomic_files import check_writable, write_whole
from sceneprint.cli import positive
from sceneprint.cli.options import (
    add_seed_option,
    add_service_options,
    one_line,
    open_client,
)
from sceneprint.cli.scenes import add_scene_options, check_scene, open_scene
from sceneprint.errors import InvalidRequest
from sceneprint_client.api import JobState

if TYPE_CHECKING:
    from sceneprint_client import Client
    from sceneprint_client.api.listing import FrameDeletion, Session
    from sceneprint_client.api.sessions import Association, GraphFormat, Join

#: What a file is by its name's end.
_FORMATS: dict[str, GraphFormat] = {".g2o": "g2o", ".txt": "tum", ".tum": "tum", ".json": "json"}


def add_sessions(command: argparse.ArgumentParser) -> None:
    """Add the options of `sceneprint sessions`."""
    command.add_argument("map", metavar="MAP")
    command.add_argument("session", nargs="?", metavar="SESSION", help="name of one session")
    command.add_argument("--robot", metavar="NAME", help="only the frames of this robot")
    command.add_argument("--rename", metavar="NAME", help="rename the session")
    command.add_argument("--rename-robot", metavar="NAME", help="rename the robot of its frames")
    for option, what in (("--tag", "add a tag to"), ("--untag", "remove a tag from")):
        command.add_argument(
            option,
            action="append",
            default=[],
            metavar="TAG",
            help=f"{what} its frames; repeatable",
        )
    command.add_argument("--delete", action="store_true", help="delete it with all its frames")
    command.add_argument("--yes", action="store_true", help="confirm a deletion")
    command.add_argument(
        "--deletions", action="store_true", help="list deletions of frames that can be undone"
    )
    command.add_argument("--undo", metavar="ID", help="undo one of these deletions")
    command.add_argument("--json", action="store_true", help="print JSON")
    add_service_options(command)
    command.set_defaults(run=run_sessions)


def run_sessions(options: argparse.Namespace) -> int:
    """List the sessions of a map. With SESSION: rename it, change the tags of its frames, or
    delete it with all its frames. Deletions can be undone for a while.
    """
    edits = {
        "rename": options.rename, "rename_robot": options.rename_robot, "add_tags": options.tag,
        "remove_tags": options.untag,
    }  # fmt: skip
    edits = {name: value for name, value in edits.items() if value}
    if options.session is None and (edits or options.delete):
        raise InvalidRequest("Name the session after the map, to edit or delete it.")
    if options.delete and edits:
        raise InvalidRequest("--delete removes the session. Leave the other changes out.")
    undo = options.deletions or options.undo is not None
    if undo and (options.session is not None or edits):
        raise InvalidRequest("--deletions and --undo apply to the whole map. Name no session.")
    with open_client(options) as client:
        if options.undo is not None:
            undone = client.restore_deletion(options.map, options.undo)
            print(f"restored {undone.frames} frames")
            for one in undone.refused:
                print(f"not restored: {one.frame_id}: {one_line(one.reason)}")
        elif options.deletions:
            _deletions(client.deletions(options.map), as_json=options.json)
        elif options.delete:
            _delete_session(client, options)
        elif edits:
            edited = client.edit_session(options.map, options.session, robot=options.robot, **edits)
            print(f"edited {edited} frames of session {one_line(options.session)}")
        else:
            found = client.sessions(options.map)
            names = {"session": options.session, "robot": options.robot}
            wanted = {name: value for name, value in names.items() if value is not None}
            chosen = (s for s in found if all(getattr(s, n) == v for n, v in wanted.items()))
            _sessions(chosen, as_json=options.json)
    return 0


def _delete_session(client: Client, options: argparse.Namespace) -> None:
    name = one_line(options.session)
    if not options.yes:
        of = [one for one in client.sessions(options.map) if one.session == options.session]
        of = [one for one in of if options.robot in (None, one.robot)]
        n_frames = sum(sum(one.frames.values()) for one in of)
        raise InvalidRequest(
            f"This would delete session {name} and its {n_frames} frames. Add --yes to go ahead."
        )
    deleted = client.delete_session(options.map, options.session, options.robot)
    print(f"deleted session {name} and its {deleted} frames")
    newest = next(client.deletions(options.map), None)
    if newest is not None:
        print(
            f"undo until {newest.until:%H:%M} UTC: sceneprint sessions {options.map} --undo "
            f"{newest.deletion_id}"
        )


def _deletions(deletions: Iterable[FrameDeletion], *, as_json: bool) -> None:
    any_yet = False
    for one in deletions:
        if as_json:
            print(one.model_dump_json())
            continue
        if not any_yet:
            print(f"{'deletion':32}  frames  {'deleted':19}  until (UTC)")
            any_yet = True
        at, until = (f"{time:%Y-%m-%d %H:%M:%S}" for time in (one.at, one.until))
        print(f"{one.deletion_id:32}  {one.frames:6}  {at}  {until}")
    if not any_yet and not as_json:
        print("no deletions that can be undone")


def _sessions(sessions: Iterable[Session], *, as_json: bool) -> None:
    any_yet = False
    for one in sessions:
        if as_json:
            print(one.model_dump_json())
            continue
        if not any_yet:
            print(
                "frames  indexed  poses  first captured       last captured        robot/session  "
                "[tags]"
            )
            any_yet = True
        first, last = (
            "" if at is None else f"{at:%Y-%m-%d %H:%M:%S}"
            for at in (one.first_captured_at, one.last_captured_at)
        )
        who = one_line(f"{one.robot or '-'}/{one.session or '-'}")
        tags = one_line(f"  [{', '.join(one.tags)}]") if one.tags else ""
        n = sum(one.frames.values())
        print(
            f"{n:6}  {one.frames.get('indexed', 0):7}  {one.with_pose:5}  {first:19}  {last:19}  "
            f"{who}{tags}"
        )
    if not any_yet and not as_json:
        print("no sessions yet")


def add_associate(command: argparse.ArgumentParser) -> None:
    """Add the options of `sceneprint associate`.

    Length: a statement for each option, in the order of `--help`.
    """
    command.add_argument("map", metavar="MAP")
    which = command.add_mutually_exclusive_group(required=True)
    which.add_argument(
        "--session",
        action="append",
        metavar="NAME",
        help="once for loop closures; twice to join two sessions, the first onto the second",
    )
    which.add_argument(
        "--undo",
        metavar="ID",
        help="undo the join of this association: poses are again as they were sent",
    )
    command.add_argument(
        "--robot",
        action="append",
        metavar="NAME",
        help=(
            "robot of each session, in the same order; needed if several robots use the same "
            "session name"
        ),
    )
    command.add_argument(
        "--after", metavar="TIME", help="only frames captured at or after this time"
    )
    command.add_argument(
        "--before", metavar="TIME", help="only frames captured at or before this time"
    )
    command.add_argument(
        "--apart",
        type=positive,
        metavar="N",
        help="loop closure: minimum number of frames between the two (default: 100)",
    )
    command.add_argument(
        "--not-within",
        type=float,
        metavar="SECONDS",
        help="loop closure: minimum time between the two",
    )
    command.add_argument(
        "--k", type=positive, default=3, metavar="K", help="number of edges per frame (default: 3)"
    )
    command.add_argument(
        "--candidates",
        type=positive,
        default=10,
        metavar="N",
        help="candidates to try per frame until it has K edges (default: 10)",
    )
    add_seed_option(command)
    command.add_argument(
        "--min-overlap",
        type=float,
        default=0.0,
        metavar="SHARE",
        help="minimum overlap of an edge, 0 to 1",
    )
    command.add_argument(
        "--join",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="let the poses of both sessions lead to one parent frame, where the join is strong "
        "(default)",
    )
    command.add_argument(
        "--out",
        type=Path,
        metavar="FILE",
        help="write the pose graph: .g2o, .txt (the vertices as a TUM trajectory) or .json",
    )
    command.add_argument(
        "--odometry", action="store_true", help="include edges between consecutive frames"
    )
    command.add_argument("--json", action="store_true", help="print JSON")
    add_scene_options(command)
    add_service_options(command)
    command.set_defaults(run=run_associate)


def run_associate(options: argparse.Namespace) -> int:
    """Find where two sessions of a map see the same places and how they align, or find the loop
    closures of a single session. Can write the pose graph for an optimiser.
    """
    from sceneprint_client.api.sessions import Association

    if options.undo is not None:
        with open_client(options) as client:
            undone = client.undo_join(options.map, options.undo)
        print(undone.model_dump_json() if options.json else "\n".join(association_lines(undone)))
        return 0
    if len(options.session) > 2:
        raise InvalidRequest(
            "An association needs one or two sessions. Give --session once or twice."
        )
    kind = None if options.out is None else _FORMATS.get(options.out.suffix.lower())
    if options.out is not None and kind is None:
        raise InvalidRequest(
            f"{options.out.name!a:.80} has no known file type. Use a name for --out that ends in "
            f"{', '.join(_FORMATS)}."
        )
    if options.out is not None:  # it may take an hour
        check_writable(options.out)
    check_scene(options)
    times = {"captured_after": options.after, "captured_before": options.before}
    wanted = {name: value for name, value in times.items() if value is not None}
    fields = {
        "sessions": options.session, "robots": options.robot, "filter": wanted or None,
        "apart": options.apart, "not_within_s": options.not_within, "k": options.k,
        "candidates": options.candidates, "seed": options.seed,
        "min_overlap": options.min_overlap, "join": options.join,
    }  # fmt: skip
    with (
        open_client(options) as client,
        open_scene(options, client) as scene,
        tqdm(desc="associate", unit="frame", disable=None) as bar,
    ):

        def progress(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        told = client.compute(Association, options.map, progress=progress, **fields)
        if kind is not None and told.state is JobState.SUCCEEDED:
            graph = client.graph(options.map, told.job_id, kind, odometry=options.odometry)
            write_whole(options.out, graph.encode())
        if scene is not None and told.state is JobState.SUCCEEDED:
            scene.add_association(told, "\n".join(association_lines(told)))
    print(told.model_dump_json() if options.json else "\n".join(association_lines(told)))
    if told.state is JobState.SUCCEEDED and options.out is not None and not options.json:
        print(f"wrote {options.out}")
    return 0 if told.state is JobState.SUCCEEDED else 2


def association_lines(told: Association) -> list[str]:
    """An association for people: what was found, and whether the sessions are joined."""
    name = f"association {told.job_id}"
    if told.result is None:
        why = "" if told.error is None else f": {one_line(told.error)}"
        return [f"{name} is {told.state}{why}"]
    r = told.result
    lines = [
        f"{name}: {r.edges} edges from {r.frames} frames ({r.validated} pairs validated)",
        f"edges: {r.consistent} supported by others, {r.inconsistent} outvoted, {r.unchecked} "
        "unsupported",
    ]
    lines += [line for one in r.joins for line in _join(one)]
    if len(told.request.sessions) == 2 and not r.joins:
        lines.append("not joined: no edge connects frames with poses")
    return lines


def _join(one: Join) -> list[str]:
    names = f"{one_line(one.from_parent)} onto {one_line(one.to_parent)}"
    if one.transform is None:
        return [f"not joined, {names}: {one_line(one.reason)}"]
    sure = "surely" if one.strength == "strong" else "weakly (check it before you rely on it)"
    t, r = one.transform.translation, one.transform.rotation
    moved = [] if one.root is None else [f"  all their poses are in {one_line(one.root)} now"]
    moved += ["  undone: it moves no pose any more"] if one.undone else []
    return [
        f"joined {sure}, {names}: {one_line(one.reason)}, spread "
        f"{100 * (one.spread_m or 0.0):.1f} cm, {one.spread_deg or 0.0:.1f} deg",
        f"  translation {t.x:.4f} {t.y:.4f} {t.z:.4f} m, rotation {r.x:.6f} {r.y:.6f} {r.z:.6f} "
        f"{r.w:.6f} (x y z w)",
        *moved,
    ]
