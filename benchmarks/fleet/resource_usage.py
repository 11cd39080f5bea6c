"""Meters of work: processors, turns, commits, and the bytes of a log, between two readings.

Meter(pair).running  -->  Work, each
"""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

from sqlalchemy import Connection

from benchmarks.fleet.postgres_pair import Pair
from benchmarks.fleet.s3 import ObjectServer
from benchmarks.machine import own_bytes
from sceneprint.cli.demo import serving
from sceneprint.formats.dataset import FrameReference
from sceneprint.store.database import Database
from sceneprint_client import Client

#: Ticks of a process's clock in a second.
_TICKS = os.sysconf("SC_CLK_TCK")


@dataclass(frozen=True)
class Work:
    """What something cost, each.

    Parameters
    ----------
    wall_ms : median
    own_ms, database_ms : of a processor, in this process and in the primary's
    turn_ms : in which no other process could write to the map
    commits : in turn, and of those that need none
    wal_bytes : of the primary's log
    requests : to the object store, by method
    """

    wall_ms: float
    own_ms: float
    database_ms: float
    turn_ms: float
    commits: tuple[float, float]
    wal_bytes: float
    requests: Mapping[str, float]


class Meter:
    """Counts what happens between two readings.

    Parameters
    ----------
    pair : whose primary is asked
    objects : whose requests are counted
    """

    def __init__(self, pair: Pair, objects: ObjectServer) -> None:
        self._pair, self._objects = pair, objects
        self._turn_s = 0.0
        self._commits = [0, 0]

    @contextmanager
    def running(self) -> Iterator[Callable[[Sequence[float]], Work]]:
        """Measure; what is given is asked in the end, with the seconds of each thing done."""
        write = Database.write
        meter = self

        @contextmanager
        def timed(database: Database, *, turn: bool = True, **how: Any) -> Iterator[Connection]:
            begun = time.perf_counter()
            with write(database, turn=turn, **how) as connection:
                yield connection
            meter._commits[not turn] += 1
            if turn:
                meter._turn_s += time.perf_counter() - begun

        before, asked = self._reading(), self._objects.requests()

        def told(seconds: Sequence[float]) -> Work:
            after = self._reading()
            own, database, turn, commits, others, wal = (
                (b - a) / len(seconds) for a, b in zip(before, after, strict=True)
            )
            return Work(
                1e3 * statistics.median(seconds), 1e3 * own, 1e3 * database, 1e3 * turn,
                (commits, others), wal,
                {method: count / len(seconds) for method, count in
                 (self._objects.requests() - asked).items()},
            )  # fmt: skip

        Database.write = timed  # type: ignore[method-assign, assignment]
        try:
            yield told
        finally:
            Database.write = write  # type: ignore[method-assign]

    def _reading(self) -> tuple[float, ...]:
        primary = self._pair.primary
        [(wal,)] = primary.execute("SELECT pg_wal_lsn_diff(pg_current_wal_lsn(), '0/0')::bigint")
        spent = _spent(int((primary.data / "postmaster.pid").read_text().split()[0]))
        own = time.process_time()
        return own, spent, self._turn_s, *self._commits, cast(int, wal)


def _spent(postmaster: int) -> float:
    """Seconds of a processor that a server's processes took, those that ended as well."""
    ticks = 0
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = path.read_text().rpartition(")")[2].split()
        except OSError:  # it ended meanwhile
            continue
        if path.parent.name == str(postmaster):
            ticks += sum(int(one) for one in fields[11:15])
        elif int(fields[1]) == postmaster:
            ticks += int(fields[11]) + int(fields[12])
    return ticks / _TICKS


def memory_of(folder: Path, frames: Sequence[FrameReference]) -> dict[str, int]:
    """Bytes that a service and its worker have for themselves, after uploads and queries."""
    (folder / "memory").mkdir()
    with serving(folder / "memory", workers=1) as url, Client(url) as client:
        client.create_map("memory", model="depth")
        added = [client.upload("memory", frame) for frame in frames[:30]]
        client.wait([one.job_id for one in added])
        for frame in frames[:5]:
            client.query("memory", frame)
        found = {}
        for path in Path("/proc").glob("[0-9]*/cmdline"):
            try:
                line = path.read_bytes()
                parent = int((path.parent / "stat").read_text().rpartition(")")[2].split()[1])
                if str(folder / "memory").encode() in line and b"serve" in line:
                    found["service"] = own_bytes(path.parent)
                elif b"spawn_main" in line and _serves(parent, folder / "memory"):
                    found["worker"] = own_bytes(path.parent)
            except OSError:  # it ended meanwhile
                continue
    return found


def _serves(process: int, folder: Path) -> bool:
    return str(folder).encode() in Path(f"/proc/{process}/cmdline").read_bytes()
