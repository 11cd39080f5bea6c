"""Deletion of frames and maps, and records of the blobs to remove.

A deletion that can be undone leaves tombstones (see `tombstones`): complete frames that are
excluded from searches, lists and counts. After the purge of a frame, a bare row remains for some
days, so that readers learn of the deletion from its revision. The same transaction records the
blobs as doomed, so that they are removed even if this process is killed.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from itertools import accumulate
from typing import Any

from sqlalchemy import (
    ColumnElement,
    Connection,
    Float,
    Select,
    and_,
    bindparam,
    delete,
    literal,
    literal_column,
    not_,
    or_,
    select,
    true,
    union,
    update,
)

from sceneprint.store.database import Database
from sceneprint.store.events import record_event, record_events, record_former_map
from sceneprint.store.maps import ROOMLESS, add_usage, map_usage, next_revision, require_room
from sceneprint.store.queue import cancel_jobs
from sceneprint.store.tables import (
    ENDED,
    FrameRow,
    MapRow,
    count_rows,
    dialect_insert,
    doomed,
    event_values,
    frame_tags,
    frames,
    job_files,
    job_items,
    jobs,
    map_row,
    maps,
    now,
    parent_joins,
    queries,
    signatures,
    surface_frames,
    surface_tiles,
    surface_touches,
    surfaces,
)
from sceneprint.store.tenants import save_turns
from sceneprint_client.api import FrameState, JobState

#: Columns that a purge clears: all metadata except the camera parameters.
_PURGED = (
    "reason", "robot", "session", "captured_at", "pose_parent", "pose", "pose_x", "pose_y",
    "pose_z", "sent_parent", "sent_pose", "base_frame", "base", "novelty", "up", "name",
    "sequence", "samples", "deletion", "deleted_from", "deleted_content",
)  # fmt: skip


def delete_frames(
    connection: Connection, row: MapRow, numbers: Sequence[int], reason: str | None = None,
    deletion: int | None = None,
) -> list[str]:  # fmt: skip
    """Remove frames from all searches, lists and counts; cancel their jobs, and record events.

    Parameters
    ----------
    connection : writing transaction
    numbers : up to a few hundred frame numbers; deleted frames are ignored
    reason : reason in the events, if no user requested the deletion
    deletion : number of the deletion for the tombstones; None purges the frames immediately.
        Redundant frames are always purged

    Returns
    -------
    blobs : doomed blobs, to be collected after the commit
    """
    c = frames.c
    existing = c.number.in_(numbers), c.state != FrameState.DELETED
    statement = select(c.number, c.id, c.state).where(*existing).order_by(c.number)
    rows = connection.execute(statement).all()
    if not rows:
        return []
    living = [frame.number for frame in rows]
    cancel_jobs(connection, jobs.c.frame_number.in_(living))
    redundant = [frame.number for frame in rows if frame.state == FrameState.REDUNDANT]
    add_usage(connection, row.number, len(redundant) - len(rows), 0)
    # one revision per frame, because readers continue after their last revision
    last = next_revision(connection, row.number, len(living))
    connection.execute(
        update(frames)
        .where(c.number == bindparam("of"))
        .values(
            state=FrameState.DELETED, revision=bindparam("at"), ended_at=now(connection),
            deletion=deletion, deleted_from=c.state, deleted_content=c.content_id, content_id=None,
        ),
        [{"of": n, "at": last - len(living) + i} for i, n in enumerate(living, 1)],
    )  # fmt: skip
    data = {} if reason is None else {"reason": reason}
    record_events(
        connection,
        [event_values("frame.deleted", row.name, frame.id, None, data) for frame in rows],
    )
    # purge redundant frames: without uploads, they cannot be restored
    return purge_frames(connection, row.number, living if deletion is None else redundant)


def purge_frames(connection: Connection, map_number: int, numbers: Sequence[int]) -> list[str]:
    """Remove the uploads, signatures and metadata of deleted frames.

    Returns
    -------
    blobs : doomed blobs, to be collected after the commit
    """
    if not numbers:
        return []
    c, own = frames.c, frames.c.number.in_(numbers)
    uploads = connection.execute(select(c.blob, c.bytes, c.deleted_from).where(own)).all()
    signed = signatures.c.frame_number.in_(numbers)
    artifacts = connection.execute(select(signatures.c.geometry).where(signed)).scalars()
    blobs = list(dict.fromkeys([*(upload.blob for upload in uploads), *artifacts]))
    doom(connection, blobs)
    connection.execute(delete(signatures).where(signed))
    connection.execute(delete(frame_tags).where(frame_tags.c.frame_number.in_(numbers)))
    connection.execute(update(frames).where(own).values(tags=[], **dict.fromkeys(_PURGED)))
    size = sum(upload.bytes for upload in uploads if upload.deleted_from != FrameState.REDUNDANT)
    add_usage(connection, map_number, 0, -size)
    return blobs


def without_content(frame: FrameRow) -> FrameRow:
    """Return a frame; if it is a tombstone, without the metadata that a purge clears."""
    if frame.deletion is None:
        return frame
    bare: dict[str, Any] = dict.fromkeys(_PURGED)
    return replace(frame, tags=[], **bare)


#: Maximum number of tombstones to purge in one transaction.
PURGED_AT_ONCE = 100


def oldest_tombstones(connection: Connection, map_number: int) -> list[tuple[int, int, float]]:
    """Return frame number, size in bytes and deletion time of the oldest tombstones of a map."""
    c = frames.c
    statement = select(c.number, c.bytes, c.ended_at).where(
        c.map_number == map_number, c.deletion.is_not(None)
    )
    rows = connection.execute(statement.order_by(c.deletion, c.number).limit(PURGED_AT_ONCE))
    return [(number, size, at) for number, size, at in rows]


def make_room(connection: Connection, row: MapRow, size: int, *, new: bool = True) -> list[str]:
    """Check the quota of a map; if its tombstones exceed it, purge the oldest of them.

    Parameters
    ----------
    connection : writing transaction of the map
    row, size, new : see `require_room`

    Returns
    -------
    blobs : doomed blobs, to be collected after the commit

    Raises
    ------
    QuotaExceeded : If the quota is exceeded even without tombstones; none is purged.
    """
    require_room(connection, row, size, new=new)
    blobs: list[str] = []
    while size > 0 and row.quota_bytes is not None:
        lacking = map_usage(connection, row.number).bytes + size - row.quota_bytes
        oldest = oldest_tombstones(connection, row.number)
        if lacking <= 0 or not oldest:
            break
        before = accumulate((held for _, held, _ in oldest), initial=0)
        numbers = [old[0] for old, freed in zip(oldest, before, strict=False) if freed < lacking]
        blobs += purge_frames(connection, row.number, numbers)
    return blobs


def remove_map(connection: Connection, row: MapRow) -> list[str]:
    """Remove a map and all its rows, doom its blobs, and record the deletion and the quotas.

    Returns
    -------
    blobs : blobs of the removed rows
    """
    own = select(frames.c.number).where(frames.c.map_number == row.number)
    own_jobs = select(jobs.c.number).where(jobs.c.map_number == row.number)
    statements = (
        select(frames.c.blob).where(frames.c.map_number == row.number),
        select(signatures.c.geometry).where(signatures.c.frame_number.in_(own)),
        select(job_files.c.blob).where(job_files.c.job_number.in_(own_jobs)),
        *(
            select(column).where(surface_tiles.c.map_number == row.number, column.is_not(None))
            for column in (surface_tiles.c.blob, surface_tiles.c.draft)
        ),
    )
    blobs = sorted({blob for query in statements for blob in connection.execute(query).scalars()})
    doom_selected(connection, *statements)
    connection.execute(delete(signatures).where(signatures.c.frame_number.in_(own)))
    tiles = select(surface_tiles.c.number).where(surface_tiles.c.map_number == row.number)
    connection.execute(delete(surface_touches).where(surface_touches.c.tile_number.in_(tiles)))
    for of_map in (surface_tiles, surface_frames, surfaces, parent_joins):
        connection.execute(delete(of_map).where(of_map.c.map_number == row.number))
    for table in (job_items, job_files):
        connection.execute(delete(table).where(table.c.job_number.in_(own_jobs)))
    save_turns(connection)
    connection.execute(delete(jobs).where(jobs.c.map_number == row.number))
    connection.execute(delete(frame_tags).where(frame_tags.c.frame_number.in_(own)))
    connection.execute(delete(frames).where(frames.c.map_number == row.number))
    connection.execute(delete(queries).where(queries.c.map_number == row.number))
    connection.execute(delete(maps).where(maps.c.number == row.number))
    record_event(connection, "map.deleted", row.name)
    record_former_map(connection, row)
    return blobs


#: Number of rows to remove in one commit (about 30 ms).
BLOCK = 500


def remove_in_blocks(
    database: Database, find: Callable[[Connection, int], Sequence[int]],
    remove: Callable[[Connection, Sequence[int]], None], most: int, block: int = BLOCK,
) -> int:  # fmt: skip
    """Remove rows in blocks of one commit each, so that other writers can write in between.

    Parameters
    ----------
    find : function that returns the numbers of rows to remove, up to a limit. It is called outside
        of write transactions, because it usually returns no numbers
    remove : function that removes the rows
    most : maximum number of rows; the last block may exceed it

    Returns
    -------
    count : number of removed rows
    """
    removed = 0
    while removed < most:
        with database.read() as connection:
            numbers = find(connection, block)
        if numbers:
            with database.write() as connection:
                remove(connection, numbers)
        removed += len(numbers)
        if len(numbers) < block:
            break
    return removed


def doom(connection: Connection, blobs: Iterable[str]) -> float:
    """Record up to a few thousand blobs as doomed, that is, to be removed if unreferenced.

    Existing records get the new time, so that an earlier writer does not clear them.

    Returns
    -------
    at : time of the records, seconds since 1970
    """
    at = time.time()
    # sort, to prevent deadlocks between writers of two maps that doom the same blobs
    if rows := [{"blob": blob, "at": at} for blob in sorted(set(blobs))]:
        connection.execute(_replace_time(dialect_insert(connection, doomed)), rows)
    return at


def _replace_time(new: Any) -> Any:
    return new.on_conflict_do_update(index_elements=["blob"], set_={"at": new.excluded.at})


def doom_selected(connection: Connection, *statements: Select[tuple[str]]) -> None:
    """Record as doomed all blobs that the statements select; see `doom`."""
    blobs = union(*statements).subquery()
    # WHERE is necessary: otherwise, SQLite would parse ON CONFLICT as the condition of a join
    rows = select(blobs.c[0], literal(time.time(), Float)).where(true())
    new = dialect_insert(connection, doomed).from_select(["blob", "at"], rows)
    connection.execute(_replace_time(new))


def doomed_blobs(
    connection: Connection, limit: int, before: float | None = None, after: str = ""
) -> list[str]:
    """Return up to `limit` doomed blobs after the digest `after`, sorted by digest.

    Parameters
    ----------
    before : return only blobs doomed before this time, seconds since 1970
    """
    statement = (
        select(doomed.c.blob).where(doomed.c.blob > after).order_by(doomed.c.blob).limit(limit)
    )
    if before is not None:
        statement = statement.where(doomed.c.at < before)
    return list(connection.execute(statement).scalars())


def clear_doomed(
    connection: Connection, blobs: Sequence[str], at: float | None = None,
    before: float | None = None,
) -> None:  # fmt: skip
    """Clear the records of doomed blobs that were removed, or are referenced again.

    Parameters
    ----------
    connection : writing transaction of all maps
    blobs : up to a few hundred blobs
    at : clear only records written at this time
    before : clear only records written before this time
    """
    if not blobs:
        return
    statement = delete(doomed).where(doomed.c.blob.in_(blobs))
    if at is not None:
        statement = statement.where(doomed.c.at == at)
    if before is not None:
        statement = statement.where(doomed.c.at < before)
    connection.execute(statement)


# Frames older than the retention period of their map.

#: Seconds of a day.
DAY_S = 86_400.0
#: Condition with a literal value: planners do not match bound values to a partial index.
_LIVING: ColumnElement[bool] = frames.c.state != literal_column("'deleted'")


def aging_maps(connection: Connection) -> list[MapRow]:
    """Return the maps with a retention period."""
    statement = select(maps).where(maps.c.retention_days.is_not(None)).order_by(maps.c.number)
    return [map_row(row) for row in connection.execute(statement).mappings()]


def old_frames(connection: Connection, map_number: int, before: float, limit: int) -> list[int]:
    """Return the numbers of the oldest frames of a map, up to `limit`, received before a time."""
    statement = (
        select(frames.c.number).where(_old(map_number, before)).order_by(frames.c.received_at)
    )
    return list(connection.execute(statement.limit(limit)).scalars())


def count_old_frames(connection: Connection, map_number: int, before: float) -> int:
    """Count the frames of a map that were received before a time."""
    return count_rows(connection, _old(map_number, before))


def _old(map_number: int, before: float) -> ColumnElement[bool]:
    return and_(frames.c.map_number == map_number, frames.c.received_at < before, _LIVING)


# Rows of frames that have been deleted or redundant for some days. Readers of signatures learn of
# deletions from these rows. The map stores the greatest revision of a removed row; readers at
# earlier revisions must restart.


def maps_with_ended(connection: Connection, before: float) -> list[MapRow]:
    """Return the maps with frames that were deleted or redundant before a time."""
    ended = (
        select(frames.c.number).where(_ended(maps.c.number, state, before)).exists()
        for state in ROOMLESS
    )
    return [map_row(row) for row in connection.execute(select(maps).where(or_(*ended))).mappings()]


def remove_ended(connection: Connection, map_number: int, before: float, limit: int) -> int:
    """Remove rows and jobs of frames deleted or redundant before a time; update `pruned_revision`.

    The rows of restorable frames, of frames in a surface, and of frames with an unfinished job
    remain.

    Parameters
    ----------
    connection : writing transaction of the map
    before : time, seconds since 1970
    limit : maximum number of frames of each state

    Returns
    -------
    count : number of removed frames
    """
    removed = 0
    for state in ROOMLESS:
        rows = connection.execute(
            select(frames.c.number, frames.c.revision)
            .where(_ended(map_number, state, before), *_unreferred())
            .order_by(frames.c.ended_at)
            .limit(limit)
        ).all()
        if rows:
            _remove_rows(connection, [row.number for row in rows])
            last = max(row.revision or 0 for row in rows)
            own = (maps.c.number == map_number) & (maps.c.pruned_revision < last)
            connection.execute(update(maps).where(own).values(pruned_revision=last))
        removed += len(rows)
    return removed


def newest_deletion(connection: Connection, map_number: int, before: float) -> int:
    """Return the revision of the last frame deleted before a time; 0 without such a frame."""
    statement = (
        select(frames.c.revision)
        .where(_ended(map_number, FrameState.DELETED, before))
        .order_by(frames.c.ended_at.desc())
        .limit(1)
    )
    return connection.execute(statement).scalar() or 0


def _ended(
    map_number: int | ColumnElement[int], state: FrameState, before: float
) -> ColumnElement[bool]:
    own = frames.c.state == literal_column(f"'{state}'")
    return and_(frames.c.map_number == map_number, own, ENDED, frames.c.ended_at < before)


def _unreferred() -> list[ColumnElement[bool]]:
    """Return the SQL conditions for rows of frames that are no longer needed."""
    unfinished = select(jobs.c.number).where(
        jobs.c.frame_number == frames.c.number,
        jobs.c.state.in_((JobState.QUEUED, JobState.RUNNING)),
    )
    shown = (
        select(table.c.frame_number).where(table.c.frame_number == frames.c.number)
        for table in (surface_frames, surface_touches)
    )
    return [frames.c.deletion.is_(None), *(not_(rows.exists()) for rows in (unfinished, *shown))]


def _remove_rows(connection: Connection, numbers: Sequence[int]) -> None:
    own_jobs = select(jobs.c.number).where(jobs.c.frame_number.in_(numbers))
    for part in (job_items, job_files):
        connection.execute(delete(part).where(part.c.job_number.in_(own_jobs)))
    save_turns(connection)
    for table in (jobs, frame_tags, signatures):
        connection.execute(delete(table).where(table.c.frame_number.in_(numbers)))
    connection.execute(delete(frames).where(frames.c.number.in_(numbers)))
