"""Samples: what each process counted in the last seconds, for a short history of all of them."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection, delete, func, insert, select

from sceneprint.store.tables import samples

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
    process : host and process id
    data : by kind
    """

    at: float
    process: str
    data: dict[str, Any]


def add_sample(connection: Connection, kind: str, process: str, data: dict[str, Any]) -> None:
    """Keep a sample, and remove some that are too old."""
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
    found = connection.execute(
        select(samples.c.at, samples.c.process, samples.c.data)
        .where(samples.c.kind == kind, samples.c.at >= at)
        .order_by(samples.c.at)
    )
    return [Sample(*row) for row in found]


def count_samples(connection: Connection, kind: str, at: float) -> int:
    """How many samples of a kind there are from a time on."""
    counted = select(func.count()).where(samples.c.kind == kind, samples.c.at >= at)
    return int(connection.execute(counted).scalar_one())
