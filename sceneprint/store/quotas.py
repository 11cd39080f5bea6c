"""What a map holds and may hold: frames, and bytes of their uploads.

Counted are frames that are neither deleted nor redundant, whatever else became of them, and their
uploads as they were sent. Not counted is what we make of them: signatures, artifacts, indexes.
Two columns of the map count on in the transaction that changes it; writers take turns, so that a
quota holds to the frame whoever sends at once.
"""

from __future__ import annotations

from dataclasses import dataclass

from sqlalchemy import ColumnElement, Connection, delete, func, insert, select, update

from sceneprint.errors import QuotaExceeded
from sceneprint.store.tables import MapRow, events, former_maps, frames, maps
from sceneprint_client.api import FrameState

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


# What is remembered of maps that are gone, by their names.
#
# The number of its last event: who read on after that has missed nothing of it, whatever was
# removed of other maps since. And its quota, which the next map of the name inherits.

#: Names that are remembered, beside those with a quota: of older ones it is not known any more
#: when they went.
MOST = 10_000


def remember(connection: Connection, row: MapRow) -> None:
    """Note a map that was just removed; its last event is told already."""
    last = select(func.max(events.c.number)).where(events.c.map == row.name)
    connection.execute(delete(former_maps).where(former_maps.c.name == row.name))
    connection.execute(
        insert(former_maps).values(
            name=row.name, number=connection.execute(last).scalar_one(),
            quota_frames=row.quota_frames, quota_bytes=row.quota_bytes,
        )
    )  # fmt: skip
    beyond = (
        select(former_maps.c.number)
        .where(_spent())
        .order_by(former_maps.c.number.desc())
        .offset(MOST)
        .limit(1)
    )
    oldest = connection.execute(beyond).scalar()
    if oldest is not None:
        connection.execute(delete(former_maps).where(_spent(), former_maps.c.number <= oldest))


def inherited(connection: Connection, name: str) -> dict[str, float | None]:
    """The quota of the map that had a name before; from now on the new one has it."""
    asked = select(former_maps.c.quota_frames, former_maps.c.quota_bytes)
    found = connection.execute(asked.where(former_maps.c.name == name)).mappings().first()
    connection.execute(delete(former_maps).where(former_maps.c.name == name))
    return {} if found is None else dict(found)


def last_event(connection: Connection, name: str) -> int:
    """Number of the last event of a map that is gone; of one that is not known, the least number
    after which it has none.
    """
    asked = select(former_maps.c.number).where(former_maps.c.name == name)
    found = connection.execute(asked).scalar()
    if found is not None:
        return int(found)
    count, least = connection.execute(
        select(func.count(), func.min(former_maps.c.number)).where(_spent())
    ).one()
    return int(least) if count >= MOST else 0


def _spent() -> ColumnElement[bool]:
    return former_maps.c.quota_frames.is_(None) & former_maps.c.quota_bytes.is_(None)
