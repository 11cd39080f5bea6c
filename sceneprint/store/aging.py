"""Frames that are older than their map keeps them."""

from __future__ import annotations

from sqlalchemy import ColumnElement, Connection, and_, func, literal_column, select

from sceneprint.store.records import MapRow, map_row
from sceneprint.store.tables import frames, maps

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
    asked = select(func.count()).where(_old(map_number, before))
    return int(connection.execute(asked).scalar_one())


def _old(map_number: int, before: float) -> ColumnElement[bool]:
    return and_(frames.c.map_number == map_number, frames.c.received_at < before, _LIVING)
