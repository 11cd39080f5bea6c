"""Frames of a map by their metadata, a page at a time."""

from __future__ import annotations

from typing import Any

from sqlalchemy import ColumnElement, Connection, Select, select

from sceneprint.schemas import FrameState
from sceneprint.schemas.browsing import FrameListing
from sceneprint.store.records import FrameRow, frame_row
from sceneprint.store.tables import frame_tags, frames

#: By default a list has frames in these states.
_LIVING = tuple(state for state in FrameState if state != FrameState.DELETED)


def list_frames(
    connection: Connection, map_number: int, beyond: int | None, limit: int, wanted: FrameListing
) -> list[FrameRow]:
    """Frames of a map in the order they came, or the newest first.

    Parameters
    ----------
    connection : of the database
    map_number : of the map
    beyond : number of the frame that the page before ended with; None for the first page
    limit : most frames
    wanted : which frames; deleted ones only where it asks for them
    """
    states = _LIVING if wanted.state is None else (wanted.state,)
    # Two ways through a large map. In the order of numbers, until the page is full: for what most
    # frames have, and where another index has few to offer. Or by the index that holds whatever a
    # condition may ask about, and in which the frames that pass are found without reading others.
    # Adding 0 is how SQLite is told that it shall not take the first way.
    number: ColumnElement[Any] = frames.c.number + 0 if _is_narrow(wanted) else frames.c.number
    numbers: Select[Any] = select(frames.c.number).where(
        frames.c.map_number == map_number, frames.c.state.in_(states), *_conditions(wanted)
    )
    if beyond is not None:
        numbers = numbers.where(number < beyond if wanted.order == "desc" else number > beyond)
    numbers = numbers.order_by(number.desc() if wanted.order == "desc" else number).limit(limit)
    chosen = list(connection.execute(numbers).scalars())
    if not chosen:
        return []
    found = connection.execute(select(frames).where(frames.c.number.in_(chosen))).mappings()
    rows = {row["number"]: frame_row(row) for row in found}
    return [rows[one] for one in chosen]


def _is_narrow(wanted: FrameListing) -> bool:
    if wanted.tag or wanted.content_id is not None:
        return False  # these have indexes of their own
    named = (wanted.captured_after, wanted.captured_before, wanted.parent_frame, wanted.has_pose)
    rare = wanted.state not in (None, FrameState.INDEXED)
    return bool(wanted.robot or wanted.session or rare) or any(one is not None for one in named)


def _conditions(wanted: FrameListing) -> list[ColumnElement[bool]]:
    """What must hold; of a column that is null, no comparison does."""
    c, found = frames.c, list[ColumnElement[bool]]()
    if wanted.robot:
        found.append(c.robot.in_(wanted.robot))
    if wanted.session:
        found.append(c.session.in_(wanted.session))
    for tag in sorted(set(wanted.tag)):
        tagged = select(frame_tags.c.frame_number).where(frame_tags.c.tag == tag)
        found.append(c.number.in_(tagged))
    if wanted.captured_after is not None:
        found.append(c.captured_at >= wanted.captured_after.timestamp())
    if wanted.captured_before is not None:
        found.append(c.captured_at <= wanted.captured_before.timestamp())
    if wanted.received_after is not None:
        found.append(c.received_at >= wanted.received_after.timestamp())
    if wanted.received_before is not None:
        found.append(c.received_at <= wanted.received_before.timestamp())
    if wanted.parent_frame is not None:
        found.append(c.pose_parent == wanted.parent_frame)
    if wanted.has_pose is not None:
        found.append(c.pose_x.is_not(None) if wanted.has_pose else c.pose_x.is_(None))
    if wanted.content_id is not None:
        found.append(c.content_id == wanted.content_id)
    return found
