"""Counts over the whole store, and samples of the counts of processes."""

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
    """Return the number of maps."""
    return int(connection.execute(select(func.count()).select_from(maps)).scalar_one())


def oldest_waiting(connection: Connection, map_number: int | None = None) -> dict[str, float]:
    """Return the creation time of the oldest queued job by kind, seconds since 1970."""
    first = select(func.min(jobs.c.number)).where(jobs.c.state == JobState.QUEUED)
    if map_number is not None:
        first = first.where(jobs.c.map_number == map_number)
    numbers = [row[0] for row in connection.execute(first.group_by(jobs.c.kind))]
    rows = connection.execute(
        select(jobs.c.kind, jobs.c.created_at).where(jobs.c.number.in_(numbers))
    )
    return {row.kind: row.created_at for row in rows}


def running_jobs(connection: Connection, now: float) -> dict[str, str]:
    """Return the ids of running jobs whose lease has not expired, by worker name."""
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
    """Count events of some kinds in consecutive intervals.

    Parameters
    ----------
    kinds : event kinds, from `KINDS` of the API
    at : start of the first interval, seconds since 1970
    width_s : length of the intervals, seconds
    map_name : name of the map; default: all maps

    Returns
    -------
    counts : number of events by index of the interval and kind
    """
    interval = (events.c.at - at) // width_s
    statement = (
        select(interval, events.c.kind, func.count())
        .where(
            events.c.number >= _first_since(connection, at),
            events.c.at >= at,
            events.c.kind.in_(kinds),
        )
        .group_by(interval, events.c.kind)
    )
    if map_name is not None:
        statement = statement.where(events.c.map == map_name)
    return Counter({(int(row[0]), row[1]): row[2] for row in connection.execute(statement)})


def _first_since(connection: Connection, at: float) -> int:
    """Return the number of the first event at or after a time, by a binary search."""
    low = int(connection.execute(select(func.min(events.c.number))).scalar() or 0)
    high = int(connection.execute(select(func.max(events.c.number))).scalar() or 0) + 1
    while low < high:
        middle = (low + high) // 2
        row = connection.execute(
            select(events.c.number, events.c.at)
            .where(events.c.number >= middle)
            .order_by(events.c.number)
            .limit(1)
        ).first()
        if row is None or row.at >= at:
            high = middle
        else:
            low = int(row.number) + 1
    return low


# Samples: counts of a process over some seconds, stored as a short history.

#: Seconds after which samples are removed.
SAMPLES_S = 7200.0


@dataclass(frozen=True)
class Sample:
    """Counts of a process in an interval.

    Parameters
    ----------
    at : end of the interval, seconds since 1970
    """

    at: float
    data: dict[str, Any]


def add_sample(connection: Connection, kind: str, process: str, data: dict[str, Any]) -> None:
    """Store a sample, and remove up to 100 samples of its kind that are older than SAMPLES_S."""
    now = time.time()
    old = (
        select(samples.c.number)
        .where(samples.c.kind == kind, samples.c.at < now - SAMPLES_S)
        .order_by(samples.c.number)
        .limit(100)
        .with_for_update(skip_locked=True)  # writers of samples take no turns
    )
    connection.execute(delete(samples).where(samples.c.number.in_(old)))
    connection.execute(insert(samples).values(at=now, process=process, kind=kind, data=data))


def samples_since(connection: Connection, kind: str, at: float) -> list[Sample]:
    """Return the samples of all processes since time `at`, oldest first."""
    of_kind = select(samples.c.at, samples.c.data).where(samples.c.kind == kind, samples.c.at >= at)
    return [Sample(*row) for row in connection.execute(of_kind.order_by(samples.c.at))]


def count_samples(connection: Connection, kind: str, at: float) -> int:
    """Count the samples of a kind since time `at`, seconds since 1970."""
    return count_rows(connection, samples.c.kind == kind, samples.c.at >= at)
