"""The runs of a map: who took what, when, and where their poses lead."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

from sqlalchemy import ColumnElement, Connection, func, select, tuple_

from sceneprint.schemas import FrameState
from sceneprint.schemas.browsing import Run
from sceneprint.store.tables import frames

#: Frames in these states are of a run.
_LIVING = tuple(state for state in FrameState if state != FrameState.DELETED)


@dataclass
class Held:
    """Frames of one robot and one session, either of which may not be known.

    Parameters
    ----------
    robot, session : None where frames do not say
    states : how many frames are in each
    posed : how many have a pose
    first, last : when they were taken, seconds since 1970
    parents : how many poses lead where
    """

    robot: str | None
    session: str | None
    states: Counter[str] = field(default_factory=Counter)
    posed: int = 0
    first: float | None = None
    last: float | None = None
    parents: Counter[str] = field(default_factory=Counter)


@dataclass(frozen=True)
class Counted:
    """How many frames are of one robot, with poses that lead to one frame."""

    robot: str | None
    parent: str | None
    count: int


@dataclass(frozen=True)
class Posed:
    """A frame of a run; `at` is by the clock of the run, `pose` is T_parent_sensor."""

    frame_id: str
    at: float
    pose: list[list[float]]


def list_runs(
    connection: Connection, map_number: int, after: tuple[str, str] | None, limit: int
) -> list[Held]:
    """Runs of a map by session and robot.

    Parameters
    ----------
    connection : of the database
    map_number : of the map
    after : session and robot of the last run of the page before; "" where there is none, which no
        name is
    limit : most runs
    """
    key = (func.coalesce(frames.c.session, ""), func.coalesce(frames.c.robot, ""))
    of_map = [frames.c.map_number == map_number, frames.c.state.in_(_LIVING)]
    beyond = [] if after is None else [tuple_(*key) > tuple_(*after)]
    names = connection.execute(
        select(*key).where(*of_map, *beyond).group_by(*key).order_by(*key).limit(limit)
    ).all()
    runs = {(row[0], row[1]): Held(row[1] or None, row[0] or None) for row in names}
    if not runs:
        return []
    keys = list(runs)
    found = connection.execute(
        select(
            *key, frames.c.state, frames.c.pose_parent, func.count(),
            func.count(frames.c.pose_x), func.min(frames.c.captured_at),
            func.max(frames.c.captured_at),
        )
        .where(*of_map, tuple_(*key) >= tuple_(*keys[0]), tuple_(*key) <= tuple_(*keys[-1]))
        .group_by(*key, frames.c.state, frames.c.pose_parent)
    )  # fmt: skip
    for session, robot, state, parent, count, posed, first, last in found:
        run = runs[session, robot]
        run.states[state] += count
        run.posed += posed
        run.first = min((one for one in (run.first, first) if one is not None), default=None)
        run.last = max((one for one in (run.last, last) if one is not None), default=None)
        if parent is not None:
            run.parents[parent] += posed
    return list(runs.values())


def count_run(connection: Connection, map_number: int, run: Run) -> list[Counted]:
    """Frames of a session by robot and parent frame; `run.parent_frame` does not matter."""
    found = connection.execute(
        select(frames.c.robot, frames.c.pose_parent, func.count())
        .where(*_of_session(map_number, run))
        .group_by(frames.c.robot, frames.c.pose_parent)
        .order_by(frames.c.robot.nulls_first(), frames.c.pose_parent.nulls_first())
    )
    return [Counted(*row) for row in found]


def poses_of_run(connection: Connection, map_number: int, run: Run) -> tuple[list[Posed], int]:
    """Frames of a session with time and pose in the order of time, of one time the first that came;
    by the clock `received` all with a pose, as they came.

    Parameters
    ----------
    connection : of the database
    map_number : of the map
    run : whose; with `most`, so many of them at most, evenly taken. Only their rows are read: an
        index holds what the choice needs.

    Returns
    -------
    poses, count : how many there are of all of them
    """
    taken = run.clock == "captured"
    at = frames.c.captured_at if taken else frames.c.received_at
    posed = [
        *_of_session(map_number, run),
        frames.c.pose_parent == run.parent_frame,
        frames.c.pose_x.is_not(None),
    ]
    if taken:
        least = func.min(frames.c.number).label("number")
        timed = select(least, at.label("order")).where(*posed, at.is_not(None)).group_by(at)
    else:
        timed = select(frames.c.number, frames.c.number.label("order")).where(*posed)
    first = timed.subquery()
    chosen = select(first.c.number)
    count = int(connection.execute(select(func.count()).select_from(first)).scalar_one())
    if run.most is not None and run.most < count:
        place = (func.row_number().over(order_by=first.c.order) - 1).label("place")
        placed = select(first.c.number, place).subquery()
        # the multiples of (count - 1) / (most - 1), rounded up: with 0 and count - 1, `most`
        even = (placed.c.place * (run.most - 1)) % (count - 1) < run.most - 1
        chosen = select(placed.c.number).where(even)
    found = connection.execute(
        select(frames.c.id, at, frames.c.pose)
        .where(frames.c.number.in_(chosen))
        .order_by(at if taken else frames.c.number, frames.c.number)
    )
    return [Posed(*row) for row in found], count


def _of_session(map_number: int, run: Run) -> list[ColumnElement[bool]]:
    found = [
        frames.c.map_number == map_number,
        frames.c.state.in_(_LIVING),
        frames.c.session == run.session,
    ]
    if run.robot is not None:
        found.append(frames.c.robot == run.robot)
    if run.captured_after is not None:
        found.append(frames.c.captured_at >= run.captured_after.timestamp())
    if run.captured_before is not None:
        found.append(frames.c.captured_at <= run.captured_before.timestamp())
    return found
