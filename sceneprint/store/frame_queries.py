"""Selection of frames by their metadata: filters, lists, sessions and paths."""

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
from sceneprint_client.api import Filter, FrameState
from sceneprint_client.api.frames import Kind
from sceneprint_client.api.listing import FrameListing, Run, Stamp

_NONE: NDArray[np.int64] = np.empty(0, np.int64)

#: Capture order of the frames of a session: by time, then by sequence number, then by upload. All
#: lists, paths and graphs of a session use it.
CAPTURE_ORDER: tuple[ColumnElement[Any], ...] = (
    frames.c.captured_at.is_(None), frames.c.captured_at,
    frames.c.sequence.is_(None), frames.c.sequence, frames.c.number,
)  # fmt: skip


@dataclass(frozen=True)
class CapturePosition:
    """Position of a frame in `CAPTURE_ORDER`, by columns of the table `frames`."""

    number: int
    captured_at: float | None
    sequence: int | None


def _after_capture(last: CapturePosition) -> ColumnElement[bool]:
    """Return the SQL condition for frames after a position in `CAPTURE_ORDER`."""
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
    """Robot, session and capture time (seconds since 1970) of a query; None if unknown."""

    robot: str | None
    session: str | None
    captured_at: float | None


def passing_frames(
    connection: Connection, map_number: int, criteria: Filter, origin: QueryOrigin
) -> NDArray[np.int64]:
    """Return the numbers of the indexed frames of a map that pass a filter, in ascending order.

    Parameters
    ----------
    origin : origin of the query; `criteria.not_within_s` requires its session and time
    """
    # one long text is read much faster than 100,000 rows
    listed = func.aggregate_strings(cast(frames.c.number, String), ",")
    numbers = connection.execute(
        select(listed).where(
            frames.c.map_number == map_number,
            frames.c.state == FrameState.INDEXED,
            *_conditions(map_number, criteria, origin),
        )
    ).scalar()
    return np.sort(np.fromstring(numbers, np.int64, sep=",")) if numbers else _NONE


def _common_conditions(
    criteria: Filter | FrameListing | Run, tags: Sequence[str] = ()
) -> list[ColumnElement[bool]]:
    """Return conditions on robot, session, tags and time; frames with unknown values fail them."""
    c, conditions = frames.c, list[ColumnElement[bool]]()
    for column, names in ((c.robot, criteria.robot), (c.session, criteria.session)):
        if isinstance(names, str):
            conditions.append(column == names)
        elif names:
            conditions.append(column.in_(names))
    for tag in sorted(set(tags)):
        conditions.append(
            c.number.in_(select(frame_tags.c.frame_number).where(frame_tags.c.tag == tag))
        )
    if criteria.captured_after is not None:
        conditions.append(c.captured_at >= criteria.captured_after.timestamp())
    if criteria.captured_before is not None:
        conditions.append(c.captured_at <= criteria.captured_before.timestamp())
    return conditions


def _conditions(
    map_number: int, criteria: Filter, origin: QueryOrigin
) -> list[ColumnElement[bool]]:
    """Return the SQL conditions of a filter."""
    conditions = _common_conditions(criteria, criteria.tags)
    if criteria.not_within_s is not None:
        conditions.append(_elsewhere(origin, criteria.not_within_s))
    if (region := criteria.region) is not None:
        conditions.append(frames.c.pose_parent == region.parent_frame)
        for axis in "xyz":
            low, high = getattr(region.min, axis), getattr(region.max, axis)
            conditions.append(getattr(frames.c, f"pose_{axis}").between(low, high))
    if criteria.exclude_frames:
        excluded = select(frames.c.number).where(
            frames.c.map_number == map_number, frames.c.id.in_(criteria.exclude_frames)
        )
        conditions.append(frames.c.number.not_in(excluded.correlate(None)))
    return conditions


def _elsewhere(origin: QueryOrigin, seconds: float) -> ColumnElement[bool]:
    """Return the condition for frames of other sessions, or captured more than `seconds` apart."""
    if origin.session is None or origin.captured_at is None:
        raise ValueError("the query has no session or no time")
    apart = [
        frames.c.session.is_(None),
        frames.c.session != origin.session,
        frames.c.captured_at < origin.captured_at - seconds,
        frames.c.captured_at > origin.captured_at + seconds,
    ]
    if origin.robot is not None:  # two robots may use the same session names
        apart.append(frames.c.robot != origin.robot)
    return or_(*apart)


# Lists of frames in pages.

#: States of frames that lists include by default.
_LIVING = tuple(state for state in FrameState if state != FrameState.DELETED)


def list_frames(
    connection: Connection, map_number: int, beyond: CapturePosition | None, limit: int,
    criteria: FrameListing,
) -> list[FrameRow]:  # fmt: skip
    """Return frames of a map in upload order, in reverse upload order, or in capture order.

    Parameters
    ----------
    beyond : position of the last frame of the previous page, None for the first page; upload orders
        use only its number
    limit : maximum number of frames
    criteria : conditions; deleted frames are excluded unless requested
    """
    states = _LIVING if criteria.state is None else (criteria.state,)
    # SQLite can read a page in two ways: in the order of numbers until the page is full, which is
    # best if most frames match or another index selects few frames; or by the index that covers all
    # conditions. "+ 0" rules out the first way.
    number: ColumnElement[Any] = frames.c.number + 0 if _is_narrow(criteria) else frames.c.number
    numbers: Select[Any] = select(frames.c.number).where(
        frames.c.map_number == map_number,
        frames.c.state.in_(states),
        *_listing_conditions(map_number, criteria),
    )
    if criteria.order == "taken":
        numbers = numbers.order_by(*CAPTURE_ORDER)
        if beyond is not None:
            numbers = numbers.where(_after_capture(beyond))
    elif criteria.order == "desc":
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
    selected = connection.execute(select(*FRAME_COLUMNS).where(frames.c.number.in_(chosen)))
    rows = {row.number: row for row in frame_rows(selected)}
    return [rows[chosen_number] for chosen_number in chosen]


def count_listed(
    connection: Connection, map_number: int, criteria: FrameListing, after: int
) -> int:
    """Count the frames of a list in upload order after frame number `after`."""
    states = _LIVING if criteria.state is None else (criteria.state,)
    return count_rows(
        connection, frames.c.map_number == map_number, frames.c.state.in_(states),
        frames.c.number > after, *_listing_conditions(map_number, criteria),
    )  # fmt: skip


def _is_narrow(criteria: FrameListing) -> bool:
    if criteria.tag or criteria.content_id is not None or criteria.find is not None:
        return False  # conditions with separate indexes
    named = (
        criteria.captured_after,
        criteria.captured_before,
        criteria.parent_frame,
        criteria.has_pose,
    )
    rare = criteria.state not in (None, FrameState.INDEXED)
    return bool(criteria.robot or criteria.session or criteria.name or rare) or any(
        value is not None for value in named
    )


def _listing_conditions(map_number: int, criteria: FrameListing) -> list[ColumnElement[bool]]:
    """Return the SQL conditions on the frames of a list."""
    c, conditions = frames.c, _common_conditions(criteria, criteria.tag)
    if criteria.received_after is not None:
        conditions.append(c.received_at >= criteria.received_after.timestamp())
    if criteria.received_before is not None:
        conditions.append(c.received_at <= criteria.received_before.timestamp())
    if criteria.parent_frame is not None:
        conditions.append(c.pose_parent == criteria.parent_frame)
    if criteria.has_pose is not None:
        conditions.append(c.pose_x.is_not(None) if criteria.has_pose else c.pose_x.is_(None))
    if criteria.content_id is not None:
        conditions.append(c.content_id == criteria.content_id)
    if criteria.name is not None:
        conditions += _begins(c.name, criteria.name)
    if criteria.find is not None:
        conditions.append(_begins_any(map_number, criteria.find))
    if criteria.state == FrameState.DELETED and conditions:
        conditions.append(c.deletion.is_(None))  # do not reveal metadata of tombstones
    return conditions


def _begins_any(map_number: int, prefix: str) -> ColumnElement[bool]:
    """Return the SQL condition for frames whose id, name or session starts with a prefix."""
    own = frames.c.map_number == map_number
    ways = [
        select(frames.c.number).where(own, *_begins(column, prefix)).correlate(None)
        for column in (frames.c.id, frames.c.name)
    ]
    # include the state, the first column of the index of sessions
    living = frames.c.state.in_(_LIVING)
    ways.append(select(frames.c.number).where(own, living, *_begins(frames.c.session, prefix)))
    return frames.c.number.in_(union(*ways))


def _begins(column: Column[Any], prefix: str) -> list[ColumnElement[bool]]:
    """Return SQL conditions for texts that start with a prefix, as a range that indexes support."""
    head = prefix.rstrip(_LAST)
    if not head:
        return [column >= prefix]
    above = ord(head[-1]) + 1
    if above in _SURROGATES:
        above = _SURROGATES.stop
    return [column >= prefix, column < head[:-1] + chr(above)]


#: The last code point, and the code points of surrogates.
_LAST, _SURROGATES = chr(0x10FFFF), range(0xD800, 0xE000)


# Runs and sessions of a map.


@dataclass
class RunSummary:
    """Summary of the frames of one robot and one session.

    Parameters
    ----------
    robot, session : names, or None if unknown
    states : number of frames by state
    posed : number of frames with a pose
    first, last : first and last capture time, seconds since 1970
    parents : number of frames with a pose, by parent frame
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
) -> list[RunSummary]:
    """Return the runs of a map, sorted by session and robot.

    Parameters
    ----------
    after : session and robot of the last run of the previous page; "" if unknown
    limit : maximum number of runs
    """
    key = (func.coalesce(frames.c.session, ""), func.coalesce(frames.c.robot, ""))
    own = [frames.c.map_number == map_number, frames.c.state.in_(_LIVING)]
    number, tag = frame_tags.c.frame_number, frame_tags.c.tag
    beyond = [] if after is None else [tuple_(*key) > tuple_(*after)]
    names = connection.execute(
        select(*key).where(*own, *beyond).group_by(*key).order_by(*key).limit(limit)
    ).all()
    runs = {(row[0], row[1]): RunSummary(row[1] or None, row[0] or None) for row in names}
    if not runs:
        return []
    keys = list(runs)
    of_page = [*own, tuple_(*key) >= tuple_(*keys[0]), tuple_(*key) <= tuple_(*keys[-1])]
    groups = connection.execute(
        select(
            *key, frames.c.state, frames.c.pose_parent, func.count(),
            func.count(frames.c.pose_x), func.min(frames.c.captured_at),
            func.max(frames.c.captured_at),
        )
        .where(*of_page)
        .group_by(*key, frames.c.state, frames.c.pose_parent)
    )  # fmt: skip
    for session, robot, state, parent, count, posed, first, last in groups:
        run = runs[session, robot]
        run.states[state] += count
        run.posed += posed
        run.first = min((at for at in (run.first, first) if at is not None), default=None)
        run.last = max((at for at in (run.last, last) if at is not None), default=None)
        if parent is not None:
            run.parents[parent] += posed
    tagged = (
        select(*key, tag, func.count())
        .join_from(frames, frame_tags, number == frames.c.number)
        .where(*of_page)
        .group_by(*key, tag)
        .order_by(tag)
    )
    for session, robot, name, count in connection.execute(tagged):
        runs[session, robot].tags[name] += count
    return list(runs.values())


def count_run(
    connection: Connection, map_number: int, run: Run
) -> list[tuple[str | None, str | None, int]]:
    """Count the frames of a session by robot and parent frame."""
    groups = connection.execute(
        select(frames.c.robot, frames.c.pose_parent, func.count())
        .where(*_of_session(map_number, run))
        .group_by(frames.c.robot, frames.c.pose_parent)
        .order_by(frames.c.robot.nulls_first(), frames.c.pose_parent.nulls_first())
    )
    return [(robot, parent, count) for robot, parent, count in groups]


def stamps_of_run(connection: Connection, map_number: int, run: Run) -> Stamp | None:
    """Return the kind of stamps for the poses of a run: capture times or sequence numbers.

    Return None if the frames have neither. If `run.clock` is not `taken`, return it.
    """
    if run.clock != "taken":
        return run.clock
    stamps: tuple[tuple[Stamp, ColumnElement[Any]], ...] = (
        ("captured", frames.c.captured_at),
        ("sequence", frames.c.sequence),
    )
    for stamp, column in stamps:
        stamped = select(frames.c.number).where(*_posed(map_number, run), column.is_not(None))
        if connection.execute(stamped.limit(1)).first() is not None:
            return stamp
    return None


def poses_of_run(
    connection: Connection, map_number: int, run: Run, stamp: Stamp
) -> tuple[list[tuple[str, float, list[list[float]]]], int]:
    """Return the poses of a run, sorted by time stamp, with one frame per stamp.

    Parameters
    ----------
    run : run; if `most` is set, only that many evenly spaced frames are returned
    stamp : kind of stamp from `stamps_of_run`; `received` selects all posed frames in upload order

    Returns
    -------
    poses : frame id, stamp (seconds since 1970, or sequence number), and T_parent_sensor (4, 4)
    count : number of frames without the limit `most`
    """
    c = frames.c
    at = {"captured": c.captured_at, "sequence": c.sequence, "received": c.received_at}[stamp]
    posed = select(c.number).where(*_posed(map_number, run))
    order: tuple[ColumnElement[Any], ...] = (c.number,)
    if stamp == "received":
        first = posed.add_columns(c.number.label("order")).subquery()
    else:
        order = (at, *CAPTURE_ORDER)
        rank = func.row_number().over(partition_by=at, order_by=CAPTURE_ORDER).label("rank")
        stamped = posed.add_columns(at.label("order"), rank).where(at.is_not(None)).subquery()
        first = select(stamped.c.number, stamped.c.order).where(stamped.c.rank == 1).subquery()
    chosen = select(first.c.number)
    count = int(connection.execute(select(func.count()).select_from(first)).scalar_one())
    if run.most is not None and run.most < count:
        place = (func.row_number().over(order_by=first.c.order) - 1).label("place")
        placed = select(first.c.number, place).subquery()
        # select the multiples of (count - 1) / (most - 1), rounded up
        even = (placed.c.place * (run.most - 1)) % (count - 1) < run.most - 1
        chosen = select(placed.c.number).where(even)
    poses = select(c.id, at, c.pose).where(c.number.in_(chosen)).order_by(*order)
    return [(frame_id, time, pose) for frame_id, time, pose in connection.execute(poses)], count


def _posed(map_number: int, run: Run) -> list[ColumnElement[bool]]:
    """Return the SQL conditions for frames of a run with a pose in the parent frame of the run."""
    return [
        *_of_session(map_number, run),
        frames.c.pose_parent == run.parent_frame,
        frames.c.pose_x.is_not(None),
    ]


def _of_session(map_number: int, run: Run) -> list[ColumnElement[bool]]:
    own = [frames.c.map_number == map_number, frames.c.state.in_(_LIVING)]
    return [*own, *_common_conditions(run)]


# Frames of sessions in capture order, for products.


@dataclass(frozen=True)
class PathFrame:
    """A frame of a run, with the values that products need.

    Parameters
    ----------
    robot, session, captured_at, name, sequence : metadata; None if unknown
    pose : T_parent_sensor (4, 4); None if unknown
    is_cloud : whether the frame is a point cloud
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
        """Kind of the frame: depth image or point cloud."""
        return "cloud" if self.is_cloud else "depth"


def numbers_of_session(
    connection: Connection, map_number: int, session: str, robot: str | None
) -> list[int]:
    """Return the numbers of the indexed frames of a session in capture order."""
    c = frames.c
    statement = select(c.number).where(
        c.map_number == map_number, c.state == FrameState.INDEXED, c.session == session
    )
    if robot is not None:
        statement = statement.where(c.robot == robot)
    return list(connection.execute(statement.order_by(*CAPTURE_ORDER)).scalars())


def parents_of_session(connection: Connection, map_number: int, session: str) -> dict[str, int]:
    """Count the indexed frames of a session with a pose by parent frame."""
    c = frames.c
    counts = select(c.pose_parent, func.count()).where(*_posed_in(map_number, session))
    groups = connection.execute(counts.group_by(c.pose_parent).order_by(c.pose_parent))
    return {row[0]: row[1] for row in groups}


def posed_in_session(
    connection: Connection, map_number: int, session: str, parent: str
) -> list[int]:
    """Return the numbers of the indexed frames of a session in a parent frame, in capture order."""
    own = (*_posed_in(map_number, session), frames.c.pose_parent == parent)
    return list(
        connection.execute(select(frames.c.number).where(*own).order_by(*CAPTURE_ORDER)).scalars()
    )


def _posed_in(map_number: int, session: str) -> list[ColumnElement[bool]]:
    c = frames.c
    return [
        c.map_number == map_number, c.state == FrameState.INDEXED, c.session == session,
        c.pose_parent.is_not(None), c.pose_x.is_not(None),
    ]  # fmt: skip


def any_purged(connection: Connection, numbers: Iterable[int]) -> bool:
    """Return whether any frame was removed, or can no longer be restored."""
    own = set(numbers)
    existing = select(frames.c.number).where(not_purged())
    return len(own) > sum(1 for _ in rows_among(connection, existing, frames.c.number, own))


def numbers_of_runs(
    connection: Connection, map_number: int, session: str | None, robot: str | None
) -> list[int]:
    """Return the numbers of the indexed frames of a map, or of a session or a robot.

    The frames are sorted by run, capture time and upload; those without a time are last in a run.
    """
    c = frames.c
    statement = select(c.number).where(c.map_number == map_number, c.state == FrameState.INDEXED)
    for column, name in ((c.session, session), (c.robot, robot)):
        if name is not None:
            statement = statement.where(column == name)
    run = (func.coalesce(c.session, ""), func.coalesce(c.robot, ""))
    order = (*run, c.captured_at.is_(None), c.captured_at, c.number)
    return list(connection.execute(statement.order_by(*order)).scalars())


def path_frames(connection: Connection, numbers: Iterable[int]) -> dict[int, PathFrame]:
    """Return the frames with these numbers that are indexed, by number."""
    statement = select(
        frames.c.number, frames.c.id, frames.c.robot, frames.c.session, frames.c.captured_at,
        frames.c.pose_parent, frames.c.pose, frames.c.cloud.is_not(null()), frames.c.name,
        frames.c.sequence,
    ).where(frames.c.state == FrameState.INDEXED)  # fmt: skip
    return {
        row.number: PathFrame(*row)
        for row in rows_among(connection, statement, frames.c.number, numbers)
    }


@dataclass(frozen=True)
class FrameUp:
    """Stored up vectors of a frame and of its map.

    Parameters
    ----------
    parent, pose : parent frame and T_parent_sensor (4, 4); None without a pose
    up : (3,) unit vector in the sensor frame, as uploaded; None if unknown
    map_up : (3,) unit vector in the parent frames of the map; None if unknown
    """

    number: int
    map_number: int
    parent: str | None
    pose: list[list[float]] | None
    up: list[float] | None
    map_up: list[float] | None


def frame_ups(connection: Connection, numbers: Iterable[int]) -> list[FrameUp]:
    """Return the up vectors of existing frames that have an up vector or a pose."""
    c = frames.c
    statement = (
        select(c.number, c.map_number, c.pose_parent, c.pose, c.up, maps.c.up.label("map_up"))
        .join(maps, maps.c.number == c.map_number)
        .where(c.state != FrameState.DELETED, c.up.is_not(null()) | c.pose.is_not(null()))
    )
    return [FrameUp(*row) for row in rows_among(connection, statement, c.number, numbers)]


def positions_of_map(connection: Connection, map_number: int) -> dict[str, NDArray[np.float64]]:
    """Return the positions (n, 3) of the indexed frames of a map by parent frame, metres."""
    c = frames.c
    statement = select(c.pose_parent, c.pose_x, c.pose_y, c.pose_z).where(
        c.map_number == map_number, c.state == FrameState.INDEXED, c.pose_x.is_not(None)
    )
    positions: dict[str, list[NDArray[np.float64]]] = {}
    for rows in connection.execute(statement).partitions(
        10_000
    ):  # convert blocks to arrays, which need less memory than rows
        parents = np.array([row[0] for row in rows], object)
        at = np.array([row[1:] for row in rows], np.float64)
        for parent in dict.fromkeys(parents):
            positions.setdefault(parent, []).append(at[parents == parent])
    return {parent: np.concatenate(blocks) for parent, blocks in positions.items()}


def has_parent_frame(connection: Connection, map_number: int, parent: str) -> bool:
    """Return whether an existing frame of a map has a pose in a parent frame."""
    c = frames.c
    statement = select(c.number).where(
        c.map_number == map_number, c.pose_parent == parent, c.state != FrameState.DELETED
    )
    return connection.execute(statement.limit(1)).first() is not None


# Sizes of maps, and samples of frames.

_WITH_UPLOAD = tuple(state for state in FrameState if state not in ROOMLESS)


def frames_with_uploads(
    connection: Connection, map_number: int, most: int
) -> tuple[list[int], int]:
    """Return up to `most` evenly spaced frames with uploads, and the number of all such frames."""
    own = (frames.c.map_number == map_number) & frames.c.state.in_(_WITH_UPLOAD)
    total = count_rows(connection, own)
    # "+ 0" makes SQLite use the index of states, so that it reads no rows
    place = (func.row_number().over(order_by=frames.c.number + 0) - 1).label("place")
    listed = select(frames.c.number, place).where(own).subquery()
    step = max(-(-total // most), 1)
    statement = select(listed.c.number).where(listed.c.place % step == 0)
    return list(connection.execute(statement.order_by(listed.c.number)).scalars()), total


def sample_frames(connection: Connection, most: int) -> list[int]:
    """Return the numbers of a sample of the frames with uploads of all maps, oldest first.

    Parameters
    ----------
    most : maximum size of the sample, which is smaller if some frames were deleted
    """
    ends = select(func.min(frames.c.number), func.max(frames.c.number))
    first, last = connection.execute(ends).one()
    if first is None:
        return []
    # look up numbers in the index, since counting would read all frames
    numbers = {first + (last - first) * place // max(most - 1, 1) for place in range(most)}
    nearest = set()
    for number in numbers:
        near = select(frames.c.number).where(
            frames.c.number >= number, frames.c.state.in_(_WITH_UPLOAD)
        )
        nearest.add(connection.execute(near.order_by(frames.c.number).limit(1)).scalar())
    return sorted(number for number in nearest if number is not None)


def count_uploads(connection: Connection) -> int:
    """Count the frames with uploads of all maps."""
    return count_rows(connection, frames.c.state.in_(_WITH_UPLOAD))


def bytes_of_files(connection: Connection) -> int:
    """Return the total size, in bytes, of the files of all jobs."""
    return int(connection.execute(select(func.sum(job_files.c.bytes))).scalar() or 0)


def stored_sizes(connection: Connection, numbers: Sequence[int]) -> tuple[int, int, list[str]]:
    """Return the total bytes of the uploads and of the signatures, and the artifact digests."""
    sizes = rows_among(connection, select(frames.c.bytes), frames.c.number, numbers)
    uploads = sum(row.bytes for row in sizes)
    statement = select(func.length(signatures.c.vector), signatures.c.geometry)
    signed = list(rows_among(connection, statement, signatures.c.frame_number, numbers))
    return uploads, sum(size for size, _ in signed), [geometry for _, geometry in signed]
