"""Which frames of a map pass a filter: one statement over the metadata that came with them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import (
    Column,
    ColumnElement,
    Connection,
    Select,
    String,
    and_,
    cast,
    func,
    null,
    or_,
    select,
    tuple_,
    union,
)

from sceneprint.store.frames import not_purged
from sceneprint.store.maps import ROOMLESS
from sceneprint.store.tables import (
    FRAME_COLUMNS,
    FrameRow,
    count_rows,
    frame_rows,
    frame_tags,
    frames,
    job_files,
    maps,
    rows_among,
    signatures,
)
from sceneprint_client.api import Filter, FrameState, Region
from sceneprint_client.api.frames import Kind
from sceneprint_client.api.listing import FrameListing, Run, Stamp

_NONE: NDArray[np.int64] = np.empty(0, np.int64)

#: The order in which the frames of a session were taken: by time; then those without one, by their
#: place in the session; then those without either, and those alike in both, as they came. Every
#: list, path and graph of a session follows it, so the order of upload does not matter.
TAKEN_ORDER: tuple[ColumnElement[Any], ...] = (
    frames.c.captured_at.is_(None), frames.c.captured_at,
    frames.c.sequence.is_(None), frames.c.sequence, frames.c.number,
)  # fmt: skip


@dataclass(frozen=True)
class TakenPosition:
    """Where a frame stands in `TAKEN_ORDER`; fields as in the table."""

    number: int
    captured_at: float | None
    sequence: int | None


def _after_taken(last: TakenPosition) -> ColumnElement[bool]:
    """That a frame comes after a position in `TAKEN_ORDER`."""
    after: ColumnElement[bool] = frames.c.number > last.number
    for column, value in (
        (frames.c.sequence, last.sequence),
        (frames.c.captured_at, last.captured_at),
    ):
        if value is None:
            after = and_(column.is_(None), after)
        else:
            after = or_(column > value, column.is_(None), and_(column == value, after))
    return after


@dataclass(frozen=True)
class QueryOrigin:
    """Who took a query, in which run, and when (seconds since 1970), as far as is known."""

    robot: str | None
    session: str | None
    captured_at: float | None


def passing(
    connection: Connection, map_number: int, wanted: Filter, taken: QueryOrigin
) -> NDArray[np.int64]:
    """Numbers of the indexed frames of a map that pass a filter, rising.

    Parameters
    ----------
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


def _common_conditions(
    wanted: Filter | FrameListing | Run, tags: Sequence[str] = ()
) -> list[ColumnElement[bool]]:
    """Conditions on robot, session, tags and time; none holds of a column that is null."""
    c, found = frames.c, list[ColumnElement[bool]]()
    for column, names in ((c.robot, wanted.robot), (c.session, wanted.session)):
        if isinstance(names, str):
            found.append(column == names)
        elif names:
            found.append(column.in_(names))
    for tag in sorted(set(tags)):
        found.append(c.number.in_(select(frame_tags.c.frame_number).where(frame_tags.c.tag == tag)))
    if wanted.captured_after is not None:
        found.append(c.captured_at >= wanted.captured_after.timestamp())
    if wanted.captured_before is not None:
        found.append(c.captured_at <= wanted.captured_before.timestamp())
    return found


def _conditions(map_number: int, wanted: Filter, taken: QueryOrigin) -> list[ColumnElement[bool]]:
    """What must hold of the frames that pass a filter."""
    found = _common_conditions(wanted, wanted.tags)
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


def _elsewhere(taken: QueryOrigin, seconds: float) -> ColumnElement[bool]:
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


# Frames of a map by their metadata, a page at a time.

#: By default a list has frames in these states.
_LIVING = tuple(state for state in FrameState if state != FrameState.DELETED)


def list_frames(
    connection: Connection, map_number: int, beyond: TakenPosition | None, limit: int,
    wanted: FrameListing,
) -> list[FrameRow]:  # fmt: skip
    """Frames of a map in the order they came, the newest first, or in the order they were taken.

    Parameters
    ----------
    beyond : the frame that the page before ended with, by its number unless in the order they were
        taken; None for the first page
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
        frames.c.map_number == map_number,
        frames.c.state.in_(states),
        *_listing_conditions(map_number, wanted),
    )
    if wanted.order == "taken":
        numbers = numbers.order_by(*TAKEN_ORDER)
        if beyond is not None:
            numbers = numbers.where(_after_taken(beyond))
    elif wanted.order == "desc":
        numbers = numbers.order_by(number.desc())
        if beyond is not None:
            numbers = numbers.where(number < beyond.number)
    else:
        numbers = numbers.order_by(number)
        if beyond is not None:
            numbers = numbers.where(number > beyond.number)
    chosen = list(connection.execute(numbers.limit(limit)).scalars())
    if not chosen:
        return []
    found = connection.execute(select(*FRAME_COLUMNS).where(frames.c.number.in_(chosen)))
    rows = {row.number: row for row in frame_rows(found)}
    return [rows[one] for one in chosen]


def count_listed(connection: Connection, map_number: int, wanted: FrameListing, after: int) -> int:
    """How many frames of `list_frames`, in the order they came, follow the one of a number."""
    states = _LIVING if wanted.state is None else (wanted.state,)
    return count_rows(
        connection, frames.c.map_number == map_number, frames.c.state.in_(states),
        frames.c.number > after, *_listing_conditions(map_number, wanted),
    )  # fmt: skip


def _is_narrow(wanted: FrameListing) -> bool:
    if wanted.tag or wanted.content_id is not None or wanted.find is not None:
        return False  # these have indexes of their own
    named = (wanted.captured_after, wanted.captured_before, wanted.parent_frame, wanted.has_pose)
    rare = wanted.state not in (None, FrameState.INDEXED)
    return bool(wanted.robot or wanted.session or wanted.name or rare) or any(
        one is not None for one in named
    )


def _listing_conditions(map_number: int, wanted: FrameListing) -> list[ColumnElement[bool]]:
    """What must hold of the frames of a list."""
    c, found = frames.c, _common_conditions(wanted, wanted.tag)
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
    if wanted.name is not None:
        found += _begins(c.name, wanted.name)
    if wanted.find is not None:
        found.append(_known_as(map_number, wanted.find))
    if wanted.state == FrameState.DELETED and found:
        found.append(c.deletion.is_(None))  # nothing is told of what a tombstone has
    return found


def _known_as(map_number: int, prefix: str) -> ColumnElement[bool]:
    """That the id, the name or the session of a frame begins so: each by an index of its own."""
    own = frames.c.map_number == map_number
    ways = [
        select(frames.c.number).where(own, *_begins(column, prefix)).correlate(None)
        for column in (frames.c.id, frames.c.name)
    ]
    # the index of sessions has the state before them
    living = frames.c.state.in_(_LIVING)
    ways.append(select(frames.c.number).where(own, living, *_begins(frames.c.session, prefix)))
    return frames.c.number.in_(union(*ways))


def _begins(column: Column[Any], prefix: str) -> list[ColumnElement[bool]]:
    """That a text begins so, as a range that an index of either database serves."""
    kept = prefix.rstrip(_LAST)
    if not kept:
        return [column >= prefix]
    above = ord(kept[-1]) + 1
    if above in _SURROGATES:  # no characters
        above = _SURROGATES.stop
    return [column >= prefix, column < kept[:-1] + chr(above)]


#: The last code point, and those that stand for halves of others.
_LAST, _SURROGATES = chr(0x10FFFF), range(0xD800, 0xE000)


# The runs of a map: who took what, when, and where their poses lead.


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
    tags : how many frames have which
    """

    robot: str | None
    session: str | None
    states: Counter[str] = field(default_factory=Counter)
    posed: int = 0
    first: float | None = None
    last: float | None = None
    parents: Counter[str] = field(default_factory=Counter)
    tags: Counter[str] = field(default_factory=Counter)


def list_runs(
    connection: Connection, map_number: int, after: tuple[str, str] | None, limit: int
) -> list[Held]:
    """Runs of a map by session and robot.

    Parameters
    ----------
    after : session and robot of the last run of the page before; "" where there is none, which no
        name is
    limit : most runs
    """
    key = (func.coalesce(frames.c.session, ""), func.coalesce(frames.c.robot, ""))
    of_map = [frames.c.map_number == map_number, frames.c.state.in_(_LIVING)]
    number, tag = frame_tags.c.frame_number, frame_tags.c.tag
    beyond = [] if after is None else [tuple_(*key) > tuple_(*after)]
    names = connection.execute(
        select(*key).where(*of_map, *beyond).group_by(*key).order_by(*key).limit(limit)
    ).all()
    runs = {(row[0], row[1]): Held(row[1] or None, row[0] or None) for row in names}
    if not runs:
        return []
    keys = list(runs)
    of_page = [*of_map, tuple_(*key) >= tuple_(*keys[0]), tuple_(*key) <= tuple_(*keys[-1])]
    found = connection.execute(
        select(
            *key, frames.c.state, frames.c.pose_parent, func.count(),
            func.count(frames.c.pose_x), func.min(frames.c.captured_at),
            func.max(frames.c.captured_at),
        )
        .where(*of_page)
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
    tagged = (
        select(*key, tag, func.count())
        .join_from(frames, frame_tags, number == frames.c.number)
        .where(*of_page)
        .group_by(*key, tag)
        .order_by(tag)  # of equally many, by name
    )
    for session, robot, name, count in connection.execute(tagged):
        runs[session, robot].tags[name] += count
    return list(runs.values())


def count_run(
    connection: Connection, map_number: int, run: Run
) -> list[tuple[str | None, str | None, int]]:
    """Robots, parent frames and numbers of the frames of a session in any parent frame."""
    found = connection.execute(
        select(frames.c.robot, frames.c.pose_parent, func.count())
        .where(*_of_session(map_number, run))
        .group_by(frames.c.robot, frames.c.pose_parent)
        .order_by(frames.c.robot.nulls_first(), frames.c.pose_parent.nulls_first())
    )
    return [(robot, parent, count) for robot, parent, count in found]


def stamps_of_run(connection: Connection, map_number: int, run: Run) -> Stamp | None:
    """By what the poses of a run are stamped: their times, or where none has one their places in
    the session; None where they have neither.

    `run.clock` is what was asked for; only `taken` leaves a choice.
    """
    if run.clock != "taken":
        return run.clock
    known: tuple[tuple[Stamp, ColumnElement[Any]], ...] = (
        ("captured", frames.c.captured_at),
        ("sequence", frames.c.sequence),
    )
    for stamp, column in known:
        some = select(frames.c.number).where(*_posed(map_number, run), column.is_not(None))
        if connection.execute(some.limit(1)).first() is not None:
            return stamp
    return None


def poses_of_run(
    connection: Connection, map_number: int, run: Run, stamp: Stamp
) -> tuple[list[tuple[str, float, list[list[float]]]], int]:
    """Frames of a session with stamp and pose in the order of their stamps, of one stamp the first
    that was taken; by `received` all with a pose, as they came.

    Parameters
    ----------
    run : whose; with `most`, so many of them at most, evenly taken. Only their rows are read: an
        index holds what the choice needs.
    stamp : see `stamps_of_run`

    Returns
    -------
    poses : id of the frame, its stamp (seconds since 1970, or its place), and T_parent_sensor
    count : how many there are of all of them
    """
    c = frames.c
    at = {"captured": c.captured_at, "sequence": c.sequence, "received": c.received_at}[stamp]
    posed = select(c.number).where(*_posed(map_number, run))
    order: tuple[ColumnElement[Any], ...] = (c.number,)
    if stamp == "received":
        first = posed.add_columns(c.number.label("order")).subquery()
    else:
        order = (at, *TAKEN_ORDER)
        again = func.row_number().over(partition_by=at, order_by=TAKEN_ORDER).label("again")
        stamped = posed.add_columns(at.label("order"), again).where(at.is_not(None)).subquery()
        once = select(stamped.c.number, stamped.c.order).where(stamped.c.again == 1)
        first = once.subquery()
    chosen = select(first.c.number)
    count = int(connection.execute(select(func.count()).select_from(first)).scalar_one())
    if run.most is not None and run.most < count:
        place = (func.row_number().over(order_by=first.c.order) - 1).label("place")
        placed = select(first.c.number, place).subquery()
        # the multiples of (count - 1) / (most - 1), rounded up: with 0 and count - 1, `most`
        even = (placed.c.place * (run.most - 1)) % (count - 1) < run.most - 1
        chosen = select(placed.c.number).where(even)
    asked = select(c.id, at, c.pose).where(c.number.in_(chosen)).order_by(*order)
    return [(frame_id, when, pose) for frame_id, when, pose in connection.execute(asked)], count


def _posed(map_number: int, run: Run) -> list[ColumnElement[bool]]:
    """What must hold of the frames of a run whose poses lead to its parent frame."""
    return [
        *_of_session(map_number, run),
        frames.c.pose_parent == run.parent_frame,
        frames.c.pose_x.is_not(None),
    ]


def _of_session(map_number: int, run: Run) -> list[ColumnElement[bool]]:
    of_map = [frames.c.map_number == map_number, frames.c.state.in_(_LIVING)]
    return [*of_map, *_common_conditions(run)]


def session_frames(
    connection: Connection, map_number: int, session: str, robot: str | None, after: int, limit: int
) -> list[int]:
    """Numbers of frames of a session above one of them, in whatever state but deleted."""
    found = connection.execute(
        select(frames.c.number)
        .where(*_of_name(map_number, session, robot), frames.c.number > after)
        .order_by(frames.c.number)
        .limit(limit)
    )
    return list(found.scalars())


def count_session(
    connection: Connection, map_number: int, session: str, robot: str | None, after: int = 0
) -> int:
    """How many there are of `session_frames`."""
    where = (*_of_name(map_number, session, robot), frames.c.number > after)
    return connection.execute(select(func.count()).select_from(frames).where(*where)).scalar_one()


def _of_name(map_number: int, session: str, robot: str | None) -> list[ColumnElement[bool]]:
    own = [frames.c.map_number == map_number, frames.c.session == session]
    return [
        *own, frames.c.state.in_(_LIVING), *([] if robot is None else [frames.c.robot == robot])
    ]  # fmt: skip


# Frames of sessions in the order in which they were taken, for jobs that associate them.


@dataclass(frozen=True)
class PathFrame:
    """A frame of a run, as far as associations need it.

    Parameters
    ----------
    robot, session, captured_at, name, sequence : as far as is known
    parent : that its pose leads to
    pose : T_parent_sensor, or None
    is_cloud : whether it is a point cloud
    """

    number: int
    id: str
    robot: str | None
    session: str | None
    captured_at: float | None
    parent: str | None
    pose: list[list[float]] | None
    is_cloud: bool
    name: str | None = None
    sequence: int | None = None

    @property
    def kind(self) -> Kind:
        """A depth image or a point cloud."""
        return "cloud" if self.is_cloud else "depth"


def numbers_of_session(
    connection: Connection, map_number: int, session: str, robot: str | None
) -> list[int]:
    """Numbers of the indexed frames of a session in the order in which they were taken."""
    asked = select(frames.c.number).where(
        frames.c.map_number == map_number,
        frames.c.state == FrameState.INDEXED,
        frames.c.session == session,
    )
    if robot is not None:
        asked = asked.where(frames.c.robot == robot)
    return list(connection.execute(asked.order_by(*TAKEN_ORDER)).scalars())


def parents_of_session(connection: Connection, map_number: int, session: str) -> dict[str, int]:
    """Parent frames of the poses of a session's indexed frames: how many frames each has."""
    c = frames.c
    asked = select(c.pose_parent, func.count()).where(*_posed_in(map_number, session))
    found = connection.execute(asked.group_by(c.pose_parent).order_by(c.pose_parent))
    return {row[0]: row[1] for row in found}


def posed_in_session(
    connection: Connection, map_number: int, session: str, parent: str
) -> list[int]:
    """Numbers of a session's indexed frames with poses in a parent frame, as taken."""
    own = (*_posed_in(map_number, session), frames.c.pose_parent == parent)
    return list(
        connection.execute(select(frames.c.number).where(*own).order_by(*TAKEN_ORDER)).scalars()
    )


def _posed_in(map_number: int, session: str) -> list[ColumnElement[bool]]:
    c = frames.c
    return [
        c.map_number == map_number, c.state == FrameState.INDEXED, c.session == session,
        c.pose_parent.is_not(None), c.pose_x.is_not(None),
    ]  # fmt: skip


def any_gone(connection: Connection, numbers: Iterable[int]) -> bool:
    """Whether any of some frames is not there any more, and cannot be restored either."""
    own = set(numbers)
    asked = select(frames.c.number).where(not_purged())
    return len(own) > sum(1 for _ in rows_among(connection, asked, frames.c.number, own))


def numbers_of_runs(
    connection: Connection, map_number: int, session: str | None, robot: str | None
) -> list[int]:
    """Numbers of the indexed frames of a map, of one session or robot where they are given.

    Run after run, each in the order of time, then as they came; those without a time come last.
    """
    c = frames.c
    asked = select(c.number).where(c.map_number == map_number, c.state == FrameState.INDEXED)
    for column, name in ((c.session, session), (c.robot, robot)):
        if name is not None:
            asked = asked.where(column == name)
    run = (func.coalesce(c.session, ""), func.coalesce(c.robot, ""))
    order = (*run, c.captured_at.is_(None), c.captured_at, c.number)
    return list(connection.execute(asked.order_by(*order)).scalars())


def stops_of(connection: Connection, numbers: Iterable[int]) -> dict[int, PathFrame]:
    """Frames by their numbers; those that are deleted, or not indexed any more, are left out."""
    asked = select(
        frames.c.number, frames.c.id, frames.c.robot, frames.c.session, frames.c.captured_at,
        frames.c.pose_parent, frames.c.pose, frames.c.cloud.is_not(null()), frames.c.name,
        frames.c.sequence,
    ).where(frames.c.state == FrameState.INDEXED)  # fmt: skip
    return {
        row.number: PathFrame(*row)
        for row in rows_among(connection, asked, frames.c.number, numbers)
    }


# Which way is up in frames, and in the parent frames of their poses.


@dataclass(frozen=True)
class FrameUp:
    """What is stored of a frame's up.

    Parameters
    ----------
    parent, pose : its parent frame and T_parent_sensor, 4 rows of 4; None without a pose
    up : unit vector in its sensor's axes, as it was sent
    map_up : unit vector in the parent frames of its map
    """

    number: int
    map_number: int
    parent: str | None
    pose: list[list[float]] | None
    up: list[float] | None
    map_up: list[float] | None


def frame_ups(connection: Connection, numbers: Iterable[int]) -> list[FrameUp]:
    """What frames say of up; those that are deleted, or can say nothing of it, are left out."""
    c = frames.c
    asked = (
        select(c.number, c.map_number, c.pose_parent, c.pose, c.up, maps.c.up.label("map_up"))
        .join(maps, maps.c.number == c.map_number)
        .where(c.state != FrameState.DELETED, c.up.is_not(null()) | c.pose.is_not(null()))
    )
    return [FrameUp(*row) for row in rows_among(connection, asked, c.number, numbers)]


def positions_of_map(connection: Connection, map_number: int) -> dict[str, NDArray[np.float64]]:
    """Where the indexed frames of a map were taken: (n, 3) of each parent frame, metres."""
    c = frames.c
    asked = select(c.pose_parent, c.pose_x, c.pose_y, c.pose_z).where(
        c.map_number == map_number, c.state == FrameState.INDEXED, c.pose_x.is_not(None)
    )
    found: dict[str, list[NDArray[np.float64]]] = {}
    for rows in connection.execute(asked).partitions(10_000):  # as numbers: a row weighs much more
        parents = np.array([row[0] for row in rows], object)
        at = np.array([row[1:] for row in rows], np.float64)
        for parent in dict.fromkeys(parents):
            found.setdefault(parent, []).append(at[parents == parent])
    return {parent: np.concatenate(blocks) for parent, blocks in found.items()}


def has_parent_frame(connection: Connection, map_number: int, parent: str) -> bool:
    """Whether a frame of a map that is not deleted has a pose in that parent frame."""
    c = frames.c
    asked = select(c.number).where(
        c.map_number == map_number, c.pose_parent == parent, c.state != FrameState.DELETED
    )
    return connection.execute(asked.limit(1)).first() is not None


# How a map grew, and what its frames weigh: counts over many rows that few are read for.

_OTHERS = tuple(state for state in FrameState if state != FrameState.INDEXED)
_KEPT = tuple(state for state in FrameState if state not in ROOMLESS)


def frames_with_uploads(
    connection: Connection, map_number: int, most: int
) -> tuple[list[int], int]:
    """Numbers of frames of a map whose uploads are kept, evenly taken, and how many there are."""
    of_map = (frames.c.map_number == map_number) & frames.c.state.in_(_KEPT)
    total = count_rows(connection, of_map)
    # adding 0, as above: the index that has states holds all of this, and rows are not read
    place = (func.row_number().over(order_by=frames.c.number + 0) - 1).label("place")
    listed = select(frames.c.number, place).where(of_map).subquery()
    step = max(-(-total // most), 1)
    asked = select(listed.c.number).where(listed.c.place % step == 0)
    return list(connection.execute(asked.order_by(listed.c.number)).scalars()), total


def spread_frames(connection: Connection, most: int) -> list[int]:
    """Numbers of frames of all maps whose uploads are kept, from the first to the newest.

    Parameters
    ----------
    most : numbers; fewer where those next to each other were deleted
    """
    ends = select(func.min(frames.c.number), func.max(frames.c.number))
    first, last = connection.execute(ends).one()
    if first is None:
        return []
    # by number, each found in the index: counting all frames off would read them all
    wanted = {first + (last - first) * place // max(most - 1, 1) for place in range(most)}
    found = []
    for number in sorted(wanted):
        near = select(frames.c.number).where(frames.c.number >= number, frames.c.state.in_(_KEPT))
        found.append(connection.execute(near.order_by(frames.c.number).limit(1)).scalar())
    return sorted({one for one in found if one is not None})


def count_uploads(connection: Connection) -> int:
    """How many frames of all maps have their uploads."""
    return count_rows(connection, frames.c.state.in_(_KEPT))


def bytes_of_files(connection: Connection) -> int:
    """Bytes of the archives, meshes and others that are of jobs."""
    return int(connection.execute(select(func.sum(job_files.c.bytes))).scalar() or 0)


def weigh(connection: Connection, numbers: Sequence[int]) -> tuple[int, int, list[str]]:
    """Bytes of the uploads of some frames, and of what was made of them by whatever model: bytes of
    signatures, and blobs of artifacts.
    """
    held = rows_among(connection, select(frames.c.bytes), frames.c.number, numbers)
    asked = select(func.length(signatures.c.vector), signatures.c.geometry)
    made = list(rows_among(connection, asked, signatures.c.frame_number, numbers))
    uploads = sum(row.bytes for row in held)
    return uploads, sum(size for size, _ in made), [geometry for _, geometry in made]
