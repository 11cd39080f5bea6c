"""Tombstones: deleted frames that can be restored unchanged.

delete_frames  -->  tombstones  --list_deletions-->  Deletion, ...
tombstones  --restore_frame-->  frames that queries find immediately
tombstones  --purge_frames-->  bare rows
"""

from __future__ import annotations

from dataclasses import dataclass

from sqlalchemy import ColumnElement, Connection, exists, func, select, update

from sceneprint.store.events import record_event
from sceneprint.store.maps import add_usage, next_revision, require_room
from sceneprint.store.queue import enqueue
from sceneprint.store.tables import FrameRow, MapRow, frame_row, frames, now, signatures
from sceneprint_client.api import FrameState

#: States of frames that are, or will be, searched.
_SEARCHED = (FrameState.INDEXED, FrameState.RECEIVED, FrameState.SIGNING)


@dataclass(frozen=True)
class Deletion:
    """The restorable frames of a map that one call deleted.

    Parameters
    ----------
    number : first revision of the deletion
    at : start of the deletion by the clock of the database, seconds since 1970
    """

    number: int
    at: float
    frames: int


def _restorable(
    connection: Connection, map_number: int, seconds: float
) -> list[ColumnElement[bool]]:
    """Return the SQL conditions for tombstones that are younger than `seconds`."""
    c = frames.c
    return [
        c.map_number == map_number, c.deletion.is_not(None), c.deleted_from.is_not(None),
        c.ended_at > now(connection) - seconds,
    ]  # fmt: skip


def list_deletions(
    connection: Connection, map_number: int, seconds: float, limit: int, before: int | None = None
) -> list[Deletion]:
    """Return the deletions of a map that can be undone, newest first.

    Parameters
    ----------
    seconds : time for which deleted frames can be restored
    limit : maximum number of deletions
    before : number of the last deletion of the previous page
    """
    c = frames.c
    statement = select(c.deletion, func.min(c.ended_at), func.count()).where(
        *_restorable(connection, map_number, seconds)
    )
    if before is not None:
        statement = statement.where(c.deletion < before)
    groups = statement.group_by(c.deletion).order_by(c.deletion.desc()).limit(limit)
    return [Deletion(*row) for row in connection.execute(groups)]


def find_deletion(
    connection: Connection, map_number: int, seconds: float, number: int
) -> Deletion | None:
    """Return a deletion by number; None if it cannot be undone. See `list_deletions`."""
    deletions = list_deletions(connection, map_number, seconds, 1, number + 1)
    return next((deletion for deletion in deletions if deletion.number == number), None)


def tombstones_of(
    connection: Connection, map_number: int, seconds: float, deletion: int, after: int, limit: int
) -> list[FrameRow]:
    """Return the restorable tombstones of a deletion, in upload order.

    Parameters
    ----------
    after : number of the last frame of the previous page
    """
    statement = select(frames).where(
        *_restorable(connection, map_number, seconds), frames.c.deletion == deletion,
        frames.c.number > after,
    )  # fmt: skip
    rows = connection.execute(statement.order_by(frames.c.number).limit(limit)).mappings()
    return [frame_row(row) for row in rows]


def find_tombstone(
    connection: Connection, map_number: int, seconds: float, frame_id: str
) -> FrameRow | None:
    """Return a tombstone by frame id; None if it cannot be restored. See `list_deletions`."""
    own = _restorable(connection, map_number, seconds)
    statement = select(frames).where(*own, frames.c.id == frame_id)
    row = connection.execute(statement).mappings().first()
    return None if row is None else frame_row(row)


def successor_of(connection: Connection, frame: FrameRow) -> str | None:
    """Return the id of a frame with the same content as a tombstone; None without one."""
    c = frames.c
    statement = select(c.id).where(
        c.map_number == frame.map_number, c.content_id == frame.deleted_content,
        c.received_at >= frame.ended_at, c.state != FrameState.DELETED,
    )  # fmt: skip
    return connection.execute(statement.limit(1)).scalar()


def restore_frame(connection: Connection, row: MapRow, frame: FrameRow) -> None:
    """Restore a tombstone, and record an event; queue a job if the map's model has not signed it.

    Parameters
    ----------
    connection : writing transaction of the map
    frame : tombstone whose content was not uploaded again

    Raises
    ------
    QuotaExceeded : If the quota of the map does not allow another frame.
    """
    require_room(connection, row, 0)
    add_usage(connection, row.number, 1, 0)
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
                values["novelty"] = None  # the frame was accepted earlier
    connection.execute(update(frames).where(frames.c.number == frame.number).values(**values))
    record_event(connection, "frame.restored", row.name, frame.id, None if job is None else job.id)
