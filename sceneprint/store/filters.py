"""Which frames of a map pass a filter: one statement over the metadata that came with them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import ColumnElement, Connection, String, cast, func, or_, select

from sceneprint.schemas import Filter, FrameState, Region
from sceneprint.store.tables import frame_tags, frames

_NONE: NDArray[np.int64] = np.empty(0, np.int64)


@dataclass(frozen=True)
class Taken:
    """Who took a query, in which run, and when (seconds since 1970), as far as is known."""

    robot: str | None
    session: str | None
    captured_at: float | None


def passing(
    connection: Connection, map_number: int, wanted: Filter, taken: Taken
) -> NDArray[np.int64]:
    """Numbers of the indexed frames of a map that pass a filter, rising.

    Parameters
    ----------
    connection : of the database
    map_number : of the map
    wanted : the filter
    taken : the query, with session and time where the filter asks for distance from its session
    """
    # as one text: a row for each of 100,000 frames takes many times as long
    listed = func.aggregate_strings(cast(frames.c.number, String), ",")
    found = connection.execute(
        select(listed).where(
            frames.c.map_number == map_number,
            frames.c.state == FrameState.INDEXED,
            *_conditions(map_number, wanted, taken),
        )
    ).scalar()
    return np.sort(np.fromstring(found, np.int64, sep=",")) if found else _NONE


def _conditions(map_number: int, wanted: Filter, taken: Taken) -> list[ColumnElement[bool]]:
    """What must hold; of a column that is null, no comparison does."""
    found: list[ColumnElement[bool]] = []
    if wanted.robot is not None:
        found.append(frames.c.robot.in_(wanted.robot))
    if wanted.session is not None:
        found.append(frames.c.session.in_(wanted.session))
    if wanted.captured_after is not None:
        found.append(frames.c.captured_at >= wanted.captured_after.timestamp())
    if wanted.captured_before is not None:
        found.append(frames.c.captured_at <= wanted.captured_before.timestamp())
    for tag in sorted(set(wanted.tags)):
        tagged = select(frame_tags.c.frame_number).where(frame_tags.c.tag == tag)
        found.append(frames.c.number.in_(tagged))
    if wanted.not_within_s is not None:
        found.append(_elsewhere(taken, wanted.not_within_s))
    if wanted.region is not None:
        found += _inside(wanted.region)
    if wanted.exclude_frames:
        barred = select(frames.c.number).where(
            frames.c.map_number == map_number, frames.c.id.in_(wanted.exclude_frames)
        )
        found.append(frames.c.number.not_in(barred.correlate(None)))
    return found


def _elsewhere(taken: Taken, seconds: float) -> ColumnElement[bool]:
    """Not of the query's session, or long enough before or after it."""
    if taken.session is None or taken.captured_at is None:
        raise ValueError("a query of no session, or of no time")
    apart = [
        frames.c.session.is_(None),
        frames.c.session != taken.session,
        frames.c.captured_at < taken.captured_at - seconds,
        frames.c.captured_at > taken.captured_at + seconds,
    ]
    if taken.robot is not None:  # two robots may call their runs alike
        apart.append(frames.c.robot != taken.robot)
    return or_(*apart)


def _inside(region: Region) -> list[ColumnElement[bool]]:
    sides = [
        getattr(frames.c, f"pose_{axis}").between(
            getattr(region.min, axis), getattr(region.max, axis)
        )
        for axis in "xyz"
    ]
    return [frames.c.pose_parent == region.parent_frame, *sides]
