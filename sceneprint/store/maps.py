"""Maps, the models they are signed with, and their frames: received, and found."""

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
from sceneprint.store.events import inherited, record_event
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
    """The map of a name.

    Raises
    ------
    UnknownMap : there is none.
    """
    row = connection.execute(_map_of_name(), {"name": name}).first()
    if row is None:
        raise unknown_map(name)
    return MapRow(*row)


@cache
def _map_of_name() -> Select[Any]:
    return select(*MAP_COLUMNS).where(maps.c.name == bindparam("name"))


def living_map(connection: Connection, of: MapRow) -> MapRow:
    """A map as it is now; UnknownMap where it was deleted, whether or not another has its name."""
    row = find_map(connection, of.name)
    if row.number != of.number:
        raise unknown_map(of.name)
    return row


def find_maps(connection: Connection, names: Sequence[str]) -> list[MapRow]:
    """The maps of some names, in their order, by one statement; UnknownMap where one is none."""
    if len(names) == 1:
        return [find_map(connection, names[0])]
    found = connection.execute(select(maps).where(maps.c.name.in_(names))).mappings()
    rows = {row["name"]: map_row(row) for row in found}
    for name in names:
        if name not in rows:
            raise unknown_map(name)
    return [rows[name] for name in names]


def unknown_map(name: str) -> UnknownMap:
    """What is said of a map that is not there, or not for whoever asks: the same words."""
    return UnknownMap(
        f"There is no map {name!r:.80}. List the maps with `sceneprint maps` or GET /v1/maps, "
        "or make it."
    )


def map_of(connection: Connection, number: int) -> MapRow:
    """The map of a number that is known to exist."""
    return map_row(connection.execute(select(maps).where(maps.c.number == number)).mappings().one())


def list_maps(connection: Connection) -> list[MapRow]:
    """All maps by name."""
    return [
        map_row(row) for row in connection.execute(select(maps).order_by(maps.c.name)).mappings()
    ]


def add_map(
    connection: Connection, name: str, title: str | None, model_id: str,
    limits: Mapping[str, object] | None = None,
) -> MapRow:  # fmt: skip
    """Make a map; its name must be free.

    Parameters
    ----------
    connection : of a writing transaction
    limits : `quota_frames`, `quota_bytes`, `retention_days`, `up`, where they are given; quotas
        that are not are those of the map that had this name before: whoever may delete a map and
        make it anew does not get rid of its quota
    """
    connection.execute(
        insert(maps).values(
            name=name, title=title, model_id=model_id, revision=0, created_at=time.time(),
            **(inherited(connection, name) | dict(limits or {})),
        )
    )  # fmt: skip
    record_event(connection, "map.created", name)
    return find_map(connection, name)


def next_revision(connection: Connection, map_number: int, count: int = 1) -> int:
    """The last of so many revisions of a map that are taken at once.

    One is a change of what is searched; commits of one map follow each other in this order.
    """
    taken = update(maps).where(maps.c.number == map_number)
    raised = taken.values(revision=maps.c.revision + count).returning(maps.c.revision)
    return int(connection.execute(raised).scalar_one())


def keep_model(connection: Connection, model_id: str, name: str, content: bytes) -> None:
    """Keep a model's file, where it is not kept yet."""
    if connection.execute(select(models.c.id).where(models.c.id == model_id)).first() is None:
        connection.execute(
            insert(models).values(
                id=model_id, name=name[:64], content=content, created_at=time.time()
            )
        )


def model_content(connection: Connection, model_id: str) -> bytes:
    """The file of a model that a map refers to."""
    return bytes(
        connection.execute(select(models.c.content).where(models.c.id == model_id)).scalar_one()
    )


def model_names(connection: Connection) -> dict[str, str]:
    """Names of all models by their id."""
    return {row.id: row.name for row in connection.execute(select(models.c.id, models.c.name))}


# What a map holds and may hold: frames, and bytes of their uploads.
#
# Counted are frames that are neither deleted nor redundant, whatever became of them, and bytes:
# their uploads and those of tombstones as they were sent, with what robots made of them while that
# waits, and the archives of imports until these end. Not counted is what we make of them:
# signatures, artifacts, indexes.
# Two columns of the map count on in the transaction that changes it; writers take turns, so that a
# quota holds to the frame whoever sends at once.

#: States of frames that take no room: their uploads are removed.
ROOMLESS = (FrameState.DELETED, FrameState.REDUNDANT)


@dataclass(frozen=True)
class MapUsage:
    """How much of a map is in use."""

    frames: int
    bytes: int


def use_of(connection: Connection, map_number: int) -> MapUsage:
    """What a map holds, as it was counted on."""
    asked = select(maps.c.used_frames, maps.c.used_bytes).where(maps.c.number == map_number)
    return MapUsage(*connection.execute(asked).one())


def count_on(connection: Connection, map_number: int, more: int, more_bytes: int) -> None:
    """Count that a map holds so many frames and bytes more, or less."""
    connection.execute(
        update(maps)
        .where(maps.c.number == map_number)
        .values(used_frames=maps.c.used_frames + more, used_bytes=maps.c.used_bytes + more_bytes)
    )


def counted_usage(connection: Connection, map_number: int) -> MapUsage:
    """What a map holds, counted over all its frames: what `use_of` must say."""
    asked = select(func.count(), func.coalesce(func.sum(frames.c.bytes), 0)).where(
        frames.c.map_number == map_number, frames.c.state.not_in(ROOMLESS)
    )
    n, size = connection.execute(asked).one()
    size += tombstone_bytes(connection, map_number)
    archives = (
        select(func.coalesce(func.sum(job_files.c.bytes), 0))
        .join(jobs, jobs.c.number == job_files.c.job_number)
        .where(job_files.c.name == ARCHIVE, jobs.c.map_number == map_number)
    )
    return MapUsage(int(n), int(size) + int(connection.execute(archives).scalar_one()))


def require_room(connection: Connection, row: MapRow, size: int, *, new: bool = True) -> None:
    """Check that a map's quota leaves room for one more frame, or for a larger upload of one.

    Tombstones count as free: `make_room` purges as many as it takes.

    Parameters
    ----------
    connection : of the transaction that would add it, or of a reading one for a first look
    size : bytes that it takes more
    new : whether the frame is not counted yet

    Raises
    ------
    QuotaExceeded : it does not.
    """
    if row.quota_frames is None and row.quota_bytes is None:
        return
    use = use_of(connection, row.number)
    if new and row.quota_frames is not None and use.frames >= row.quota_frames:
        raise QuotaExceeded(
            f"Map {row.name!r} holds {use.frames} frames of the {row.quota_frames} that its quota "
            f"allows, so the frame was not taken. {_todo(row.name)}"
        )
    if size <= 0 or row.quota_bytes is None or use.bytes + size <= row.quota_bytes:
        return
    held = use.bytes - tombstone_bytes(connection, row.number)  # these are purged for others
    if held + size > row.quota_bytes:
        raise QuotaExceeded(
            f"Map {row.name!r} holds {held} bytes of uploads of the {row.quota_bytes} that its "
            f"quota allows, so {size} bytes more were not stored. {_todo(row.name)}"
        )


def tombstone_bytes(connection: Connection, map_number: int) -> int:
    """Return the bytes of uploads of the deleted frames that can be restored."""
    c = frames.c
    asked = select(func.coalesce(func.sum(c.bytes), 0)).where(
        c.map_number == map_number, c.deletion.is_not(None)
    )
    return int(connection.execute(asked).scalar_one())


def _todo(name: str) -> str:
    return (
        "Delete frames that are not needed any more, or ask the operator for a larger quota "
        f"(PATCH /v1/maps/{name})."
    )


# Frames of a map.

#: Frames of one content that are looked at: nobody needs more.
_MOST_ALIKE = 100


def add_frame(
    connection: Connection, map_number: int, values: dict[str, Any], frame_id: str | None = None
) -> FrameRow:
    """Insert a frame as received.

    Parameters
    ----------
    connection : of a writing transaction
    values : its columns but number, id, state and times
    frame_id : its id, which no frame of the map has that is not deleted; default: a new one
    """
    if frame_id is None:
        frame_id = uuid.uuid4().hex
    else:
        free_id(connection, map_number, frame_id)
    made = insert(frames).values(received_values(connection, map_number, frame_id, values))
    row = frame_row(connection.execute(made.returning(frames)).mappings().one())
    count_on(connection, map_number, 1, values["bytes"])
    write_tags(connection, row.number, row.tags)
    return row


def received_values(
    connection: Connection, map_number: int, frame_id: str, values: dict[str, Any]
) -> dict[str, Any]:
    """Columns of a frame that is received now; see `add_frame`."""
    state, at = FrameState.RECEIVED, now(connection)
    own = {"id": frame_id, "map_number": map_number, "state": state, "received_at": at}
    return {**own, **values, **position(values["pose"])}


def position(pose: Sequence[Sequence[float]] | None) -> dict[str, float | None]:
    """Columns of a frame's position, to be searched for."""
    return {f"pose_{axis}": None if pose is None else pose[i][3] for i, axis in enumerate("xyz")}


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
    found = rows_of_statement(connection, _frames_of_numbers, numbers)
    return {row.number: row for row in frame_rows(found)}


@cache
def _frames_of_numbers(dialect: str) -> Select[Any]:
    among = among_numbers(dialect, frames.c.number)
    return select(*FRAME_COLUMNS).where(frames.c.state != FrameState.DELETED, among)


def free_id(connection: Connection, map_number: int, frame_id: str) -> None:
    """Let a deleted frame give its id up: its row stays, as readers learn of it by its number.

    A tombstone without its id can no longer be restored.
    """
    deleted = frames.c.state == FrameState.DELETED
    own = update(frames).where(frames.c.map_number == map_number, frames.c.id == frame_id, deleted)
    connection.execute(own.values(id=uuid.uuid4().hex, deleted_from=None))


def _first(connection: Connection, *conditions: ColumnElement[bool]) -> FrameRow | None:
    found = connection.execute(select(frames).where(*conditions)).mappings().first()
    return None if found is None else frame_row(found)


def write_tags(connection: Connection, number: int, tags: Iterable[str]) -> None:
    """Write the tags of a frame that has none yet."""
    named = [{"frame_number": number, "tag": tag} for tag in sorted(set(tags))]
    if named:
        connection.execute(insert(frame_tags), named)


def geometry_blobs(connection: Connection, numbers: Iterable[int], model_id: str) -> dict[int, str]:
    """Blobs of the geometry artifacts of frames."""
    found = rows_of_statement(connection, _geometry_of_numbers, numbers, model_id=model_id)
    return {row.frame_number: row.geometry for row in found}


@cache
def _geometry_of_numbers(dialect: str) -> Select[Any]:
    own = signatures.c.model_id == bindparam("model_id")
    among = among_numbers(dialect, signatures.c.frame_number)
    return select(signatures.c.frame_number, signatures.c.geometry).where(own, among)


# Frames by where they were taken: for whoever compares poses in a map.
#
# A query reads hundreds of poses, mostly those that the query before it has read. They are kept by
# the text they are stored as, which tells all of a pose: nothing has to say that one has changed.

#: Poses that are kept, about 800 bytes each.
_POSES = 8192


@lru_cache(_POSES)
def _pose_of_text(text: str) -> Floats:
    """T_parent_sensor (4, 4) as it is stored; everybody gets the same one, which is read-only."""
    pose = np.array(json.loads(text), np.float64)
    pose.flags.writeable = False
    return pose


@dataclass(frozen=True, eq=False)
class PlacedFrame:
    """Number, T_parent_sensor (4, 4), geometry, kind (point cloud?) and tags of a posed frame."""

    number: int
    pose: Floats
    geometry: str
    is_cloud: bool
    tags: Sequence[str]


def placed_frames(
    connection: Connection, map_number: int, parent: str, model_id: str,
    centre: Sequence[float], within: float, most: int,
) -> list[PlacedFrame]:  # fmt: skip
    """Indexed frames of a parent frame taken near a point, the nearest first.

    Parameters
    ----------
    map_number, parent : whose frames
    centre : x, y, z of the point, metres
    within : half the width of the cube that they are in, metres
    most : of them
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
    """Where a frame was taken, with its pose T_parent_sensor (4, 4); fields as in the table."""

    number: int
    map_number: int
    pose_parent: str
    pose: Floats
    is_cloud: bool


def viewpoints_among(connection: Connection, numbers: Iterable[int]) -> list[FrameViewpoint]:
    """Where the frames of some numbers were taken; those without a pose are left out."""
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
