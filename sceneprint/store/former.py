"""What is remembered of maps that are gone, by their names.

The number of its last event: who read on after that has missed nothing of it, whatever was removed
of other maps since. And its quota, which the next map of the name inherits.
"""

from __future__ import annotations

from sqlalchemy import ColumnElement, Connection, delete, func, insert, select

from sceneprint.store.records import MapRow
from sceneprint.store.tables import events, former_maps

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
