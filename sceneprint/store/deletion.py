"""Frames and maps deleted: what is left in the database, and which blobs must be removed.

A deletion that can be undone makes tombstones: frames that no search, list or count finds, and that
keep their upload, signatures and metadata, see `tombstones`. Of a frame that is purged the row
stays for some days, as every reader learns by its revision that it is gone: its id, its state, when
it came, and how its samples were to be read. Its blobs are noted as doomed in the same transaction,
so that they are removed whatever happens to this process.
"""

from __future__ import annotations

import math
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
from sqlalchemy.dialects import postgresql, sqlite

from sceneprint.store.database import Database
from sceneprint.store.events import record_event, record_events, remember
from sceneprint.store.maps import ROOMLESS, count_on, next_revision, require_room, use_of
from sceneprint.store.queue import cancel_jobs
from sceneprint.store.tables import (
    ENDED,
    FrameRow,
    MapRow,
    count_rows,
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
from sceneprint.store.tenants import keep_turns
from sceneprint_client.api import FrameState, JobState

#: What is known of a frame, and not of its camera; cleared when it is purged.
_KNOWN = (
    "reason", "robot", "session", "captured_at", "pose_parent", "pose", "pose_x", "pose_y",
    "pose_z", "sent_parent", "sent_pose", "base_frame", "base", "novelty", "up", "name",
    "sequence", "samples", "deletion", "deleted_from", "deleted_content",
)  # fmt: skip


def delete_frames(
    connection: Connection, row: MapRow, numbers: Sequence[int], reason: str | None = None,
    deletion: int | None = None,
) -> list[str]:  # fmt: skip
    """Remove frames from all searches, lists and counts.

    Parameters
    ----------
    connection : of a writing transaction
    numbers : of its frames, a few hundred at most; those that are deleted already are left out
    reason : data of the events where nobody requested the deletion
    deletion : of the tombstones that are made; None: the frames are purged at once

    Returns
    -------
    blobs : that are doomed: sweep them when this is committed
    """
    wanted = frames.c.number.in_(numbers), frames.c.state != FrameState.DELETED
    c = frames.c
    asked = select(c.number, c.id, c.state).where(*wanted).order_by(c.number)
    found = connection.execute(asked).all()
    if not found:
        return []
    living = [one.number for one in found]
    cancel_jobs(connection, jobs.c.frame_number.in_(living))
    redundant = [one.number for one in found if one.state == FrameState.REDUNDANT]
    count_on(connection, row.number, len(redundant) - len(found), 0)
    # each its own revision: who reads what has changed reads on after the last that he had
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
        [event_values("frame.deleted", row.name, one.id, None, data) for one in found],
    )
    # a redundant frame has no upload that could be restored
    return purge_frames(connection, row.number, living if deletion is None else redundant)


def purge_frames(connection: Connection, map_number: int, numbers: Sequence[int]) -> list[str]:
    """Forget what was uploaded with deleted frames, made of them and known of them.

    Returns
    -------
    blobs : that are doomed: sweep them when this is committed
    """
    if not numbers:
        return []
    c, own = frames.c, frames.c.number.in_(numbers)
    uploads = connection.execute(select(c.blob, c.bytes, c.deleted_from).where(own)).all()
    signed = signatures.c.frame_number.in_(numbers)
    made = connection.execute(select(signatures.c.geometry).where(signed)).scalars()
    blobs = list(dict.fromkeys([*(one.blob for one in uploads), *made]))
    doom(connection, blobs)
    connection.execute(delete(signatures).where(signed))
    connection.execute(delete(frame_tags).where(frame_tags.c.frame_number.in_(numbers)))
    connection.execute(update(frames).where(own).values(tags=[], **dict.fromkeys(_KNOWN)))
    size = sum(one.bytes for one in uploads if one.deleted_from != FrameState.REDUNDANT)
    count_on(connection, map_number, 0, -size)
    return blobs


def without_content(frame: FrameRow) -> FrameRow:
    """Return a frame as it will be after its purge, if it is deleted."""
    if frame.deletion is None:
        return frame
    bare: dict[str, Any] = dict.fromkeys(_KNOWN)
    return replace(frame, tags=[], **bare)


#: Tombstones that are purged in one transaction.
PURGED_AT_ONCE = 100


def oldest_tombstones(
    connection: Connection, map_number: int, limit: int = PURGED_AT_ONCE
) -> list[tuple[int, int, float]]:
    """Return numbers, bytes and times of deletion of the tombstones of a map, the oldest first."""
    c = frames.c
    asked = select(c.number, c.bytes, c.ended_at).where(
        c.map_number == map_number, c.deletion.is_not(None)
    )
    found = connection.execute(asked.order_by(c.deletion, c.number).limit(limit))
    return [(number, size, at) for number, size, at in found]


def make_room(connection: Connection, row: MapRow, size: int, *, new: bool = True) -> list[str]:
    """Check that a quota leaves room, after purging the oldest tombstones where it lacks some.

    Parameters
    ----------
    connection : of a writing transaction of the map
    row, size, new : see `require_room`

    Returns
    -------
    blobs : that are doomed: sweep them when this is committed

    Raises
    ------
    QuotaExceeded : there is no room even without tombstones; none is purged.
    """
    require_room(connection, row, size, new=new)
    blobs: list[str] = []
    while size > 0 and row.quota_bytes is not None:
        lacking = use_of(connection, row.number).bytes + size - row.quota_bytes
        oldest = oldest_tombstones(connection, row.number)
        if lacking <= 0 or not oldest:
            break
        before = accumulate((held for _, held, _ in oldest), initial=0)
        numbers = [one[0] for one, freed in zip(oldest, before, strict=False) if freed < lacking]
        blobs += purge_frames(connection, row.number, numbers)
    return blobs


def remove_map(connection: Connection, row: MapRow) -> list[str]:
    """Remove a map with all that is in it.

    Returns
    -------
    blobs : that it referred to
    """
    own = select(frames.c.number).where(frames.c.map_number == row.number)
    own_jobs = select(jobs.c.number).where(jobs.c.map_number == row.number)
    asked = (
        select(frames.c.blob).where(frames.c.map_number == row.number),
        select(signatures.c.geometry).where(signatures.c.frame_number.in_(own)),
        select(job_files.c.blob).where(job_files.c.job_number.in_(own_jobs)),
        *(
            select(column).where(surface_tiles.c.map_number == row.number, column.is_not(None))
            for column in (surface_tiles.c.blob, surface_tiles.c.draft)
        ),
    )
    found = (blob for one in asked for blob in connection.execute(one).scalars())
    referred = sorted(set(found))
    doom_found(connection, *asked)
    connection.execute(delete(signatures).where(signatures.c.frame_number.in_(own)))
    tiles = select(surface_tiles.c.number).where(surface_tiles.c.map_number == row.number)
    connection.execute(delete(surface_touches).where(surface_touches.c.tile_number.in_(tiles)))
    for of_map in (surface_tiles, surface_frames, surfaces, parent_joins):
        connection.execute(delete(of_map).where(of_map.c.map_number == row.number))
    for made in (job_items, job_files):
        connection.execute(delete(made).where(made.c.job_number.in_(own_jobs)))
    keep_turns(connection)
    connection.execute(delete(jobs).where(jobs.c.map_number == row.number))
    connection.execute(delete(frame_tags).where(frame_tags.c.frame_number.in_(own)))
    connection.execute(delete(frames).where(frames.c.map_number == row.number))
    connection.execute(delete(queries).where(queries.c.map_number == row.number))
    connection.execute(delete(maps).where(maps.c.number == row.number))
    record_event(connection, "map.deleted", row.name)
    remember(connection, row)
    return referred


# Rows that nobody needs any more, however many.

#: Rows removed in one commit: other writers wait meanwhile, for some 30 ms.
BLOCK = 500


def remove_in_blocks(
    database: Database, find: Callable[[Connection, int], Sequence[int]],
    remove: Callable[[Connection, Sequence[int]], None], most: float = math.inf,
    block: int = BLOCK,
) -> int:  # fmt: skip
    """Remove rows, a block of them in each commit, so that other writers get their turns.

    Parameters
    ----------
    database : that has them
    find : numbers of rows that are to go, at most so many; without the lock, as most often there
        are none
    remove : removes them
    most : end when so many are removed
    block : rows in each commit

    Returns
    -------
    how many were removed
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
    """Note blobs that may have to be removed; a few thousand at most.

    What is noted already is noted anew: who did so before may `settle` it no more.

    Returns
    -------
    at : time of the notes, seconds since 1970
    """
    at = time.time()
    # in one order, as writers of two maps may doom the same ones at once
    if wanted := [{"blob": blob, "at": at} for blob in sorted(set(blobs))]:
        kind: Any = sqlite if connection.dialect.name == "sqlite" else postgresql
        made = kind.insert(doomed)
        noted = made.on_conflict_do_update(index_elements=["blob"], set_={"at": made.excluded.at})
        connection.execute(noted, wanted)
    return at


def doom_found(connection: Connection, *found: Select[tuple[str]]) -> None:
    """Note the blobs that some statements find, however many; see `doom`."""
    kind: Any = sqlite if connection.dialect.name == "sqlite" else postgresql
    blobs = union(*found).subquery()
    # SQLite takes ON CONFLICT for a join's ON where there is no WHERE
    noted = select(blobs.c[0], literal(time.time(), Float)).where(true())
    made = kind.insert(doomed).from_select(["blob", "at"], noted)
    connection.execute(
        made.on_conflict_do_update(index_elements=["blob"], set_={"at": made.excluded.at})
    )


def doomed_blobs(
    connection: Connection, limit: int, before: float | None = None, after: str = ""
) -> list[str]:
    """Noted blobs, at most so many after one of them; with a time, those noted before it."""
    asked = select(doomed.c.blob).where(doomed.c.blob > after).order_by(doomed.c.blob).limit(limit)
    if before is not None:
        asked = asked.where(doomed.c.at < before)
    return list(connection.execute(asked).scalars())


def settle(
    connection: Connection, blobs: Sequence[str], at: float | None = None,
    before: float | None = None,
) -> None:  # fmt: skip
    """Note no more that blobs are doomed: they are removed, or something refers to them.

    Parameters
    ----------
    connection : of a writing transaction of all maps
    blobs : a few hundred at most
    at : time of the notes; those of another one stay. None: all go
    before : those that are as young, or younger, stay as well
    """
    if not blobs:
        return
    which: list[ColumnElement[bool]] = [doomed.c.blob.in_(blobs)]
    which += [] if at is None else [doomed.c.at == at]
    which += [] if before is None else [doomed.c.at < before]
    connection.execute(delete(doomed).where(*which))


# Frames that are older than their map keeps them.

#: Seconds of a day.
DAY_S = 86_400.0
#: As the index says it: of a value that is bound to a statement no planner knows that it is this.
_LIVING: ColumnElement[bool] = frames.c.state != literal_column("'deleted'")


def aging_maps(connection: Connection) -> list[MapRow]:
    """Maps that keep their frames for some time only."""
    asked = select(maps).where(maps.c.retention_days.is_not(None)).order_by(maps.c.number)
    return [map_row(one) for one in connection.execute(asked).mappings()]


def old_frames(connection: Connection, map_number: int, before: float, limit: int) -> list[int]:
    """Numbers of frames of a map that were received before a time, the oldest first."""
    asked = select(frames.c.number).where(_old(map_number, before)).order_by(frames.c.received_at)
    return list(connection.execute(asked.limit(limit)).scalars())


def count_old(connection: Connection, map_number: int, before: float) -> int:
    """How many frames of a map were received before a time."""
    return count_rows(connection, _old(map_number, before))


def _old(map_number: int, before: float) -> ColumnElement[bool]:
    return and_(frames.c.map_number == map_number, frames.c.received_at < before, _LIVING)


# Rows of frames that ended some days ago.
#
# Whoever holds signatures of a map learns of deletions by these rows. The map keeps the greatest
# revision whose row is gone: who stands before it cannot be told any more, and begins anew.


def maps_with_ended(connection: Connection, before: float) -> list[MapRow]:
    """Return the maps that have frames which ended before a time."""
    spent = (
        select(frames.c.number).where(_ended(maps.c.number, state), _before(before)).exists()
        for state in ROOMLESS
    )
    return [map_row(one) for one in connection.execute(select(maps).where(or_(*spent))).mappings()]


def remove_ended(connection: Connection, map_number: int, before: float, limit: int) -> int:
    """Remove rows of frames of a map that ended before a time, with their jobs.

    Those stay that can be restored, that a surface shows, and whose job has not ended.

    Parameters
    ----------
    connection : of a writing transaction of the map
    before : seconds since 1970
    limit : at most so many of each state

    Returns
    -------
    how many were removed
    """
    removed = 0
    for state in ROOMLESS:
        asked = (
            select(frames.c.number, frames.c.revision)
            .where(_ended(map_number, state), _before(before), *_unreferred())
            .order_by(frames.c.ended_at)
            .limit(limit)
        )
        found = connection.execute(asked).all()
        if found:
            _remove_rows(connection, [one.number for one in found])
            last = max((one.revision or 0 for one in found), default=0)
            own = (maps.c.number == map_number) & (maps.c.pruned_revision < last)
            connection.execute(update(maps).where(own).values(pruned_revision=last))
        removed += len(found)
    return removed


def newest_deletion(connection: Connection, map_number: int, before: float) -> int:
    """Revision of the newest of the frames of a map that were deleted before a time; 0: of none."""
    asked = (
        select(frames.c.revision)
        .where(_ended(map_number, FrameState.DELETED), _before(before))
        .order_by(frames.c.ended_at.desc())
        .limit(1)
    )
    return connection.execute(asked).scalar() or 0


def _ended(of_map: int | ColumnElement[int], state: FrameState) -> ColumnElement[bool]:
    own = frames.c.state == literal_column(f"'{state}'")
    return and_(frames.c.map_number == of_map, own, ENDED)


def _before(at: float) -> ColumnElement[bool]:
    return frames.c.ended_at < at


def _unreferred() -> list[ColumnElement[bool]]:
    """That nothing needs the row of a frame any more."""
    unfinished = select(jobs.c.number).where(
        jobs.c.frame_number == frames.c.number,
        jobs.c.state.in_((JobState.QUEUED, JobState.RUNNING)),
    )
    shown = (
        select(table.c.frame_number).where(table.c.frame_number == frames.c.number)
        for table in (surface_frames, surface_touches)
    )
    return [frames.c.deletion.is_(None), *(not_(one.exists()) for one in (unfinished, *shown))]


def _remove_rows(connection: Connection, numbers: Sequence[int]) -> None:
    of_frames = select(jobs.c.number).where(jobs.c.frame_number.in_(numbers))
    for made in (job_items, job_files):
        connection.execute(delete(made).where(made.c.job_number.in_(of_frames)))
    keep_turns(connection)
    for table in (jobs, frame_tags, signatures):
        connection.execute(delete(table).where(table.c.frame_number.in_(numbers)))
    connection.execute(delete(frames).where(frames.c.number.in_(numbers)))
