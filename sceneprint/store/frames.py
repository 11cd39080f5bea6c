"""Frames and their signatures."""

from __future__ import annotations

import uuid
from collections.abc import Iterable, Mapping
from typing import Any

from sqlalchemy import (
    CTE,
    Column,
    ColumnElement,
    Connection,
    Insert,
    String,
    Table,
    cast,
    delete,
    exists,
    func,
    insert,
    literal,
    or_,
    select,
    update,
)
from sqlalchemy.sql.dml import ReturningUpdate
from sqlalchemy.types import TypeEngine

from sceneprint.errors import UnknownFrame
from sceneprint.store.deletion import delete_frames
from sceneprint.store.events import event_values, record_event
from sceneprint.store.maps import ROOMLESS, count_on, find_map
from sceneprint.store.queue import job_values, now
from sceneprint.store.surface_rows import FUSED_COLUMNS, note_edit
from sceneprint.store.tables import (
    TEXT,
    FrameRow,
    MapRow,
    deleted_frames,
    events,
    frame_row,
    frame_tags,
    frames,
    job_files,
    jobs,
    kept_answers,
    maps,
    rows_among,
    signatures,
    surface_tiles,
)
from sceneprint.store.undo_rows import Deletion
from sceneprint_client.api import FrameState

#: Frames of one content that are looked at: nobody needs more.
_MOST_ALIKE = 100


def add_frame(
    connection: Connection, map_number: int, values: dict[str, Any], frame_id: str | None = None
) -> FrameRow:
    """Insert a frame as received.

    Parameters
    ----------
    connection : of a writing transaction
    map_number : of its map
    values : its columns but number, id, state and times
    frame_id : its id, which no frame of the map has that is not deleted; default: a new one
    """
    if frame_id is None:
        frame_id = uuid.uuid4().hex
    else:
        _free(connection, map_number, frame_id)
    made = insert(frames).values(_received(connection, map_number, frame_id, values))
    row = frame_row(connection.execute(made.returning(frames)).mappings().one())
    count_on(connection, map_number, 1, values["bytes"])
    _write_tags(connection, row.number, row.tags)
    return row


def _received(
    connection: Connection, map_number: int, frame_id: str, values: dict[str, Any]
) -> dict[str, Any]:
    pose = values["pose"]
    place = {} if pose is None else {f"pose_{axis}": pose[i][3] for i, axis in enumerate("xyz")}
    state, at = FrameState.RECEIVED, now(connection)
    own = {"id": frame_id, "map_number": map_number, "state": state, "received_at": at}
    return {**own, **values, **place}


def receive_frame(
    connection: Connection, row: MapRow, values: dict[str, Any], priority: int
) -> tuple[str, str] | None:
    """Take a frame whose content its map lacks, and queue its signing: all that most uploads are.

    Others wait for this, so it is one statement on PostgreSQL, whose answer takes a round trip, and
    on SQLite, where nothing but inserting follows the first one, one for each table.

    Parameters
    ----------
    connection : of a writing transaction
    row : of the map, as it was when somebody looked
    values : see `add_frame`
    priority : of the job

    Returns
    -------
    ids : of the frame and of its job; None, and nothing was written, where the map is gone, has no
        room or has the content: `add_frame` and what is asked before it say which
    """
    frame_id, job = uuid.uuid4().hex, job_values(connection, "sign", priority)
    frame = _received(connection, row.number, frame_id, values)
    of_job = {**job, "map_number": row.number}
    told = event_values("frame.received", row.name, frame_id, job["id"], {})
    room, tags = _room_taken(row, values), sorted(set(values["tags"]))
    if connection.dialect.name == "sqlite":
        if connection.execute(room).first() is None:
            return None
        made = insert(frames).values(frame).returning(frames.c.number)
        number = connection.execute(made).scalar_one()
        _write_tags(connection, number, tags)
        connection.execute(insert(jobs).values(frame_number=number, **of_job))
        connection.execute(insert(events).values(told))
        return frame_id, job["id"]
    new = _inserted(frames, frame, room.cte("room")).returning(frames.c.number).cte("new")
    others = [_inserted(jobs, of_job, new, frame_number=new.c.number), _inserted(events, told, new)]
    others += [_inserted(frame_tags, {"tag": tag}, new, frame_number=new.c.number) for tag in tags]
    asked = select(new.c.number).add_cte(*(one.cte(f"other_{i}") for i, one in enumerate(others)))
    return None if connection.execute(asked).first() is None else (frame_id, job["id"])


def _room_taken(row: MapRow, values: dict[str, Any]) -> ReturningUpdate[tuple[int]]:
    """Count a frame more, if its map is that of `row` still, has room, and lacks the content."""
    alike = frames.c.map_number == row.number, frames.c.content_id == values["content_id"]
    size = values["bytes"]
    return (
        update(maps)
        .where(
            maps.c.number == row.number,
            maps.c.name == row.name,
            or_(maps.c.quota_frames.is_(None), maps.c.used_frames < maps.c.quota_frames),
            or_(maps.c.quota_bytes.is_(None), maps.c.used_bytes + size <= maps.c.quota_bytes),
            ~exists().where(*alike),
        )
        .values(used_frames=maps.c.used_frames + 1, used_bytes=maps.c.used_bytes + size)
        .returning(maps.c.number)
    )


def _inserted(
    table: Table, values: dict[str, Any], source: CTE, **more: ColumnElement[Any]
) -> Insert:
    """A row inserted for each of another statement's, PostgreSQL."""
    names = [*values, *more]
    given = [_typed(table.c[name], value) for name, value in values.items()]
    return insert(table).from_select(names, select(*given, *more.values()).select_from(source))


def _typed(column: Column[Any], value: Any) -> ColumnElement[Any]:
    """A value of a SELECT, whose columns have the types of the values, not of the table."""
    if isinstance(value, ColumnElement):
        return value
    # a cast to a length would cut off what the table refuses
    kind: TypeEngine[Any] = TEXT if isinstance(column.type, String) else column.type
    return cast(literal(value, column.type), kind)


def renew_frame(connection: Connection, number: int, values: dict[str, Any]) -> FrameRow:
    """Take a frame that failed as received once more, with its upload as it came now."""
    _weigh(connection, number, FrameState.RECEIVED, values["bytes"])
    connection.execute(
        update(frames)
        .where(frames.c.number == number)
        .values(state=FrameState.RECEIVED, reason=None, **values)
    )
    return frame_of(connection, number)


def renew_upload(
    connection: Connection, number: int, blob: str, size: int, reason: str | None
) -> None:
    """Let a frame refer to its content as it came once more; nothing else of it changes.

    Parameters
    ----------
    number : of the frame
    blob, size : of the upload
    reason : that is left of the frame's
    """
    _weigh(connection, number, None, size)
    connection.execute(
        update(frames).where(frames.c.number == number).values(blob=blob, bytes=size, reason=reason)
    )


def find_frame(connection: Connection, row: MapRow, frame_id: str) -> FrameRow:
    """The frame of an id in a map, deleted ones too.

    Raises
    ------
    UnknownFrame : there is none.
    """
    found = _first(connection, frames.c.map_number == row.number, frames.c.id == frame_id)
    if found is None:
        raise UnknownFrame(
            f"There is no frame {frame_id!r:.80} in map {row.name!r}. List them with "
            f"GET /v1/maps/{row.name}/frames."
        )
    return found


def frames_of_content(connection: Connection, map_number: int, content_id: str) -> list[FrameRow]:
    """Frames of a map with that content, as they came; more than one where they were PUT."""
    found = connection.execute(
        select(frames)
        .where(frames.c.map_number == map_number, frames.c.content_id == content_id)
        .order_by(frames.c.number)
        .limit(_MOST_ALIKE)
    ).mappings()
    return [frame_row(row) for row in found]


def living_frame(connection: Connection, map_number: int, frame_id: str) -> FrameRow | None:
    """The frame of an id in a map, or None where there is none that is not deleted."""
    there = frames.c.state != FrameState.DELETED
    return _first(connection, frames.c.map_number == map_number, frames.c.id == frame_id, there)


def frame_of(connection: Connection, number: int) -> FrameRow:
    """The frame of a number that is known to exist."""
    asked = select(frames).where(frames.c.number == number)
    return frame_row(connection.execute(asked).mappings().one())


def frames_of(connection: Connection, numbers: Iterable[int]) -> dict[int, FrameRow]:
    """Frames by their numbers; those that are gone are left out."""
    asked = select(frames).where(frames.c.state != FrameState.DELETED)
    found = rows_among(connection, asked, frames.c.number, numbers)
    return {row.number: frame_row(row._mapping) for row in found}


def set_state(
    connection: Connection, number: int, state: FrameState, reason: str | None = None
) -> None:
    """Move a frame to a state in which it is not searched; a deleted frame stays deleted."""
    if state == FrameState.REDUNDANT:
        _weigh(connection, number, state, None)
    connection.execute(
        update(frames)
        .where(frames.c.number == number, frames.c.state != FrameState.DELETED)
        .values(state=state, reason=reason)
    )


def delete_frame(
    connection: Connection, row: MapRow, frame: FrameRow, deletion: Deletion | None = None
) -> list[str]:
    """Take a frame out of all searches and forget what was made of it, and known of it.

    The row stays, so that every reader learns of it. `deletion`: see `delete_frames`.

    Returns
    -------
    blobs : that it referred to

    Raises
    ------
    UnknownFrame : it was deleted before.
    """
    if frame.state == FrameState.DELETED:
        raise UnknownFrame(f"Frame {frame.id} of map {row.name!r} was deleted before.")
    return delete_frames(connection, row, [frame.number], deletion=deletion)


def refers_to(connection: Connection, blob: str) -> bool:
    """Whether a frame that is there or can be restored, a signature, a job, a tile or a kept answer
    refers to a blob.
    """
    kept = frames.c.state.not_in(ROOMLESS)
    of_frame = select(frames.c.number).where(frames.c.blob == blob, kept)
    of_artifact = select(signatures.c.frame_number).where(signatures.c.geometry == blob)
    of_job = select(job_files.c.job_number).where(job_files.c.blob == blob)
    c = surface_tiles.c
    of_tile = select(c.number).where(c.blob == blob)
    of_draft = select(c.number).where(c.draft == blob)
    of_deleted = select(deleted_frames.c.frame_number).where(deleted_frames.c.blob == blob)
    of_answer = select(kept_answers.c.number).where(kept_answers.c.blob == blob)
    every = (of_frame, of_artifact, of_job, of_tile, of_draft, of_deleted, of_answer)
    return any(connection.execute(one.limit(1)).first() for one in every)


def count_states(connection: Connection, map_number: int | None = None) -> dict[str, int]:
    """How many frames are in each state that has any, of one map or of all."""
    asked = select(frames.c.state, func.count()).group_by(frames.c.state).order_by(frames.c.state)
    if map_number is not None:
        asked = asked.where(frames.c.map_number == map_number)
    return {row[0]: row[1] for row in connection.execute(asked)}


def _free(connection: Connection, map_number: int, frame_id: str) -> None:
    """Let a deleted frame give its id up: its row stays, as readers learn of it by its number."""
    deleted = frames.c.state == FrameState.DELETED
    own = update(frames).where(frames.c.map_number == map_number, frames.c.id == frame_id, deleted)
    connection.execute(own.values(id=uuid.uuid4().hex))


def _weigh(connection: Connection, number: int, state: FrameState | None, size: int | None) -> None:
    """Count what a frame takes from now on.

    Parameters
    ----------
    connection : of a writing transaction
    number : of the frame
    state : that it comes to; None: it stays as it is
    size : bytes of its upload; None: as they are
    """
    asked = select(frames.c.map_number, frames.c.state, frames.c.bytes)
    map_number, old, before = connection.execute(asked.where(frames.c.number == number)).one()
    if old == FrameState.DELETED:
        return  # and stays so
    was, is_now = old not in ROOMLESS, (state or old) not in ROOMLESS
    after = before if size is None else size
    count_on(connection, map_number, is_now - was, is_now * after - was * before)


def _first(connection: Connection, *conditions: ColumnElement[bool]) -> FrameRow | None:
    found = connection.execute(select(frames).where(*conditions)).mappings().first()
    return None if found is None else frame_row(found)


def _write_tags(connection: Connection, number: int, tags: Iterable[str]) -> None:
    named = [{"frame_number": number, "tag": tag} for tag in sorted(set(tags))]
    if named:
        connection.execute(insert(frame_tags), named)


# What a frame was uploaded on condition of: that its map lacks the place.


def loosen(connection: Connection, number: int, novelty: float | None) -> None:
    """Keep a frame that is not signed yet on the weaker of two conditions.

    Who sends it with a weaker one, or with none, is told that it is there.
    """
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


# Metadata written anew, with all that is searched for beside it.


def write_frame(
    connection: Connection, row: MapRow, frame: FrameRow, values: Mapping[str, Any]
) -> FrameRow:
    """Change columns of a frame's metadata.

    Parameters
    ----------
    connection : of a writing transaction
    row : of the map
    frame : as it is
    values : by column; position and tags that are searched for follow `pose` and `tags`
    """
    changed = {name: new for name, new in values.items() if getattr(frame, name) != new}
    if not changed:
        return frame
    written = dict(changed)
    if "pose" in changed:
        pose = changed["pose"]
        written |= {f"pose_{a}": pose and pose[i][3] for i, a in enumerate("xyz")}
    connection.execute(update(frames).where(frames.c.number == frame.number).values(**written))
    if "tags" in changed:
        connection.execute(delete(frame_tags).where(frame_tags.c.frame_number == frame.number))
        _write_tags(connection, frame.number, changed["tags"])
    if FUSED_COLUMNS & set(changed):
        note_edit(connection, frame.number, row.number)
    record_event(connection, "frame.edited", row.name, frame.id, fields=sorted(changed))
    return frame_of(connection, frame.number)


def write_map(connection: Connection, row: MapRow, values: Mapping[str, Any]) -> MapRow:
    """Change columns of a map: title, quotas, retention, up."""
    changed = {name: new for name, new in values.items() if getattr(row, name) != new}
    if not changed:
        return row
    connection.execute(update(maps).where(maps.c.number == row.number).values(**changed))
    # not what they are: who may read the map sees it there
    record_event(connection, "map.edited", row.name, fields=sorted(changed))
    return find_map(connection, row.name)
