"""Progress of the scrub, which verifies all stored bytes: one row for all workers.

A pass reads all frames in slices, in the order of their numbers. A worker that claims a slice sets
the time of the next slice, to limit the total rate of all workers. If the worker dies, another
worker repeats the slice.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace

from sqlalchemy import Connection, insert, select, update

from sceneprint.store.queue import read_clock
from sceneprint.store.tables import frames, scrubs

#: Seconds between slices, and minimum seconds between the starts of two passes.
SLICE_S, PASS_S = 4.0, 86_400.0


@dataclass(frozen=True)
class ScrubRow:
    """Progress of the scrub: the row of the table `scrubs`."""

    number: int
    position: int
    next_at: float
    began_at: float
    finished_at: float | None
    blobs: int
    bytes: int
    damaged: int

    def is_due(self, now: float) -> bool:
        """Return whether a slice is due, or the clock was set back by more than a pass."""
        return not now < self.next_at <= now + PASS_S


def read_scrub(connection: Connection) -> ScrubRow | None:
    """Return the progress of the scrub; None if it has never started."""
    row = connection.execute(select(scrubs)).mappings().first()
    return None if row is None else ScrubRow(**row)


def claim_slice(connection: Connection) -> ScrubRow | None:
    """Claim the next slice in a write transaction; return None if no slice is due."""
    now, row = read_clock(connection), read_scrub(connection)
    if row is None:
        row = ScrubRow(1, 0, now + SLICE_S, now, None, 0, 0, 0)
        connection.execute(insert(scrubs).values(**asdict(row)))
        return row
    if not row.is_due(now):
        return None
    if row.position == 0:  # a new pass starts
        row = replace(row, began_at=now, blobs=0, bytes=0, damaged=0)
    row = replace(row, next_at=now + SLICE_S)
    connection.execute(update(scrubs).values(**asdict(row)))
    return row


def next_frames(connection: Connection, position: int, count: int) -> list[int]:
    """Return the numbers of up to `count` frames after a position."""
    statement = select(frames.c.number).where(frames.c.number > position)
    return list(connection.execute(statement.order_by(frames.c.number).limit(count)).scalars())


def record_slice(connection: Connection, row: ScrubRow, *, finished: bool) -> None:
    """Record the result of a slice in a write transaction.

    Parameters
    ----------
    row : row of `claim_slice` with the position and the counts after the slice
    finished : whether the slice is the last of the pass
    """
    if finished:
        now = read_clock(connection)
        next_at = max(now + SLICE_S, row.began_at + PASS_S)
        row = replace(row, position=0, finished_at=now, next_at=next_at)
    connection.execute(update(scrubs).values(**asdict(row)))
