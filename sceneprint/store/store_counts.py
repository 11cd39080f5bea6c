"""Counts over the whole store that are cheap enough to be asked for often."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection, delete, func, insert, select

from sceneprint.store.tables import count_rows, events, jobs, maps, samples
from sceneprint_client.api import JobState


def count_maps(connection: Connection) -> int:
    """How many maps there are."""
    return int(connection.execute(select(func.count()).select_from(maps)).scalar_one())


def oldest_waiting(connection: Connection, map_number: int | None = None) -> float | None:
    """When the job was made that waits for longest, seconds since 1970; None: none waits.

    The one with the least number: the index that claims are made by has all that it takes.
    """
    first = select(func.min(jobs.c.number)).where(jobs.c.state == JobState.QUEUED)
    if map_number is not None:
        first = first.where(jobs.c.map_number == map_number)
    number = connection.execute(first).scalar()
    if number is None:
        return None
    asked = select(jobs.c.created_at).where(jobs.c.number == number)
    found: float | None = connection.execute(asked).scalar()
    return found


def at_work(connection: Connection, now: float) -> dict[str, str]:
    """Job in hand of each worker that has one, by the worker's name."""
    rows = connection.execute(
        select(jobs.c.worker, jobs.c.id).where(
            jobs.c.state == JobState.RUNNING, jobs.c.leased_until >= now
        )
    )
    return {row.worker: row.id for row in rows if row.worker is not None}


def count_events(
    connection: Connection, kinds: Sequence[str], at: float, width_s: float,
    map_name: str | None = None,
) -> Counter[tuple[int, str]]:  # fmt: skip
    """How many events of some kinds there were in each interval since a time.

    Parameters
    ----------
    kinds : those of `KINDS` of the API
    at : when the first interval begins, seconds since 1970
    width_s : of an interval, seconds
    map_name : only of this map

    Returns
    -------
    counts : by the number of the interval and the kind
    """
    interval = (events.c.at - at) // width_s
    asked = (
        select(interval, events.c.kind, func.count())
        .where(
            events.c.number >= _first_since(connection, at),
            events.c.at >= at,
            events.c.kind.in_(kinds),
        )
        .group_by(interval, events.c.kind)
    )
    if map_name is not None:
        asked = asked.where(events.c.map == map_name)
    return Counter({(int(row[0]), row[1]): row[2] for row in connection.execute(asked)})


def _first_since(connection: Connection, at: float) -> int:
    """Number from which on events are of that time or later: they are in the order of time.

    Found by halving: there is no index of times, and none is needed.
    """
    low = int(connection.execute(select(func.min(events.c.number))).scalar() or 0)
    high = int(connection.execute(select(func.max(events.c.number))).scalar() or 0) + 1
    while low < high:
        middle = (low + high) // 2
        found = connection.execute(
            select(events.c.number, events.c.at)
            .where(events.c.number >= middle)
            .order_by(events.c.number)
            .limit(1)
        ).first()
        if found is None or found.at >= at:
            high = middle
        else:
            low = int(found.number) + 1
    return low


# Samples: what each process counted in the last seconds, for a short history of all of them.

#: Seconds that samples are kept.
KEPT_S = 7200.0
#: Samples removed with one that is added: more than are ever added at once.
_SWEPT = 100


@dataclass(frozen=True)
class Sample:
    """What one process counted.

    Parameters
    ----------
    at : end of the time in which it was counted, seconds since 1970
    data : by kind
    """

    at: float
    data: dict[str, Any]


def add_sample(connection: Connection, kind: str, process: str, data: dict[str, Any]) -> None:
    """Keep a sample, and remove some of its kind that are older than KEPT_S."""
    now = time.time()
    old = (
        select(samples.c.number)
        .where(samples.c.kind == kind, samples.c.at < now - KEPT_S)
        .order_by(samples.c.number)
        .limit(_SWEPT)
        .with_for_update(skip_locked=True)  # writers of samples wait for no turn, nor each other
    )
    connection.execute(delete(samples).where(samples.c.number.in_(old)))
    connection.execute(insert(samples).values(at=now, process=process, kind=kind, data=data))


def samples_since(connection: Connection, kind: str, at: float) -> list[Sample]:
    """Samples of all processes from a time on, the oldest first."""
    of_kind = select(samples.c.at, samples.c.data).where(samples.c.kind == kind, samples.c.at >= at)
    return [Sample(*row) for row in connection.execute(of_kind.order_by(samples.c.at))]


def count_samples(connection: Connection, kind: str, at: float) -> int:
    """How many samples of a kind there are from a time on."""
    return count_rows(connection, samples.c.kind == kind, samples.c.at >= at)
