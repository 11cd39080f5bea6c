"""`sceneprint sessions`: list and edit sessions."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from sceneprint.cli.options import add_service_options, open_client
from sceneprint.cli.output import one_line, print_rows, source_label
from sceneprint.errors import InvalidRequest

if TYPE_CHECKING:
    from sceneprint_client import Client
    from sceneprint_client.api.listing import FrameDeletion, Session


def add_sessions(command: argparse.ArgumentParser) -> None:
    """Add the options of `sceneprint sessions`."""
    command.add_argument("map", metavar="MAP")
    command.add_argument("session", nargs="?", metavar="SESSION", help="name of one session")
    command.add_argument("--robot", metavar="NAME", help="only frames of this robot")
    command.add_argument("--rename", metavar="NAME", help="rename the session")
    command.add_argument("--rename-robot", metavar="NAME", help="rename the robot of its frames")
    for option, what in (("--tag", "add a tag to"), ("--untag", "remove a tag from")):
        command.add_argument(
            option, action="append", default=[], metavar="TAG",
            help=f"{what} its frames; repeatable",
        )  # fmt: skip
    command.add_argument("--delete", action="store_true", help="delete the session and its frames")
    command.add_argument("--yes", action="store_true", help="confirm a deletion")
    command.add_argument(
        "--deletions", action="store_true", help="list deletions of frames that can be undone"
    )
    command.add_argument("--undo", metavar="ID", help="undo the deletion with this id")
    command.add_argument("--json", action="store_true", help="print JSON")
    add_service_options(command)
    command.set_defaults(run=run_sessions)


def run_sessions(options: argparse.Namespace) -> int:
    """List the sessions of a map. With SESSION, rename it, change the tags of its frames, or
    delete it with all its frames. Deletions can be undone for a limited time.
    """
    edits = {
        "rename": options.rename, "rename_robot": options.rename_robot, "add_tags": options.tag,
        "remove_tags": options.untag,
    }  # fmt: skip
    edits = {name: value for name, value in edits.items() if value}
    if options.session is None and (edits or options.delete):
        raise InvalidRequest("Specify the session after the map to edit or delete it.")
    if options.delete and edits:
        raise InvalidRequest("--delete removes the session. Omit the other changes.")
    undo = options.deletions or options.undo is not None
    if undo and (options.session is not None or edits):
        raise InvalidRequest("--deletions and --undo apply to the whole map. Omit the session.")
    with open_client(options) as client:
        if options.undo is not None:
            undone = client.restore_deletion(options.map, options.undo)
            print(f"restored {undone.frames} frames")
            for refusal in undone.refused:
                print(f"not restored: {refusal.frame_id}: {one_line(refusal.reason)}")
        elif options.deletions:
            print_rows(
                client.deletions(options.map), _deletion_line, as_json=options.json,
                header=f"{'deletion':32}  frames  {'deleted':19}  until (UTC)",
                none="no deletions that can be undone",
            )  # fmt: skip
        elif options.delete:
            _delete_session(client, options)
        elif edits:
            edited = client.edit_session(options.map, options.session, robot=options.robot, **edits)
            print(f"edited {edited} frames of session {one_line(options.session)}")
        else:
            sessions = client.sessions(options.map)
            names = {"session": options.session, "robot": options.robot}
            conditions = {name: value for name, value in names.items() if value is not None}
            rows = (s for s in sessions if all(getattr(s, n) == v for n, v in conditions.items()))
            print_rows(
                rows, _session_line, as_json=options.json, none="no sessions yet",
                header="frames  indexed  poses  first captured       last captured        "
                "robot/session  [tags]",
            )  # fmt: skip
    return 0


def _delete_session(client: Client, options: argparse.Namespace) -> None:
    name = one_line(options.session)
    if not options.yes:
        of = [run for run in client.sessions(options.map) if run.session == options.session]
        of = [session for session in of if options.robot in (None, session.robot)]
        n_frames = sum(sum(session.frames.values()) for session in of)
        raise InvalidRequest(
            f"This would delete session {name} and its {n_frames} frames. Add --yes to confirm."
        )
    deleted = client.delete_session(options.map, options.session, options.robot)
    print(f"deleted session {name} and its {deleted} frames")
    newest = next(client.deletions(options.map), None)
    if newest is not None:
        print(
            f"undo until {newest.until:%H:%M} UTC: sceneprint sessions {options.map} --undo "
            f"{newest.deletion_id}"
        )


def _deletion_line(deletion: FrameDeletion) -> str:
    at, until = (f"{time:%Y-%m-%d %H:%M:%S}" for time in (deletion.at, deletion.until))
    return f"{deletion.deletion_id:32}  {deletion.frames:6}  {at}  {until}"


def _session_line(session: Session) -> str:
    first, last = (
        "" if at is None else f"{at:%Y-%m-%d %H:%M:%S}"
        for at in (session.first_captured_at, session.last_captured_at)
    )
    tags = one_line(f"  [{', '.join(session.tags)}]") if session.tags else ""
    return (
        f"{sum(session.frames.values()):6}  {session.frames.get('indexed', 0):7}  "
        f"{session.with_pose:5}  {first:19}  {last:19}  {source_label(session)}{tags}"
    )
