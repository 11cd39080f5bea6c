"""How a map grew, and what its frames weigh: counts over many rows that few are read for."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from sqlalchemy import Connection, func, select

from sceneprint.schemas import FrameState
from sceneprint.store.tables import frames, job_files, signatures

_OTHERS = tuple(state for state in FrameState if state != FrameState.INDEXED)
#: Frames in these states have no upload any more.
_BARE = (FrameState.DELETED, FrameState.REDUNDANT)
_KEPT = tuple(state for state in FrameState if state not in _BARE)
#: Numbers that one statement asks for.
_BLOCK = 500


def indexed_by_time(
    connection: Connection, map_number: int, start: float, width_s: float
) -> Counter[int]:
    """How many frames that are indexed now became so in each interval since a time.

    The index of times lacks the state, and reading every row for it would be slow: all are
    counted, and those that are no longer indexed, which another index names, are taken off.

    Parameters
    ----------
    connection : of the database
    map_number : of the map
    start : when the first interval begins, seconds since 1970
    width_s : of an interval, seconds

    Returns
    -------
    counts : by the number of the interval
    """
    at = frames.c.indexed_at
    interval = (at - start) // width_s
    asked = select(interval, func.count()).where(frames.c.map_number == map_number)
    every = connection.execute(asked.where(at >= start).group_by(interval))
    counts = Counter({int(place): n for place, n in every})
    # adding 0 is how SQLite is told to go by the state
    gone = connection.execute(
        asked.where(frames.c.state.in_(_OTHERS), at + 0 >= start).group_by(interval)
    )
    for place, n in gone:
        counts[int(place)] -= n
    return counts


@dataclass(frozen=True)
class Weighed:
    """What some frames of a map weigh.

    Parameters
    ----------
    upload_bytes, signature_bytes : of all of them
    artifacts : blobs of their geometry
    """

    upload_bytes: int
    signature_bytes: int
    artifacts: list[str]


def kept_frames(connection: Connection, map_number: int, most: int) -> tuple[list[int], int]:
    """Numbers of frames of a map whose uploads are kept, evenly taken, and how many there are.

    Parameters
    ----------
    connection : of the database
    map_number : of the map
    most : numbers
    """
    of_map = (frames.c.map_number == map_number) & frames.c.state.in_(_KEPT)
    total = int(connection.execute(select(func.count()).where(of_map)).scalar_one())
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
    connection : of the database
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


def count_kept(connection: Connection) -> int:
    """How many frames of all maps have their uploads."""
    asked = select(func.count()).where(frames.c.state.in_(_KEPT))
    return int(connection.execute(asked).scalar_one())


def bytes_of_files(connection: Connection) -> int:
    """Bytes of the archives, meshes and others that are of jobs."""
    return int(connection.execute(select(func.sum(job_files.c.bytes))).scalar() or 0)


def weigh(connection: Connection, numbers: Sequence[int]) -> Weighed:
    """What frames weigh, with what was made of them by whatever model."""
    uploads = signed = 0
    artifacts: list[str] = []
    for first in range(0, len(numbers), _BLOCK):
        some = numbers[first : first + _BLOCK]
        held = select(func.sum(frames.c.bytes)).where(frames.c.number.in_(some))
        uploads += int(connection.execute(held).scalar() or 0)
        made = select(func.length(signatures.c.vector), signatures.c.geometry)
        for size, geometry in connection.execute(made.where(signatures.c.frame_number.in_(some))):
            signed += size
            artifacts.append(geometry)
    return Weighed(uploads, signed, artifacts)
