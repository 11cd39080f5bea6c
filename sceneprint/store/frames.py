"""Changes to existing frames and maps, and references to blobs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from sqlalchemy import (
    ColumnElement,
    Connection,
    delete,
    func,
    or_,
    select,
    union,
    update,
)

from sceneprint.errors import UnknownFrame
from sceneprint.store.deletion import delete_frames
from sceneprint.store.events import record_event
from sceneprint.store.maps import ROOMLESS, add_usage, find_map, frame_of, position, write_tags
from sceneprint.store.surface_rows import FUSED_COLUMNS, note_edit
from sceneprint.store.tables import (
    FrameRow,
    MapRow,
    frame_tags,
    frames,
    job_files,
    maps,
    now,
    signatures,
    surface_tiles,
)
from sceneprint_client.api import FrameState


def reset_frame(connection: Connection, number: int, values: dict[str, Any]) -> FrameRow:
    """Reset a failed frame to `received`, with new values such as its upload; return its row."""
    _update_usage(connection, number, FrameState.RECEIVED, values["bytes"])
    connection.execute(
        update(frames)
        .where(frames.c.number == number)
        .values(state=FrameState.RECEIVED, reason=None, ended_at=None, **values)
    )
    return frame_of(connection, number)


def renew_upload(
    connection: Connection, number: int, blob: str, size: int, reason: str | None
) -> None:
    """Replace the upload of a frame by another file with the same content.

    Parameters
    ----------
    blob, size : digest and size of the new upload
    reason : new reason of the state of the frame
    """
    _update_usage(connection, number, None, size)
    connection.execute(
        update(frames).where(frames.c.number == number).values(blob=blob, bytes=size, reason=reason)
    )


def set_state(
    connection: Connection, number: int, state: FrameState, reason: str | None = None
) -> None:
    """Set a state in which a frame is not searched; a deleted frame remains deleted."""
    ended_at = None
    if state == FrameState.REDUNDANT:
        _update_usage(connection, number, state, None)
        ended_at = now(connection)
    connection.execute(
        update(frames)
        .where(frames.c.number == number, frames.c.state != FrameState.DELETED)
        .values(state=state, reason=reason, ended_at=ended_at)
    )


def delete_frame(
    connection: Connection, row: MapRow, frame: FrameRow, deletion: int | None = None
) -> list[str]:
    """Delete a frame; see `delete_frames` for parameters and result.

    Raises
    ------
    UnknownFrame : If the frame is already deleted.
    """
    if frame.state == FrameState.DELETED:
        raise UnknownFrame(f"Frame {frame.id} of map {row.name!r} is already deleted.")
    return delete_frames(connection, row, [frame.number], deletion=deletion)


def not_purged() -> ColumnElement[bool]:
    """Return the SQL condition for frames that exist or that can be restored."""
    return or_(frames.c.state != FrameState.DELETED, frames.c.deletion.is_not(None))


def refers_to(connection: Connection, blob: str) -> bool:
    """Return whether a row refers to a blob; see `referred_blobs`."""
    return bool(referred_blobs(connection, [blob]))


def referred_blobs(connection: Connection, blobs: Sequence[str]) -> set[str]:
    """Return the referenced blobs among up to a thousand blobs."""
    has_upload = or_(frames.c.state.not_in(ROOMLESS), frames.c.deletion.is_not(None))
    referring = (
        (frames.c.blob, has_upload),
        (signatures.c.geometry,),
        (job_files.c.blob,),
        (surface_tiles.c.blob,),
        (surface_tiles.c.draft,),
    )
    parts = (select(column).where(column.in_(blobs), *more) for column, *more in referring)
    return set(connection.execute(union(*parts)).scalars())


def count_states(connection: Connection, map_number: int | None = None) -> dict[str, int]:
    """Count the frames of a map, or of all maps, by state."""
    counts = select(frames.c.state, func.count()).group_by(frames.c.state).order_by(frames.c.state)
    if map_number is not None:
        counts = counts.where(frames.c.map_number == map_number)
    return {row[0]: row[1] for row in connection.execute(counts)}


def count_states_by_map(connection: Connection) -> dict[int, dict[str, int]]:
    """Count the frames of each map that has any, by map number and state."""
    by = (frames.c.map_number, frames.c.state)
    counts: dict[int, dict[str, int]] = {}
    for number, state, n in connection.execute(
        select(*by, func.count()).group_by(*by).order_by(*by)
    ):
        counts.setdefault(number, {})[state] = n
    return counts


def _update_usage(
    connection: Connection, number: int, state: FrameState | None, size: int | None
) -> None:
    """Update the usage of a map before the state or the size of a frame changes.

    Parameters
    ----------
    connection : writing transaction
    state : new state; None if unchanged
    size : new size of the upload, bytes; None if unchanged
    """
    statement = select(frames.c.map_number, frames.c.state, frames.c.bytes)
    map_number, old, before = connection.execute(statement.where(frames.c.number == number)).one()
    if old == FrameState.DELETED:
        return
    was, is_now = old not in ROOMLESS, (state or old) not in ROOMLESS
    after = before if size is None else size
    add_usage(connection, map_number, is_now - was, is_now * after - was * before)


def relax_novelty(connection: Connection, number: int, novelty: float | None) -> None:
    """Lower the novelty threshold of an unsigned frame to `novelty`; None removes the threshold."""
    weaker: ColumnElement[bool] = frames.c.novelty.is_not(None)
    if novelty is not None:
        weaker = frames.c.novelty > novelty
    connection.execute(
        update(frames)
        .where(
            frames.c.number == number,
            frames.c.state.in_((FrameState.RECEIVED, FrameState.SIGNING)),
            weaker,
        )
        .values(novelty=novelty)
    )


def write_frame(
    connection: Connection, row: MapRow, frame: FrameRow, values: Mapping[str, Any]
) -> FrameRow:
    """Change metadata and tags of a frame; record an event and the edit; return the new row.

    If no value differs, nothing is written.

    Parameters
    ----------
    connection : writing transaction
    frame : current row
    """
    changed = {name: new for name, new in values.items() if getattr(frame, name) != new}
    if not changed:
        return frame
    written = dict(changed)
    if "pose" in changed:
        written |= position(changed["pose"])
    connection.execute(update(frames).where(frames.c.number == frame.number).values(**written))
    if "tags" in changed:
        connection.execute(delete(frame_tags).where(frame_tags.c.frame_number == frame.number))
        write_tags(connection, frame.number, changed["tags"])
    if FUSED_COLUMNS & set(changed):
        note_edit(connection, [frame.number], row.number)
    record_event(connection, "frame.edited", row.name, frame.id, fields=sorted(changed))
    return frame_of(connection, frame.number)


#: Columns of a map whose new values are written to the audit log.
_LIMITS = ("quota_frames", "quota_bytes", "retention_days")


def write_map(connection: Connection, row: MapRow, values: Mapping[str, Any]) -> MapRow:
    """Change values of a map, and record an event, unless all are equal; return the new row."""
    changed = {name: new for name, new in values.items() if getattr(row, name) != new}
    if not changed:
        return row
    connection.execute(update(maps).where(maps.c.number == row.number).values(**changed))
    limits = {name: changed[name] for name in _LIMITS if name in changed}
    record_event(connection, "map.edited", row.name, details=limits, fields=sorted(changed))
    return find_map(connection, row.name)
