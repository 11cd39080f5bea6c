"""A session as a whole: renamed, tagged, or deleted with all its frames.

map, session  --delete_session | edit_session-->  SessionChange

Frames are written some at a time, each block in a transaction of its own, as writers wait
meanwhile. What is interrupted can be called again and goes on where it stopped.
"""

from __future__ import annotations

import time

from sqlalchemy import Connection

from sceneprint.engine.maps.selections import AT_ONCE, CALL_S, edited_tags
from sceneprint.engine.maps.undo import deletion_record
from sceneprint.engine.upkeep.garbage_collection import collect_deleted_blobs
from sceneprint.errors import UnknownSession
from sceneprint.store import Store
from sceneprint.store.deletion import delete_frames
from sceneprint.store.frame_queries import count_session, session_frames
from sceneprint.store.frames import find_frame, frame_of, write_frame
from sceneprint.store.maps import find_map
from sceneprint.store.tables import FrameRow, MapRow
from sceneprint.store.undo_rows import NO_UNDO, Deletion, UndoLimits, count_restorable
from sceneprint_client.api.listing import SessionChange, SessionEdit


def delete_session(
    store: Store, map_name: str, session: str, robot: str | None = None, seconds: float = CALL_S,
    undo: UndoLimits = NO_UNDO,
) -> SessionChange:  # fmt: skip
    """Delete frames of a session, in whatever state, until none is left or the time is over.

    Parameters
    ----------
    store : see Store
    map_name, session : of the frames
    robot : only those that it took; None for those of all robots
    seconds : after which no further block is begun
    undo : for how long that can be undone

    Raises
    ------
    UnknownMap, UnknownSession : there is none.
    """
    until, deleted = time.monotonic() + seconds, 0
    deletion: Deletion | None = None
    while True:
        with store.database.write() as connection:
            row = find_map(connection, map_name)
            numbers = session_frames(connection, row.number, session, robot, 0, AT_ONCE)
            if numbers and deletion is None:
                deletion = undo.begin(connection, row.number)
            blobs = delete_frames(connection, row, numbers, deletion=deletion)
            left = count_session(connection, row.number, session, robot)
            kept = count_restorable(connection, deletion)
        collect_deleted_blobs(store, blobs)
        deleted += len(numbers)
        if not left or time.monotonic() >= until:
            break
    _require_frames(deleted, row, session, robot)
    told = deletion_record(deletion, kept) if deletion is not None and kept else None
    return SessionChange(
        map=row.name, session=session, robot=robot, frames=deleted, remaining=left, deletion=told
    )


def edit_session(
    store: Store, map_name: str, session: str, edit: SessionEdit, robot: str | None = None,
    after: str | None = None, seconds: float = CALL_S,
) -> SessionChange:  # fmt: skip
    """Rename a session or its robot, and add or remove tags, on all its frames.

    A name that another session has joins the two. Poses and their parent frames stay.

    Parameters
    ----------
    store, map_name, session, robot, seconds : see `delete_session`
    edit : what to change
    after : id of the last frame of an earlier call, to go on from there

    Returns
    -------
    change : with the names afterwards, and how many frames were gone through

    Raises
    ------
    UnknownMap, UnknownSession, UnknownFrame : there is none.
    InvalidRequest : a frame would have more tags than it may have. The frames before it are
        changed.
    """
    until, done, at = time.monotonic() + seconds, 0, after
    while True:
        with store.database.write() as connection:
            row = find_map(connection, map_name)
            last = 0 if at is None else find_frame(connection, row, at).number
            numbers = session_frames(connection, row.number, session, robot, last, AT_ONCE)
            if numbers:
                at = _edit_frames(connection, row, numbers, edit)
                last = numbers[-1]
            left = count_session(connection, row.number, session, robot, last)
        done += len(numbers)
        if not left or time.monotonic() >= until:
            break
    if after is None:
        _require_frames(done, row, session, robot)
    return SessionChange(
        map=row.name, session=edit.session or session, robot=edit.robot or robot, frames=done,
        remaining=left, last_frame_id=at if left else None,
    )  # fmt: skip


def _edit_frames(connection: Connection, row: MapRow, numbers: list[int], edit: SessionEdit) -> str:
    """Edit some frames; the id of the last."""
    for number in numbers:
        frame = frame_of(connection, number)
        write_frame(connection, row, frame, _values(frame, edit))
    return frame.id


def _values(frame: FrameRow, edit: SessionEdit) -> dict[str, object]:
    """Columns of a frame that an edit asks for."""
    values: dict[str, object] = {}
    if edit.session is not None:
        values["session"] = edit.session
    if edit.robot is not None:
        values["robot"] = edit.robot
    if edit.add_tags or edit.remove_tags:
        values["tags"] = edited_tags(frame, edit)
    return values


def _require_frames(count: int, row: MapRow, session: str, robot: str | None) -> None:
    if not count:
        by = "" if robot is None else f" by robot {robot!r:.140}"
        raise UnknownSession(
            f"Map {row.name!r} has no frame of session {session!r:.140}{by}. "
            f"`sceneprint sessions {row.name}` lists them."
        )
