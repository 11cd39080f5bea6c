"""Maps, models and frames: insertion, lookup, quotas, and poses."""

from __future__ import annotations

import json
import time
import uuid
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Any

import numpy as np
from sqlalchemy import (
    ColumnElement,
    Connection,
    Integer,
    Select,
    bindparam,
    cast,
    func,
    insert,
    null,
    select,
    update,
)

from sceneprint.errors import QuotaExceeded, UnknownFrame, UnknownMap
from sceneprint.store.events import inherit_quota, record_event
from sceneprint.store.tables import (
    ARCHIVE,
    FRAME_COLUMNS,
    MAP_COLUMNS,
    TEXT,
    FrameRow,
    MapRow,
    among_numbers,
    frame_row,
    frame_rows,
    frame_tags,
    frames,
    job_files,
    jobs,
    map_row,
    maps,
    models,
    now,
    rows_of_statement,
    signatures,
)
from sceneprint.types import Floats
from sceneprint_client.api import FrameState


def find_map(connection: Connection, name: str) -> MapRow:
    """Return a map by name. Raise UnknownMap if it does not exist."""
    row = connection.execute(_map_of_name(), {"name": name}).first()
    if row is None:
        raise unknown_map(name)
    return MapRow(*row)


@cache
def _map_of_name() -> Select[Any]:
    return select(*MAP_COLUMNS).where(maps.c.name == bindparam("name"))


def current_map(connection: Connection, former: MapRow) -> MapRow:
    """Return the current row of a map. Raise UnknownMap if it was deleted or replaced."""
    row = find_map(connection, former.name)
    if row.number != former.number:
        raise unknown_map(former.name)
    return row


def find_maps(connection: Connection, names: Sequence[str]) -> list[MapRow]:
    """Return maps in the order of `names`. Raise UnknownMap if a map does not exist."""
    if len(names) == 1:
        return [find_map(connection, names[0])]
    selected = connection.execute(select(maps).where(maps.c.name.in_(names))).mappings()
    rows = {row["name"]: map_row(row) for row in selected}
    for name in names:
        if name not in rows:
            raise unknown_map(name)
    return [rows[name] for name in names]


def unknown_map(name: str) -> UnknownMap:
    """Return the error for a map that does not exist or is hidden from the caller."""
    return UnknownMap(
        f"There is no map {name!r:.80}. List the maps with `sceneprint maps` or GET /v1/maps, "
        "or create the map."
    )


def map_of_number(connection: Connection, number: int) -> MapRow:
    """Return an existing map by number."""
    return map_row(connection.execute(select(maps).where(maps.c.number == number)).mappings().one())


def list_maps(connection: Connection) -> list[MapRow]:
    """Return all maps, sorted by name."""
    return [
        map_row(row) for row in connection.execute(select(maps).order_by(maps.c.name)).mappings()
    ]


def add_map(
    connection: Connection, name: str, title: str | None, model_id: str,
    limits: Mapping[str, object] | None = None,
) -> MapRow:  # fmt: skip
    """Insert a map with an unused name, and record an event.

    Parameters
    ----------
    connection : writing transaction
    limits : values of `quota_frames`, `quota_bytes`, `retention_days` and `up`. Unset quotas are
        inherited from the former map of the same name, so that users who may delete and create maps
        cannot remove a quota
    """
    connection.execute(
        insert(maps).values(
            name=name, title=title, model_id=model_id, revision=0, created_at=time.time(),
            **(inherit_quota(connection, name) | dict(limits or {})),
        )
    )  # fmt: skip
    record_event(connection, "map.created", name)
    return find_map(connection, name)


def next_revision(connection: Connection, map_number: int, count: int = 1) -> int:
    """Reserve consecutive revisions of a map, and return the last revision.

    Each change to the searched frames has a revision. Revisions are in commit order.
    """
    own = update(maps).where(maps.c.number == map_number)
    raised = own.values(revision=maps.c.revision + count).returning(maps.c.revision)
    return int(connection.execute(raised).scalar_one())


def store_model(connection: Connection, model_id: str, name: str, content: bytes) -> None:
    """Store the file of a model unless it is already stored."""
    if connection.execute(select(models.c.id).where(models.c.id == model_id)).first() is None:
        connection.execute(
            insert(models).values(
                id=model_id, name=name[:64], content=content, created_at=time.time()
            )
        )


def model_content(connection: Connection, model_id: str) -> bytes:
    """Return the file of a stored model."""
    return bytes(
        connection.execute(select(models.c.content).where(models.c.id == model_id)).scalar_one()
    )


def model_names(connection: Connection) -> dict[str, str]:
    """Return the names of all models by id."""
    return {row.id: row.name for row in connection.execute(select(models.c.id, models.c.name))}


# Usage and quotas of a map. Frames count unless they are deleted or redundant. The bytes of uploads
# count, including those of tombstones, of pending signatures computed by robots, and of archives
# until their import ends. Signatures, artifacts and indexes of the service do not count. Two
# columns of the map store the sums. Writers update these columns during their turn, so quotas are
# exact.

#: States of frames that do not count, since they have no upload.
ROOMLESS = (FrameState.DELETED, FrameState.REDUNDANT)


@dataclass(frozen=True)
class MapUsage:
    """Number of frames and bytes that count against the quota of a map."""

    frames: int
    bytes: int


def map_usage(connection: Connection, map_number: int) -> MapUsage:
    """Return the stored usage of a map."""
    statement = select(maps.c.used_frames, maps.c.used_bytes).where(maps.c.number == map_number)
    return MapUsage(*connection.execute(statement).one())


def add_usage(connection: Connection, map_number: int, new_frames: int, new_bytes: int) -> None:
    """Add frames and bytes to the usage of a map; negative numbers subtract."""
    connection.execute(
        update(maps)
        .where(maps.c.number == map_number)
        .values(
            used_frames=maps.c.used_frames + new_frames, used_bytes=maps.c.used_bytes + new_bytes
        )
    )


def counted_usage(connection: Connection, map_number: int) -> MapUsage:
    """Compute the usage of a map from its frames, to verify `map_usage`."""
    statement = select(func.count(), func.coalesce(func.sum(frames.c.bytes), 0)).where(
        frames.c.map_number == map_number, frames.c.state.not_in(ROOMLESS)
    )
    n, size = connection.execute(statement).one()
    size += tombstone_bytes(connection, map_number)
    archives = (
        select(func.coalesce(func.sum(job_files.c.bytes), 0))
        .join(jobs, jobs.c.number == job_files.c.job_number)
        .where(job_files.c.name == ARCHIVE, jobs.c.map_number == map_number)
    )
    return MapUsage(int(n), int(size) + int(connection.execute(archives).scalar_one()))


def require_room(connection: Connection, row: MapRow, size: int, *, new: bool = True) -> None:
    """Check that the quota of a map allows another frame, or a larger upload of a frame.

    Tombstones do not count here, since `make_room` can purge them.

    Parameters
    ----------
    size : number of additional bytes
    new : whether the frame is additional, that is, not counted yet

    Raises
    ------
    QuotaExceeded : If the quota would be exceeded.
    """
    if row.quota_frames is None and row.quota_bytes is None:
        return
    hint = (
        "Delete frames that are no longer needed, or request a larger quota from the operator "
        f"(PATCH /v1/maps/{row.name})."
    )
    use = map_usage(connection, row.number)
    if new and row.quota_frames is not None and use.frames >= row.quota_frames:
        raise QuotaExceeded(
            f"Map {row.name!r} has {use.frames} frames, and its quota is {row.quota_frames}, so "
            f"the frame was not stored. {hint}"
        )
    if size <= 0 or row.quota_bytes is None or use.bytes + size <= row.quota_bytes:
        return
    held = use.bytes - tombstone_bytes(connection, row.number)
    if held + size > row.quota_bytes:
        raise QuotaExceeded(
            f"Map {row.name!r} has {held} bytes of uploads, and its quota is {row.quota_bytes}, so "
            f"{size} more bytes were not stored. {hint}"
        )


def tombstone_bytes(connection: Connection, map_number: int) -> int:
    """Return the total size, in bytes, of the uploads of a map's tombstones."""
    c = frames.c
    statement = select(func.coalesce(func.sum(c.bytes), 0)).where(
        c.map_number == map_number, c.deletion.is_not(None)
    )
    return int(connection.execute(statement).scalar_one())


def add_frame(
    connection: Connection, map_number: int, values: dict[str, Any], frame_id: str | None = None
) -> FrameRow:
    """Insert a frame in the state `received`, with its tags, and count it against the quota.

    Parameters
    ----------
    connection : writing transaction
    values : columns, except number, id, state and times
    frame_id : id that no existing frame has; default: a new id
    """
    if frame_id is None:
        frame_id = uuid.uuid4().hex
    else:
        replace_id(connection, map_number, frame_id)
    new = insert(frames).values(received_values(connection, map_number, frame_id, values))
    row = frame_row(connection.execute(new.returning(frames)).mappings().one())
    add_usage(connection, map_number, 1, values["bytes"])
    write_tags(connection, row.number, row.tags)
    return row


def received_values(
    connection: Connection, map_number: int, frame_id: str, values: dict[str, Any]
) -> dict[str, Any]:
    """Return the columns of a new frame; see `add_frame`."""
    state, at = FrameState.RECEIVED, now(connection)
    own = {"id": frame_id, "map_number": map_number, "state": state, "received_at": at}
    return {**own, **values, **position(values["pose"])}


def position(pose: Sequence[Sequence[float]] | None) -> dict[str, float | None]:
    """Return the columns pose_x, pose_y and pose_z of a pose (4, 4), metres; None without one."""
    return {f"pose_{axis}": None if pose is None else pose[i][3] for i, axis in enumerate("xyz")}


def find_frame(connection: Connection, row: MapRow, frame_id: str) -> FrameRow:
    """Return a frame of a map by id, even if it is deleted.

    Raises
    ------
    UnknownFrame : If the frame does not exist.
    """
    frame = _first(connection, frames.c.map_number == row.number, frames.c.id == frame_id)
    if frame is None:
        raise UnknownFrame(
            f"There is no frame {frame_id!r:.80} in map {row.name!r}. List the frames with "
            f"GET /v1/maps/{row.name}/frames."
        )
    return frame


def frames_of_content(connection: Connection, map_number: int, content_id: str) -> list[FrameRow]:
    """Return up to 100 frames of a map with the same content, in upload order."""
    rows = connection.execute(
        select(frames)
        .where(frames.c.map_number == map_number, frames.c.content_id == content_id)
        .order_by(frames.c.number)
        .limit(100)
    ).mappings()
    return [frame_row(row) for row in rows]


def living_frame(connection: Connection, map_number: int, frame_id: str) -> FrameRow | None:
    """Return a frame of a map by id; None if it does not exist or is deleted."""
    existing = frames.c.state != FrameState.DELETED
    return _first(connection, frames.c.map_number == map_number, frames.c.id == frame_id, existing)


def frame_of(connection: Connection, number: int) -> FrameRow:
    """Return an existing frame by number."""
    row = connection.execute(select(frames).where(frames.c.number == number)).mappings().one()
    return frame_row(row)


def frames_of(connection: Connection, numbers: Iterable[int]) -> dict[int, FrameRow]:
    """Return the frames with these numbers, except deleted frames, by number."""
    rows = rows_of_statement(connection, _frames_of_numbers, numbers)
    return {row.number: row for row in frame_rows(rows)}


@cache
def _frames_of_numbers(dialect: str) -> Select[Any]:
    among = among_numbers(dialect, frames.c.number)
    return select(*FRAME_COLUMNS).where(frames.c.state != FrameState.DELETED, among)


def replace_id(connection: Connection, map_number: int, frame_id: str) -> None:
    """Assign a new id to a deleted frame, so that its id can be reused.

    The frame can then no longer be restored.
    """
    deleted = frames.c.state == FrameState.DELETED
    own = update(frames).where(frames.c.map_number == map_number, frames.c.id == frame_id, deleted)
    connection.execute(own.values(id=uuid.uuid4().hex, deleted_from=None))


def _first(connection: Connection, *conditions: ColumnElement[bool]) -> FrameRow | None:
    row = connection.execute(select(frames).where(*conditions)).mappings().first()
    return None if row is None else frame_row(row)


def write_tags(connection: Connection, number: int, tags: Iterable[str]) -> None:
    """Insert the tags of a frame without tags."""
    if rows := [{"frame_number": number, "tag": tag} for tag in sorted(set(tags))]:
        connection.execute(insert(frame_tags), rows)


def geometry_blobs(connection: Connection, numbers: Iterable[int], model_id: str) -> dict[int, str]:
    """Return the digests of the geometry artifacts of frames by frame number."""
    rows = rows_of_statement(connection, _geometry_of_numbers, numbers, model_id=model_id)
    return {row.frame_number: row.geometry for row in rows}


@cache
def _geometry_of_numbers(dialect: str) -> Select[Any]:
    own = signatures.c.model_id == bindparam("model_id")
    among = among_numbers(dialect, signatures.c.frame_number)
    return select(signatures.c.frame_number, signatures.c.geometry).where(own, among)


# Frames by position. A query reads hundreds of poses, mostly those that the previous query read.
# Parsed poses are cached by their stored text, so entries (800 bytes each) are never stale.


@lru_cache(8192)
def _pose_of_text(text: str) -> Floats:
    """Parse T_parent_sensor (4, 4) from stored text; the array is shared and read-only."""
    pose = np.array(json.loads(text), np.float64)
    pose.flags.writeable = False
    return pose


@dataclass(frozen=True, eq=False)
class PlacedFrame:
    """A frame with a pose: number, T_parent_sensor (4, 4), artifact, kind, and tags."""

    number: int
    pose: Floats
    geometry: str
    is_cloud: bool
    tags: Sequence[str]


def placed_frames(
    connection: Connection, map_number: int, parent: str, model_id: str,
    centre: Sequence[float], within: float, most: int,
) -> list[PlacedFrame]:  # fmt: skip
    """Return indexed frames of a parent frame in a cube around a point, nearest first.

    Parameters
    ----------
    centre : x, y, z of the point, metres
    within : half the edge length of the cube, metres
    most : maximum number of frames
    """
    values: dict[str, object] = {
        "map_number": map_number, "parent": parent, "model_id": model_id, "most": most,
    }  # fmt: skip
    for axis, middle in zip("xyz", centre, strict=True):
        values |= {axis: middle, f"least_{axis}": middle - within, f"most_{axis}": middle + within}
    return [
        PlacedFrame(number, _pose_of_text(pose), geometry, is_cloud, tags)
        for number, pose, geometry, is_cloud, tags in connection.execute(_placed_frames(), values)
    ]


@cache
def _placed_frames() -> Select[Any]:
    c = frames.c
    columns = {"x": c.pose_x, "y": c.pose_y, "z": c.pose_z}
    x, y, z = (
        (column - bindparam(axis, type_=column.type)) * (column - bindparam(axis))
        for axis, column in columns.items()
    )
    return (
        select(c.number, cast(c.pose, TEXT), signatures.c.geometry, c.cloud.is_not(null()), c.tags)
        .join(signatures, signatures.c.frame_number == c.number)
        .where(
            c.map_number == bindparam("map_number"),
            c.pose_parent == bindparam("parent"),
            *(
                column.between(bindparam(f"least_{axis}"), bindparam(f"most_{axis}"))
                for axis, column in columns.items()
            ),
            c.state == FrameState.INDEXED,
            signatures.c.model_id == bindparam("model_id"),
        )
        .order_by(x + y + z, c.number)
        .limit(bindparam("most", type_=Integer()))
    )


@dataclass(frozen=True, eq=False)
class FrameViewpoint:
    """Viewpoint of a frame, with its pose T_parent_sensor (4, 4)."""

    number: int
    map_number: int
    pose_parent: str
    pose: Floats
    is_cloud: bool


def viewpoints_among(connection: Connection, numbers: Iterable[int]) -> list[FrameViewpoint]:
    """Return the viewpoints of the frames with these numbers, except frames without a pose."""
    return [
        FrameViewpoint(number, of_map, parent, _pose_of_text(pose), is_cloud)
        for number, of_map, parent, pose, is_cloud in rows_of_statement(
            connection, _viewpoints_of_numbers, numbers
        )
    ]


@cache
def _viewpoints_of_numbers(dialect: str) -> Select[Any]:
    c = frames.c
    return select(
        c.number, c.map_number, c.pose_parent, cast(c.pose, TEXT), c.cloud.is_not(null())
    ).where(c.state != FrameState.DELETED, c.pose_x.is_not(None), among_numbers(dialect, c.number))
