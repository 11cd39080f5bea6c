"""Tombstones: deleted frames that can be restored as they were.

delete_frames  -->  tombstones  --list_deletions-->  Deletion, ...
tombstones  --restore_frame-->  frames that queries find again at once
tombstones  --purge_frames-->  bare rows
"""

from __future__ import annotations

from dataclasses import dataclass

from sqlalchemy import ColumnElement, Connection, exists, func, select, update

from sceneprint.store.events import record_event
from sceneprint.store.maps import count_on, next_revision, require_room
from sceneprint.store.queue import enqueue
from sceneprint.store.tables import FrameRow, MapRow, frame_row, frames, now, signatures
from sceneprint_client.api import FrameState

#: States of frames that queries find, or will find.
_SEARCHED = (FrameState.INDEXED, FrameState.RECEIVED, FrameState.SIGNING)


@dataclass(frozen=True)
class Deletion:
    """Frames of a map that were deleted by one call, as far as they can be restored.

    Parameters
    ----------
    number : revision of the map at which it began
    at : when it began, seconds since 1970, by the clock of the database
    frames : how many can be restored
    """

    number: int
    at: float
    frames: int


def _restorable(
    connection: Connection, map_number: int, seconds: float
) -> list[ColumnElement[bool]]:
    """Conditions of the tombstones of a map that can be restored for so long."""
    c = frames.c
    return [
        c.map_number == map_number, c.deletion.is_not(None), c.deleted_from.is_not(None),
        c.ended_at > now(connection) - seconds,
    ]  # fmt: skip


def list_deletions(
    connection: Connection, map_number: int, seconds: float, limit: int, before: int | None = None
) -> list[Deletion]:
    """Return deletions of a map that can be undone, the newest first.

    Parameters
    ----------
    seconds : for which deleted frames can be restored
    limit : maximum number
    before : number of the deletion that the page before ended with
    """
    c = frames.c
    statement = select(c.deletion, func.min(c.ended_at), func.count()).where(
        *_restorable(connection, map_number, seconds)
    )
    if before is not None:
        statement = statement.where(c.deletion < before)
    found = statement.group_by(c.deletion).order_by(c.deletion.desc()).limit(limit)
    return [Deletion(*row) for row in connection.execute(found)]


def find_deletion(
    connection: Connection, map_number: int, seconds: float, number: int
) -> Deletion | None:
    """Return the deletion of a number if it can be undone; parameters as of `list_deletions`."""
    found = list_deletions(connection, map_number, seconds, 1, number + 1)
    return next((one for one in found if one.number == number), None)


def tombstones_of(
    connection: Connection, map_number: int, seconds: float, deletion: int, after: int, limit: int
) -> list[FrameRow]:
    """Return the tombstones of a deletion that can be restored, in the order they came.

    Parameters
    ----------
    connection, map_number, seconds, limit : see `list_deletions`
    deletion : number of the deletion
    after : number of the last frame before
    """
    statement = select(frames).where(
        *_restorable(connection, map_number, seconds), frames.c.deletion == deletion,
        frames.c.number > after,
    )  # fmt: skip
    found = connection.execute(statement.order_by(frames.c.number).limit(limit)).mappings()
    return [frame_row(one) for one in found]


def find_tombstone(
    connection: Connection, map_number: int, seconds: float, frame_id: str
) -> FrameRow | None:
    """Return the tombstone of an id if it can be restored; see `list_deletions`."""
    own = _restorable(connection, map_number, seconds)
    statement = select(frames).where(*own, frames.c.id == frame_id)
    row = connection.execute(statement).mappings().first()
    return None if row is None else frame_row(row)


def successor_of(connection: Connection, frame: FrameRow) -> str | None:
    """Return the id of a frame with the same content that came after a tombstone's deletion."""
    c = frames.c
    statement = select(c.id).where(
        c.map_number == frame.map_number, c.content_id == frame.deleted_content,
        c.received_at >= frame.ended_at, c.state != FrameState.DELETED,
    )  # fmt: skip
    return connection.execute(statement.limit(1)).scalar()


def restore_frame(connection: Connection, row: MapRow, frame: FrameRow) -> None:
    """Make a tombstone the frame that it was; it is signed only if its map has another model now.

    Parameters
    ----------
    connection : of a writing transaction of the map
    frame : a tombstone whose content has not come again

    Raises
    ------
    QuotaExceeded : the map may hold no more frames.
    """
    require_room(connection, row, 0)
    count_on(connection, row.number, 1, 0)
    values: dict[str, object] = {
        "state": frame.deleted_from, "content_id": frame.deleted_content, "ended_at": None,
        "deletion": None, "deleted_from": None, "deleted_content": None,
    }  # fmt: skip
    job = None
    if frame.deleted_from in _SEARCHED:
        signed = exists().where(
            signatures.c.frame_number == frame.number, signatures.c.model_id == row.model_id
        )
        if frame.deleted_from == FrameState.INDEXED and connection.execute(select(signed)).scalar():
            values["revision"] = next_revision(connection, row.number)
        else:
            job = enqueue(connection, "sign", frame.number)
            values |= {"state": FrameState.RECEIVED, "reason": None, "indexed_at": None}
            if frame.deleted_from == FrameState.INDEXED:
                values["novelty"] = None  # the map has accepted it before
    connection.execute(update(frames).where(frames.c.number == frame.number).values(**values))
    record_event(connection, "frame.restored", row.name, frame.id, None if job is None else job.id)
