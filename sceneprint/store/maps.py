"""Maps and the models they are signed with."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from sqlalchemy import Connection, func, insert, select, update

from sceneprint.errors import QuotaExceeded, UnknownMap
from sceneprint.store.events import inherited, record_event
from sceneprint.store.tables import (
    MapRow,
    frames,
    map_row,
    maps,
    models,
)
from sceneprint_client.api import FrameState


def find_map(connection: Connection, name: str) -> MapRow:
    """The map of a name.

    Raises
    ------
    UnknownMap : there is none.
    """
    row = connection.execute(select(maps).where(maps.c.name == name)).mappings().first()
    if row is None:
        raise unknown_map(name)
    return map_row(row)


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
    name, title, model_id : of the map
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
# Counted are frames that are neither deleted nor redundant, whatever else became of them, and their
# uploads as they were sent. Not counted is what we make of them: signatures, artifacts, indexes.
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
    return MapUsage(int(n), int(size))


def require_room(connection: Connection, row: MapRow, size: int, *, new: bool = True) -> None:
    """See that a map's quota leaves room for one more frame, or for a larger upload of one.

    Parameters
    ----------
    connection : of the transaction that would add it, or of a reading one for a first look
    row : of the map
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
    if size > 0 and row.quota_bytes is not None and use.bytes + size > row.quota_bytes:
        raise QuotaExceeded(
            f"Map {row.name!r} holds {use.bytes} bytes of uploads of the {row.quota_bytes} that "
            f"its quota allows, so {size} bytes more were not taken. {_todo(row.name)}"
        )


def _todo(name: str) -> str:
    return (
        "Delete frames that are not needed any more, or ask the operator for a larger quota "
        f"(PATCH /v1/maps/{name})."
    )
