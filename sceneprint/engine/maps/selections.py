"""Editing and deletion of selected frames and of sessions.

map, FrameSelection  --delete_selection-->  FramesDeleted
map, FramesEdit  --edit_selection-->  FramesEdited, with the inverse edits
map, session  --delete_session | edit_session-->  SessionChange

Each block of frames is a transaction of its own, so that other writers need not wait long. After an
interruption, repeat the call to process the remaining frames.
"""

from __future__ import annotations

import json
import time
from typing import Any

from sqlalchemy import Connection, select

from sceneprint.engine.maps.tombstones import AT_ONCE, CALL_S, Tombstones
from sceneprint.engine.upkeep.garbage_collection import collect_deleted_blobs
from sceneprint.errors import InvalidRequest, UnknownSession
from sceneprint.store import Store
from sceneprint.store.deletion import delete_frames
from sceneprint.store.frame_queries import CapturePosition, count_listed, list_frames
from sceneprint.store.frames import write_frame
from sceneprint.store.maps import find_frame, find_map
from sceneprint.store.tables import FrameRow, MapRow, frame_row, frames
from sceneprint_client.api import FrameState
from sceneprint_client.api.base import MOST_TAGS
from sceneprint_client.api.listing import (
    MOST_SELECTED,
    FrameListing,
    FramesDeleted,
    FramesEdit,
    FramesEdited,
    FrameSelection,
    SessionChange,
    SessionEdit,
)


def delete_selection(
    store: Store, map_name: str, selection: FrameSelection, tombstones: Tombstones,
    seconds: float = CALL_S,
) -> FramesDeleted:  # fmt: skip
    """Delete selected frames in blocks; return the numbers of deleted and of remaining frames.

    Parameters
    ----------
    tombstones : handler that makes the deletion undoable
    seconds : duration after which no further block is started

    Raises
    ------
    UnknownMap : If the map does not exist.
    """
    until, deleted, last = time.monotonic() + seconds, 0, 0
    deletion: int | None = None
    while True:
        with store.database.write() as connection:
            row = find_map(connection, map_name)
            block = _selected(connection, row, selection, last, AT_ONCE)
            deletion = deletion or tombstones.begin(row)
            numbers = [frame.number for frame in block]
            blobs = delete_frames(connection, row, numbers, deletion=deletion)
            last = numbers[-1] if numbers else last
            remaining = _count(connection, row, selection, last)
            record = tombstones.find(connection, row, deletion)
        collect_deleted_blobs(store, blobs)
        deleted += len(block)
        if not remaining or time.monotonic() >= until:
            break
    return FramesDeleted(map=row.name, frames=deleted, remaining=remaining, deletion=record)


def edit_selection(
    store: Store, map_name: str, edit: FramesEdit, seconds: float = CALL_S
) -> FramesEdited:
    """Edit up to 1000 selected frames in blocks; return counts, the last id and inverse edits.

    Raises
    ------
    UnknownMap, UnknownFrame : If the map or the frame `edit.after` does not exist.
    InvalidRequest : If a frame would get too many tags; earlier frames remain edited.
    """
    until, done, changed = time.monotonic() + seconds, 0, 0
    inverse: dict[str, dict[str, Any]] = {}
    with store.database.read() as connection:
        row = find_map(connection, map_name)
        at = None if edit.after is None else find_frame(connection, row, edit.after)
    last, last_id = (0, None) if at is None else (at.number, at.id)
    while True:
        with store.database.write() as connection:
            row = find_map(connection, map_name)
            block = _selected(connection, row, edit, last, AT_ONCE)
            for frame in block:
                changed += _edit(connection, row, frame, edit, inverse)
                last, last_id = frame.number, frame.id
            remaining = _count(connection, row, edit, last)
        done += len(block)
        if not remaining or done >= MOST_SELECTED or time.monotonic() >= until:
            break
    return FramesEdited(
        map=row.name, frames=changed, remaining=remaining,
        last_frame_id=last_id if remaining else None, inverse=list(inverse.values()),
    )  # fmt: skip


def edited_tags(frame: FrameRow, edit: FramesEdit | SessionEdit) -> list[str]:
    """Return the tags of a frame after an edit; raise InvalidRequest if there are too many."""
    removed = set(edit.remove_tags)
    tags = [tag for tag in frame.tags if tag not in removed]
    tags += [tag for tag in dict.fromkeys(edit.add_tags) if tag not in tags]
    if len(tags) > MOST_TAGS:
        raise InvalidRequest(
            f"Frame {frame.id} would have {len(tags)} tags, but a frame can have at most "
            f"{MOST_TAGS}. Remove some with `remove_tags`.",
            (("add_tags", "too many"),),
        )
    return tags


def _edit(
    connection: Connection, row: MapRow, frame: FrameRow, edit: FramesEdit,
    inverse: dict[str, dict[str, Any]],
) -> int:  # fmt: skip
    """Edit a frame, and add the inverse edit to `inverse`; return 1 if it changed, else 0."""
    values: dict[str, Any] = {}
    for name in ("session", "robot"):
        if name in edit.model_fields_set:
            values[name] = getattr(edit, name)
    if edit.add_tags or edit.remove_tags:
        values["tags"] = edited_tags(frame, edit)
    values = {name: value for name, value in values.items() if getattr(frame, name) != value}
    if not values:
        return 0
    write_frame(connection, row, frame, values)
    back: dict[str, Any] = {name: getattr(frame, name) for name in values if name != "tags"}
    if "tags" in values:
        now = values["tags"]
        back["add_tags"] = [tag for tag in frame.tags if tag not in now]
        back["remove_tags"] = [tag for tag in now if tag not in frame.tags]
    key = json.dumps(back, sort_keys=True)
    inverse.setdefault(key, {"frame_ids": [], **back})["frame_ids"].append(frame.id)
    return 1


def _selected(
    connection: Connection, row: MapRow, selection: FrameSelection, after: int, limit: int
) -> list[FrameRow]:
    """Return up to `limit` selected frames after frame number `after`, in upload order."""
    if selection.filter is not None:
        beyond = CapturePosition(after, None, None)
        return list_frames(connection, row.number, beyond, limit, _in_order(selection))
    statement = select(frames).where(
        frames.c.map_number == row.number, frames.c.id.in_(selection.frame_ids or []),
        frames.c.state != FrameState.DELETED, frames.c.number > after,
    )  # fmt: skip
    rows = connection.execute(statement.order_by(frames.c.number).limit(limit)).mappings()
    return [frame_row(frame) for frame in rows]


def _count(connection: Connection, row: MapRow, selection: FrameSelection, after: int) -> int:
    """Return the number of selected frames after frame number `after`."""
    if selection.filter is not None:
        return count_listed(connection, row.number, _in_order(selection), after)
    return len(_selected(connection, row, selection, after, MOST_SELECTED))


def _in_order(chosen: FrameSelection) -> Any:
    return None if chosen.filter is None else chosen.filter.model_copy(update={"order": "asc"})


def delete_session(
    store: Store, map_name: str, session: str, tombstones: Tombstones, robot: str | None = None,
    seconds: float = CALL_S,
) -> SessionChange:  # fmt: skip
    """Delete all frames of a session in blocks; return the numbers of deleted and remaining ones.

    Parameters
    ----------
    robot : robot of the frames; None selects all robots

    Raises
    ------
    UnknownMap, UnknownSession : If the map or the session does not exist.
    """
    done = delete_selection(store, map_name, _of_session(session, robot), tombstones, seconds)
    _require_frames(done.frames, map_name, session, robot)
    return SessionChange(session=session, robot=robot, **dict(done))


def edit_session(
    store: Store, map_name: str, session: str, edit: SessionEdit, robot: str | None = None,
    after: str | None = None, seconds: float = CALL_S,
) -> SessionChange:  # fmt: skip
    """Change the session name, the robot and the tags of the frames of a session in blocks.

    Renaming a session to an existing name merges the two. Poses and parent frames do not change.

    Parameters
    ----------
    after : id of the last frame that an earlier call processed; this call continues after it

    Returns
    -------
    change : new names, number of processed frames, and id of the last frame

    Raises
    ------
    UnknownMap, UnknownSession, UnknownFrame : If the map, the session or the frame does not exist.
    InvalidRequest : If a frame would get too many tags; earlier frames remain edited.
    """
    until, done, at = time.monotonic() + seconds, 0, after
    selection = _of_session(session, robot)
    while True:
        with store.database.write() as connection:
            row = find_map(connection, map_name)
            last = 0 if at is None else find_frame(connection, row, at).number
            block = _selected(connection, row, selection, last, AT_ONCE)
            for frame in block:
                write_frame(connection, row, frame, _values(frame, edit))
                at, last = frame.id, frame.number
            remaining = _count(connection, row, selection, last)
        done += len(block)
        if not remaining or time.monotonic() >= until:
            break
    if after is None:
        _require_frames(done, map_name, session, robot)
    return SessionChange(
        map=row.name, session=edit.session or session, robot=edit.robot or robot, frames=done,
        remaining=remaining, last_frame_id=at if remaining else None,
    )  # fmt: skip


def _values(frame: FrameRow, edit: SessionEdit) -> dict[str, object]:
    """Return the new values of the columns of a frame that an edit changes."""
    values: dict[str, object] = {}
    if edit.session is not None:
        values["session"] = edit.session
    if edit.robot is not None:
        values["robot"] = edit.robot
    if edit.add_tags or edit.remove_tags:
        values["tags"] = edited_tags(frame, edit)
    return values


def _of_session(session: str, robot: str | None) -> FrameSelection:
    """Return the selection of a session; do not validate names, since old names may be invalid."""
    robots = [] if robot is None else [robot]
    listing = FrameListing.model_construct(session=[session], robot=robots)
    return FrameSelection.model_construct(filter=listing)


def _require_frames(count: int, map_name: str, session: str, robot: str | None) -> None:
    if not count:
        by = "" if robot is None else f" by robot {robot!r:.140}"
        raise UnknownSession(
            f"Map {map_name!r} has no frame of session {session!r:.140}{by}. `sceneprint sessions "
            f"{map_name}` lists the sessions."
        )
