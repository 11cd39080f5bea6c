"""Selected frames of a map, or a whole session, edited or deleted.

map, FrameSelection  --delete_selection-->  FramesDeleted
map, FramesEdit  --edit_selection-->  FramesEdited, with the edits that undo it
map, session  --delete_session | edit_session-->  SessionChange

Frames are written some at a time, each block in a transaction of its own, as writers wait
meanwhile. What is interrupted can be called again and goes on where it stopped; a call that is
repeated finds nothing left to do.
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
from sceneprint.store.frame_queries import TakenPosition, count_listed, list_frames
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
    store: Store, map_name: str, wanted: FrameSelection, tombstones: Tombstones,
    seconds: float = CALL_S,
) -> FramesDeleted:  # fmt: skip
    """Delete selected frames until none is left or the time is over.

    Parameters
    ----------
    wanted : which frames
    tombstones : that the frames become
    seconds : after which no further block is begun

    Raises
    ------
    UnknownMap : there is none.
    """
    until, deleted, last = time.monotonic() + seconds, 0, 0
    deletion: int | None = None
    while True:
        with store.database.write() as connection:
            row = find_map(connection, map_name)
            some = _selected(connection, row, wanted, last, AT_ONCE)
            deletion = deletion or tombstones.begin(row)
            numbers = [one.number for one in some]
            blobs = delete_frames(connection, row, numbers, deletion=deletion)
            last = numbers[-1] if numbers else last
            left = _count(connection, row, wanted, last)
            record = tombstones.find(connection, row, deletion)
        collect_deleted_blobs(store, blobs)
        deleted += len(some)
        if not left or time.monotonic() >= until:
            break
    return FramesDeleted(map=row.name, frames=deleted, remaining=left, deletion=record)


def edit_selection(
    store: Store, map_name: str, edit: FramesEdit, seconds: float = CALL_S
) -> FramesEdited:
    """Edit selected frames, 1000 of them at most, until none is left or the time is over.

    Parameters
    ----------
    store, map_name, seconds : see `delete_selection`
    edit : which frames, and what to change

    Raises
    ------
    UnknownMap, UnknownFrame : there is none; of the frame `after`.
    InvalidRequest : a frame would have more tags than it may have. The frames before it are
        changed.
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
            some = _selected(connection, row, edit, last, AT_ONCE)
            for frame in some:
                changed += _edit(connection, row, frame, edit, inverse)
                last, last_id = frame.number, frame.id
            left = _count(connection, row, edit, last)
        done += len(some)
        if not left or done >= MOST_SELECTED or time.monotonic() >= until:
            break
    return FramesEdited(
        map=row.name, frames=changed, remaining=left, last_frame_id=last_id if left else None,
        inverse=list(inverse.values()),
    )  # fmt: skip


def edited_tags(frame: FrameRow, edit: FramesEdit | SessionEdit) -> list[str]:
    """Return the tags of a frame after an edit; raise InvalidRequest if they are too many."""
    gone = set(edit.remove_tags)
    tags = [tag for tag in frame.tags if tag not in gone]
    tags += [tag for tag in dict.fromkeys(edit.add_tags) if tag not in tags]
    if len(tags) > MOST_TAGS:
        raise InvalidRequest(
            f"Frame {frame.id} would have {len(tags)} tags, and a frame has at most "
            f"{MOST_TAGS}. Remove some with `remove_tags`.",
            (("add_tags", "too many"),),
        )
    return tags


def _edit(
    connection: Connection, row: MapRow, frame: FrameRow, edit: FramesEdit,
    inverse: dict[str, dict[str, Any]],
) -> int:  # fmt: skip
    """Edit a frame, and add to what undoes it; 0 where it was so already."""
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
    connection: Connection, row: MapRow, wanted: FrameSelection, after: int, limit: int
) -> list[FrameRow]:
    """The next selected frames, in the order they came."""
    if wanted.filter is not None:
        beyond = TakenPosition(after, None, None)
        return list_frames(connection, row.number, beyond, limit, _in_order(wanted))
    asked = select(frames).where(
        frames.c.map_number == row.number, frames.c.id.in_(wanted.frame_ids or []),
        frames.c.state != FrameState.DELETED, frames.c.number > after,
    )  # fmt: skip
    found = connection.execute(asked.order_by(frames.c.number).limit(limit)).mappings()
    return [frame_row(one) for one in found]


def _count(connection: Connection, row: MapRow, wanted: FrameSelection, after: int) -> int:
    """How many selected frames come after one."""
    if wanted.filter is not None:
        return count_listed(connection, row.number, _in_order(wanted), after)
    return len(_selected(connection, row, wanted, after, MOST_SELECTED))


def _in_order(wanted: FrameSelection) -> Any:
    return None if wanted.filter is None else wanted.filter.model_copy(update={"order": "asc"})


# A session as a whole: renamed, tagged, or deleted with all its frames.


def delete_session(
    store: Store, map_name: str, session: str, tombstones: Tombstones, robot: str | None = None,
    seconds: float = CALL_S,
) -> SessionChange:  # fmt: skip
    """Delete frames of a session, in whatever state, until none is left or the time is over.

    Parameters
    ----------
    tombstones : that the frames become
    robot : only those that it took; None for those of all robots
    seconds : after which no further block is begun

    Raises
    ------
    UnknownMap, UnknownSession : there is none.
    """
    done = delete_selection(store, map_name, _of_session(session, robot), tombstones, seconds)
    _require_frames(done.frames, map_name, session, robot)
    return SessionChange(session=session, robot=robot, **dict(done))


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
    wanted = _of_session(session, robot)
    while True:
        with store.database.write() as connection:
            row = find_map(connection, map_name)
            last = 0 if at is None else find_frame(connection, row, at).number
            some = _selected(connection, row, wanted, last, AT_ONCE)
            for frame in some:
                write_frame(connection, row, frame, _values(frame, edit))
                at, last = frame.id, frame.number
            left = _count(connection, row, wanted, last)
        done += len(some)
        if not left or time.monotonic() >= until:
            break
    if after is None:
        _require_frames(done, map_name, session, robot)
    return SessionChange(
        map=row.name, session=edit.session or session, robot=edit.robot or robot, frames=done,
        remaining=left, last_frame_id=at if left else None,
    )  # fmt: skip


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


def _of_session(session: str, robot: str | None) -> FrameSelection:
    """Return the selection of a session, whose name no rule for new names applies to."""
    robots = [] if robot is None else [robot]
    wanted = FrameListing.model_construct(session=[session], robot=robots)
    return FrameSelection.model_construct(filter=wanted)


def _require_frames(count: int, map_name: str, session: str, robot: str | None) -> None:
    if not count:
        by = "" if robot is None else f" by robot {robot!r:.140}"
        raise UnknownSession(
            f"Map {map_name!r} has no frame of session {session!r:.140}{by}. "
            f"`sceneprint sessions {map_name}` lists them."
        )
