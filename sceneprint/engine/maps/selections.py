"""Selected frames of a map, or a whole session, edited or deleted; and deleted frames restored.

map, FrameSelection  --delete_selection-->  FramesDeleted
map, FramesEdit  --edit_selection-->  FramesEdited, with the edits that undo it
map, session  --delete_session | edit_session-->  SessionChange
deletion id | frame ids  --restore-->  FramesRestored

Frames are written some at a time, each block in a transaction of its own, as writers wait
meanwhile. What is interrupted can be called again and goes on where it stopped; a call that is
repeated finds nothing left to do.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from typing import Any

from sqlalchemy import Connection, select

from sceneprint.engine.serializers import when
from sceneprint.engine.upkeep.garbage_collection import collect_deleted_blobs
from sceneprint.errors import (
    Conflict,
    InvalidRequest,
    QuotaExceeded,
    UnknownDeletion,
    UnknownFrame,
    UnknownSession,
)
from sceneprint.store import Store
from sceneprint.store.deletion import delete_frames, doom
from sceneprint.store.frame_queries import (
    TakenPosition,
    count_listed,
    count_session,
    list_frames,
    session_frames,
)
from sceneprint.store.frames import write_frame
from sceneprint.store.maps import find_frame, find_map, frame_of, use_of
from sceneprint.store.tables import FrameRow, MapRow, frame_row, frames
from sceneprint.store.undo_rows import (
    NO_UNDO,
    DeletedFrame,
    Deletion,
    UndoLimits,
    count_restorable,
    deletion_of_frame,
    find_deletion,
    forget_frames,
    frames_of_deletion,
    has_empty_deletions,
    list_deletions,
    remove_empty_deletions,
    restore_frame,
    restored_size,
    rival_of,
    spent_frames,
)
from sceneprint_client.api import FrameState, Page
from sceneprint_client.api.base import MOST_TAGS
from sceneprint_client.api.listing import (
    MOST_REFUSED,
    MOST_SELECTED,
    FrameDeletion,
    FramesDeleted,
    FramesEdit,
    FramesEdited,
    FrameSelection,
    FramesRestored,
    RefusedFrame,
    RestoreOptions,
    SessionChange,
    SessionEdit,
)

#: Frames written, restored or purged in one transaction: other writers wait for some 20 ms.
AT_ONCE = 100
#: Seconds after which a call ends with what is left.
CALL_S = 10.0


def delete_selection(
    store: Store, map_name: str, wanted: FrameSelection, undo: UndoLimits, seconds: float = CALL_S
) -> FramesDeleted:
    """Delete selected frames until none is left or the time is over.

    Parameters
    ----------
    store : see Store
    map_name : of the map
    wanted : which frames
    undo : for how long that can be undone
    seconds : after which no further block is begun

    Raises
    ------
    UnknownMap : there is none.
    """
    until, deleted = time.monotonic() + seconds, 0
    deletion: Deletion | None = None
    last = 0
    while True:
        with store.database.write() as connection:
            row = find_map(connection, map_name)
            some = _selected(connection, row, wanted, last, AT_ONCE)
            if some and deletion is None:
                deletion = undo.begin(connection, row.number)
            numbers = [one.number for one in some]
            blobs = delete_frames(connection, row, numbers, deletion=deletion)
            last = numbers[-1] if numbers else last
            left = _count(connection, row, wanted, last)
            kept = count_restorable(connection, deletion)
        collect_deleted_blobs(store, blobs)
        deleted += len(some)
        if not left or time.monotonic() >= until:
            break
    told = deletion_record(deletion, kept) if deletion is not None and kept else None
    return FramesDeleted(map=row.name, frames=deleted, remaining=left, deletion=told)


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
    """The tags of a frame after an edit.

    Raises
    ------
    InvalidRequest : they are too many.
    """
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


# Deleted frames restored, while their deletion can still be undone; afterwards they are purged.


def deletion_record(deletion: Deletion, frames: int) -> FrameDeletion:
    """A deletion as JSON tells it."""
    return FrameDeletion(
        deletion_id=deletion.id, at=when(deletion.at), until=when(deletion.until), frames=frames
    )


class FrameUndo:
    """Undoes deletions of frames.

    Parameters
    ----------
    store : see Store
    wake : called when frames wait to be signed
    """

    def __init__(self, store: Store, wake: Callable[[], None]) -> None:
        self._store, self._wake = store, wake

    def list_all(self, map_name: str, cursor: str | None, limit: int) -> Page[FrameDeletion]:
        """Deletions of a map that can be undone, the newest first.

        Raises
        ------
        UnknownMap : there is none.
        InvalidRequest : a cursor that was not given out.
        """
        before = self._store.seals.row("deletion", cursor)
        with self._store.database.read() as connection:
            row = find_map(connection, map_name)
            found = list_deletions(connection, row.number, before, limit + 1)
        more = self._store.seals.next_cursor("deletion", [d.number for d, _ in found], limit)
        told = [deletion_record(*one) for one in found[:limit]]
        return Page[FrameDeletion](items=told, next_cursor=more)

    def restore(
        self, map_name: str, wanted: RestoreOptions, seconds: float = CALL_S
    ) -> FramesRestored:
        """Put deleted frames back with all that was known of them.

        Parameters
        ----------
        map_name : of the map
        wanted : which frames
        seconds : after which no further block of a deletion is begun

        Raises
        ------
        UnknownMap, UnknownDeletion : there is none, or it cannot be undone any more.
        QuotaExceeded : the map has no room for them; of a deletion none was restored.
        """
        try:
            if wanted.deletion_id is not None:
                return self._restore_all(map_name, wanted.deletion_id, seconds)
            return self._restore_named(map_name, wanted.frame_ids or [])
        finally:
            self._wake()

    def restore_one(self, map_name: str, frame_id: str) -> None:
        """Put one deleted frame back.

        Raises
        ------
        UnknownMap, UnknownFrame : there is none, or it cannot be restored any more.
        Conflict : another frame has its id or its content.
        QuotaExceeded : the map has no room for it.
        """
        found = self._restore_named(map_name, [frame_id])
        self._wake()
        if not found.frames:
            refused = found.refused[0]
            if refused.reason == _GONE:
                raise UnknownFrame(
                    f"Frame {frame_id!r:.80} of map {map_name!r} {_GONE}. Upload it again."
                )
            raise Conflict(f"Frame {frame_id!r:.80} was not restored: {refused.reason}.")

    def _restore_all(self, map_name: str, deletion_id: str, seconds: float) -> FramesRestored:
        until, done, last = time.monotonic() + seconds, 0, 0
        refused: list[RefusedFrame] = []
        while True:
            with self._store.database.write() as connection:
                row = find_map(connection, map_name)
                deletion = find_deletion(connection, row.number, deletion_id)
                if deletion is None:
                    if not last:
                        raise _unknown_deletion(row, deletion_id)
                    left = []  # its time was over meanwhile
                else:
                    if not last:
                        _require_room(connection, row, deletion)
                    some = frames_of_deletion(connection, deletion, last, AT_ONCE)
                    for one in some:
                        done += _restored(connection, row, deletion, one, refused)
                        last = one.frame_number
                    left = frames_of_deletion(connection, deletion, last, _COUNTED)
                remove_empty_deletions(connection)
            if not left or time.monotonic() >= until:
                break
        return FramesRestored(
            map=row.name, frames=done, refused=refused[:MOST_REFUSED], remaining=len(left)
        )

    def _restore_named(self, map_name: str, frame_ids: list[str]) -> FramesRestored:
        names, done = list(dict.fromkeys(frame_ids)), 0
        refused: list[RefusedFrame] = []
        for at in range(0, len(names), AT_ONCE):
            with self._store.database.write() as connection:
                row = find_map(connection, map_name)
                for name in names[at : at + AT_ONCE]:
                    found = deletion_of_frame(connection, row.number, name)
                    if found is None:
                        refused.append(RefusedFrame(frame_id=name, reason=_GONE))
                    else:
                        done += _restored(connection, row, *found, refused)
                remove_empty_deletions(connection)
        return FramesRestored(
            map=row.name, frames=done, refused=refused[:MOST_REFUSED], remaining=0
        )

    def purge(self, *, everything: bool = False) -> int:
        """Delete for good what can no longer be restored; with `everything`, all that could be.

        Returns
        -------
        how many frames
        """
        purged = 0
        while True:
            with self._store.database.read() as connection:  # most often there is none: no lock
                if not spent_frames(connection, 1, all_of_them=everything):
                    break
            with self._store.database.write() as connection:
                numbers = spent_frames(connection, AT_ONCE, all_of_them=everything)
                blobs = forget_frames(connection, numbers)
                doom(connection, blobs)
                remove_empty_deletions(connection)
            collect_deleted_blobs(self._store, blobs)
            purged += len(numbers)
        with self._store.database.read() as connection:
            has_empty = has_empty_deletions(connection)
        if has_empty:  # all that it had was too large to be kept, or its map had no room for more
            with self._store.database.write() as connection:
                remove_empty_deletions(connection)
        return purged


#: Frames that are counted of those that are left; of more, as many are told.
_COUNTED = 10_000
_GONE = "was not deleted, or cannot be restored any more"


def _restored(
    connection: Connection, row: MapRow, deletion: Deletion, one: DeletedFrame,
    refused: list[RefusedFrame],
) -> int:  # fmt: skip
    """Restore a frame, or note why not; how many were."""
    reason = rival_of(connection, deletion, one)
    if reason is not None:
        refused.append(RefusedFrame(frame_id=one.data["id"], reason=reason))
        return 0
    restore_frame(connection, row, one)
    return 1


def _require_room(connection: Connection, row: MapRow, deletion: Deletion) -> None:
    """See that a map's quota leaves room for all frames of a deletion."""
    count, size = restored_size(connection, deletion)
    use = use_of(connection, row.number)
    over_frames = row.quota_frames is not None and use.frames + count > row.quota_frames
    over_bytes = row.quota_bytes is not None and use.bytes + size > row.quota_bytes
    if over_frames or over_bytes:
        raise QuotaExceeded(
            f"The deletion has {count} frames of {size} bytes, for which the quota of map "
            f"{row.name!r} leaves no room, so none was restored. Restore some of them with "
            "`frame_ids`, or ask the operator for a larger quota."
        )


def _unknown_deletion(row: MapRow, deletion_id: str) -> UnknownDeletion:
    return UnknownDeletion(
        f"Map {row.name!r} has no deletion {deletion_id!r:.80} that can be undone: it never "
        "existed, or its time is over, or all its frames were restored. "
        f"GET /v1/maps/{row.name}/deletions lists those that can be."
    )


# A session as a whole: renamed, tagged, or deleted with all its frames.


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
