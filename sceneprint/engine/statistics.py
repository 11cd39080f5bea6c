"""How the service does now, and did in the last hour: from the store, whoever wrote it.

frames, jobs, events, samples  --Statistics.tell-->  Stats
"""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sqlalchemy import Connection

from sceneprint.engine.lags import index_state, index_states
from sceneprint.engine.latencies import merged, quantile
from sceneprint.engine.sizes import sizes, sizes_of_map
from sceneprint.engine.wire import when
from sceneprint.errors import SceneprintError
from sceneprint.schemas import JobState
from sceneprint.schemas.operations import (
    OUTCOMES,
    Counted,
    IndexState,
    Latency,
    MapUse,
    Minute,
    ReplicaSeen,
    Sizes,
    Stats,
    WorkerSeen,
)
from sceneprint.settings import Settings
from sceneprint.store import Store
from sceneprint.store.bell import Bell
from sceneprint.store.clock import read_clock
from sceneprint.store.events import newest_number
from sceneprint.store.figures import (
    at_work,
    count_events,
    count_jobs_of,
    count_maps,
    oldest_waiting,
)
from sceneprint.store.frames import count_states
from sceneprint.store.listing import count_jobs
from sceneprint.store.maps import count_frames, find_map
from sceneprint.store.records import MapRow
from sceneprint.store.samples import Sample, add_sample, count_samples, samples_since

MINUTE_S, HOUR_S = 60.0, 3600.0
#: Seconds for which the sizes of folders, which take long to measure, are told again.
MEASURED_S = 30.0
#: Seconds for which figures are told again: whoever asks, and however often, it costs little.
TOLD_S = 1.0
#: What samples are kept of: what a service counted, and workers that began.
SERVICE, WORKER = "service", "worker"


@dataclass(frozen=True)
class Figures:
    """How the whole store is.

    Parameters
    ----------
    frames, jobs : number in each state that has any
    maps : number
    oldest_waiting_s : see Stats; 0 where none waits
    indexes, workers, sizes : see Stats
    began : workers that began in the last hour
    events : number of the newest event
    replica : see Stats
    """

    frames: dict[str, int]
    jobs: dict[str, int]
    maps: int
    oldest_waiting_s: float
    indexes: list[IndexState]
    workers: list[WorkerSeen]
    sizes: Sizes
    began: int
    events: int
    replica: ReplicaSeen | None = None


class Statistics:
    """Figures of one store.

    Parameters
    ----------
    store, settings, bell : see there
    """

    def __init__(self, store: Store, settings: Settings, bell: Bell) -> None:
        self._store, self._settings, self._bell = store, settings, bell
        self._sizes: tuple[float, Sizes] | None = None
        self._sizes_of: dict[int, tuple[float, Sizes]] = {}
        self._figures: tuple[float, Figures] | None = None
        self._lock = threading.Lock()

    def tell(self, minutes: int = 60, map_name: str | None = None) -> Stats:
        """All figures, of the whole store or of one map.

        Parameters
        ----------
        minutes : of history, from 1 to 60
        map_name : only of this map

        Raises
        ------
        UnknownMap : no such map.
        """
        now = time.time()
        start = (now // MINUTE_S - minutes + 1) * MINUTE_S
        with self._store.database.read() as connection:
            row = None if map_name is None else find_map(connection, map_name)
            kinds = [f"frame.{outcome}" for outcome in OUTCOMES]
            happened = count_events(connection, kinds, start, MINUTE_S, map_name)
            samples: list[Sample] | None = None
            if row is None:
                frames, jobs = count_states(connection), count_jobs(connection)
                maps, indexes = count_maps(connection), index_states(connection, self._indexes)
                samples = samples_since(connection, SERVICE, start)
                oldest = oldest_waiting(connection)
                workers = self.workers(connection)
            else:
                frames = count_frames(connection, row.number)
                jobs = count_jobs_of(connection, row.number)
                maps, indexes = 1, [index_state(connection, self._indexes, row)]
                oldest, workers = oldest_waiting(connection, row.number), None
            taken = None if row is None else self._sizes_of_map(connection, row)
        return Stats(
            at=when(now),
            map=map_name,
            maps=maps,
            frames=frames,
            jobs=jobs,
            waiting=jobs.get(JobState.QUEUED, 0),
            oldest_waiting_s=None if oldest is None else max(now - oldest, 0.0),
            indexes=indexes,
            workers=workers,
            bytes=taken or self.sizes(),
            use=None if row is None else _use(row),
            replica=self.replica() if row is None else None,
            total=Counted(**_counted(happened, range(minutes), samples)),
            minutes=_minutes(happened, samples, start, minutes),
        )

    @property
    def _indexes(self) -> Path:
        return self._settings.indexes

    def figures(self) -> Figures:
        """The whole store, looked at now and then."""
        with self._lock:  # who comes meanwhile waits, and is told the same
            now = time.monotonic()
            if self._figures is None or now - self._figures[0] > TOLD_S:
                self._figures = now, self._look()
            return self._figures[1]

    def replica(self) -> ReplicaSeen | None:
        """How the read replica does, if there is one."""
        if self._store.replica is None:
            return None
        found = self._store.replica.standing()
        behind_s = None if found.behind_s is None else round(found.behind_s, 3)
        return ReplicaSeen(used=found.used, behind_s=behind_s)

    def began(self, worker: str) -> None:
        """Note that a worker has begun; where that cannot be written, nobody will know."""
        with suppress(SceneprintError), self._store.database.write(turn=False) as connection:
            add_sample(connection, WORKER, worker, {})

    def _look(self) -> Figures:
        now = time.time()
        with self._store.database.read() as connection:
            oldest = oldest_waiting(connection)
            return Figures(
                frames=count_states(connection),
                jobs=count_jobs(connection),
                maps=count_maps(connection),
                oldest_waiting_s=0.0 if oldest is None else max(now - oldest, 0.0),
                indexes=index_states(connection, self._indexes),
                workers=self.workers(connection),
                sizes=self.sizes(),
                began=count_samples(connection, WORKER, now - HOUR_S),
                events=newest_number(connection),
                replica=self.replica(),
            )

    def workers(self, connection: Connection) -> list[WorkerSeen]:
        """Processes that wait for jobs, with SQLite on this machine, and those that have one."""
        busy = at_work(connection, read_clock(connection))
        names = sorted({*self._bell.listeners(connection), *busy})
        return [WorkerSeen(name=name, job_id=busy.get(name)) for name in names]

    def sizes(self) -> Sizes:
        """Bytes on the disk, measured now and then."""
        now = time.monotonic()
        if self._sizes is None or now - self._sizes[0] > MEASURED_S:
            self._sizes = now, sizes(self._settings, self._store)
        return self._sizes[1]

    def _sizes_of_map(self, connection: Connection, row: MapRow) -> Sizes:
        now = time.monotonic()
        kept = {n: one for n, one in list(self._sizes_of.items()) if now - one[0] <= MEASURED_S}
        if row.number not in kept:  # two that ask at once measure twice, and tell the same
            found = sizes_of_map(connection, self._store, self._indexes, row)
            kept[row.number] = now, found
            self._sizes_of = kept
        return kept[row.number][1]


def _use(row: MapRow) -> MapUse:
    return MapUse(
        frames=row.used_frames,
        bytes=row.used_bytes,
        quota_frames=row.quota_frames,
        quota_bytes=row.quota_bytes,
        retention_days=row.retention_days,
    )


def _minutes(
    happened: Mapping[tuple[int, str], int], samples: list[Sample] | None, start: float, count: int
) -> list[Minute]:
    """What happened in each minute; a minute in which nothing did is told too."""
    of_minute: dict[int, list[Sample]] = {place: [] for place in range(count)}
    for sample in samples or ():
        place = int((sample.at - start) // MINUTE_S)
        if place in of_minute:  # a clock that was set back may be ahead of now
            of_minute[place].append(sample)
    return [
        Minute(
            at=when(start + place * MINUTE_S),
            **_counted(
                happened, range(place, place + 1), None if samples is None else of_minute[place]
            ),
        )
        for place in range(count)
    ]


def _counted(
    happened: Mapping[tuple[int, str], int], places: range, samples: list[Sample] | None
) -> dict[str, Any]:
    """Fields of `Counted` for some minutes."""
    told: dict[str, Any] = {
        outcome: sum(happened.get((place, f"frame.{outcome}"), 0) for place in places)
        for outcome in OUTCOMES
    }
    if samples is None:
        return told | dict.fromkeys(("queries", "latency", "requests", "refused", "busy", "broken"))
    queries: Counter[str] = Counter()
    statuses: Counter[int] = Counter()
    for sample in samples:
        queries.update(sample.data["queries"])
        statuses.update({int(status): n for status, n in sample.data["statuses"].items()})
    return told | {
        "queries": dict(queries),
        "latency": _latency([sample.data["latencies"] for sample in samples]),
        "requests": sum(statuses.values()),
        "refused": sum(n for status, n in statuses.items() if 400 <= status < 500),
        "busy": statuses[503],
        "broken": sum(n for status, n in statuses.items() if status >= 500 and status != 503),
    }


def _latency(parts: list[dict[str, int]]) -> Latency | None:
    histogram = merged(parts)  # type: ignore[arg-type]
    found = [quantile(histogram, share) for share in (0.5, 0.95, 0.99)]
    if any(one is None for one in found):
        return None
    p50, p95, p99 = (round(one, 6) for one in found if one is not None)
    return Latency(p50=p50, p95=p95, p99=p99)
