"""Statistics of the service, now and over the last hour, from the shared store.

frames, jobs, events, samples  --Statistics.collect-->  Stats
"""

from __future__ import annotations

import logging
import os
import shutil
import stat
import threading
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sqlalchemy import Connection, func, select

from sceneprint.atomic_files import nearest_folder
from sceneprint.engine.context import Context
from sceneprint.engine.search.local_index import index_folder, is_index_folder
from sceneprint.engine.serializers import copy_fields, when
from sceneprint.errors import DamagedIndex, SceneprintError, UnusableStore
from sceneprint.index.index_manifest import IndexManifest, manifests, read_manifest
from sceneprint.process import merged, quantile
from sceneprint.settings import Settings
from sceneprint.store import Blobs, Database, FolderBlobs, Store, frame_queries, store_counts
from sceneprint.store.events import anchor_number, newest_number, number_events
from sceneprint.store.frames import count_states
from sceneprint.store.maps import find_map, list_maps
from sceneprint.store.queue import PENDING, count_jobs, read_clock, waiting_by_tenant
from sceneprint.store.scrub_rows import read_scrub
from sceneprint.store.signatures import count_indexed
from sceneprint.store.tables import MapRow
from sceneprint_client.api import JobState
from sceneprint_client.api.admin import (
    OUTCOMES,
    Counted,
    IndexRecall,
    IndexState,
    Latency,
    MapUse,
    Minute,
    ScrubSeen,
    Sizes,
    Stats,
    WorkerSeen,
)

log = logging.getLogger(__name__)

# State of the search indexes, and the events that anchor them.

#: Maximum number of maps to report; maps that changed most often come first.
MOST = 200


def index_state(connection: Connection, indexes: Path, row: MapRow) -> IndexState:
    """Return the state of a map's newest readable index; `version` is None if none exists."""
    for _, path in manifests(index_folder(indexes, row)):
        manifest = _read(path)
        if manifest is not None and row.pruned_revision <= manifest.revision <= row.revision:
            tail = count_indexed(connection, row.number, manifest.revision)
            recall = IndexRecall(**manifest.recall.model_dump())
            return IndexState(map=row.name, version=manifest.number, tail=tail, recall=recall)
    tail = count_indexed(connection, row.number, 0)
    return IndexState(map=row.name, version=None, tail=tail, recall=None)


def index_states(connection: Connection, indexes: Path) -> list[IndexState]:
    """Return the index states of the MOST maps with the most changes, longest tail first."""
    rows = sorted(list_maps(connection), key=lambda row: -row.revision)[:MOST]
    states = [index_state(connection, indexes, row) for row in rows]
    return sorted(states, key=lambda state: (-state.tail, state.map))


def anchors(indexes: Path) -> frozenset[int]:
    """Return the numbers of the events that anchor the indexes of this machine to the database."""
    if not indexes.is_dir():
        return frozenset()
    folders = [folder for folder in indexes.iterdir() if is_index_folder(folder.name)]
    read = [_read(path) for folder in folders for _, path in manifests(folder)]
    numbers = [anchor_number(manifest.anchor) for manifest in read if manifest is not None]
    return frozenset(number for number in numbers if number is not None)


def _read(path: Path) -> IndexManifest | None:
    try:
        return read_manifest(path)
    except DamagedIndex:
        return None  # readers skip it too


# Disk usage of a store.

#: Maximum number of files to measure; the total size is extrapolated from them.
MEASURED_FILES = 5_000
#: Maximum number of frames to measure per map; they are evenly spaced in upload order.
MEASURED_FRAMES = 1_000
#: With an object store: maximum number of frames to sample, and of objects to measure.
SAMPLED_FRAMES, SAMPLED_OBJECTS = 64, 16
_HERE = func.current_database()


def _bytes_of(folder: Path) -> int:
    """Return the total size, in bytes, of the readable files under a folder."""
    total = 0
    for path in folder.rglob("*"):
        with suppress(OSError):
            status = path.stat()
            total += status.st_size if stat.S_ISREG(status.st_mode) else 0
    return total


def sizes(settings: Settings, store: Store) -> Sizes:
    """Return the bytes used by database, blobs and indexes, and the free bytes of the disk."""
    free, disk = _free_of(settings.data_dir)
    blobs = settings.blobs
    return Sizes(
        database=_of_database(store.database),
        blobs=_of_blobs(blobs) if isinstance(blobs, Path) else _of_objects(store),
        index=_bytes_of(settings.indexes), free=free, disk=disk,
    )  # fmt: skip


def sizes_of_map(connection: Connection, store: Store, indexes: Path, row: MapRow) -> Sizes:
    """Return the bytes used by one map.

    A blob that several frames share counts for each frame, since otherwise the result would reveal
    the content of other maps.
    """
    numbers, total = frame_queries.frames_with_uploads(connection, row.number, MEASURED_FRAMES)
    uploads, signed, blobs = frame_queries.stored_sizes(connection, numbers)
    artifacts = _of_artifacts(store.blobs, blobs)
    share = max(len(numbers), 1)
    return Sizes(
        database=signed * total // share, blobs=(uploads + artifacts) * total // share,
        index=_bytes_of(index_folder(indexes, row)), free=None, disk=None,
    )  # fmt: skip


def _of_database(database: Database) -> int | None:
    if not database.is_sqlite:
        with database.read() as connection:
            return int(connection.execute(select(func.pg_database_size(_HERE))).scalar_one())
    path = database.file
    if path is None:
        return None
    return sum(_size(file) for file in (path, path.with_name(path.name + "-wal")))


def _of_objects(store: Store) -> int:
    """Return the size of the blobs in an object store, bytes, extrapolated from some frames."""
    with store.database.read() as connection:
        sample = frame_queries.sample_frames(connection, SAMPLED_FRAMES)
        uploads, _, artifacts = frame_queries.stored_sizes(connection, sample)
        total = frame_queries.count_uploads(connection)
        files = frame_queries.bytes_of_files(connection)
    each = (uploads + _of_artifacts(store.blobs, artifacts)) / max(len(sample), 1)
    return int(each * total) + files


def _of_artifacts(blobs: Blobs, artifacts: Sequence[str]) -> int:
    """Return the total size of blobs, bytes; in an object store, extrapolate it from a sample."""
    if isinstance(blobs, FolderBlobs):
        return sum(blobs.size(digest) or 0 for digest in artifacts)
    sample = artifacts[:: max(-(-len(artifacts) // SAMPLED_OBJECTS), 1)]
    try:
        size = sum(blobs.size(digest) or 0 for digest in sample)
    except UnusableStore:  # other statistics stay available
        return 0
    return size * len(artifacts) // max(len(sample), 1)


def _of_blobs(folder: Path) -> int:
    """Return the total size, in bytes, of the blobs in a folder, extrapolated from some subfolders.

    File names are hashes, so all subfolders have similar sizes.
    """
    try:
        parts = sorted(entry.path for entry in os.scandir(folder) if entry.is_dir())
    except OSError:
        return 0
    total, n_files = 0, 0
    for done, part in enumerate(parts, 1):
        file_sizes = list(_file_sizes(Path(part)))
        total, n_files = total + sum(file_sizes), n_files + len(file_sizes)
        if n_files >= MEASURED_FILES:
            return total * len(parts) // done
    return total


def _file_sizes(folder: Path) -> Iterator[int]:
    """Yield the size of each file in a folder, bytes."""
    try:
        for entry in os.scandir(folder):
            if entry.is_file(follow_symlinks=False):
                yield _size(entry)
    except OSError:
        return


def _size(path: Path | os.DirEntry[str]) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return 0


def _free_of(folder: Path) -> tuple[int, int]:
    """Return the free and total bytes of the disk of a folder; the folder need not exist."""
    try:
        usage = shutil.disk_usage(nearest_folder(folder))
    except OSError:
        return 0, 0
    return usage.free, usage.total


MINUTE_S, HOUR_S = 60.0, 3600.0
#: Seconds for which measured sizes are cached.
MEASURED_S = 30.0
#: Seconds for which metrics are cached.
METRICS_CACHE_S = 1.0
#: Number of frames and jobs at which a store is large: a background thread then counts it. Maximum
#: share of the time that this thread spends on counting.
MANY, COUNTING = 100_000, 0.01
#: Kinds of samples: request counts of a service, and worker starts.
SERVICE, WORKER = "service", "worker"


@dataclass(frozen=True)
class Figures:
    """Metrics of the whole store.

    Parameters
    ----------
    began : number of times a worker started in the last hour
    events : number of the newest event
    waiting : number of queued jobs by tenant
    """

    stats: Stats
    began: int
    events: int
    waiting: Mapping[str, int]


@dataclass(frozen=True)
class StoreCounts:
    """Counts whose computation time grows with the store.

    Parameters
    ----------
    frames, jobs : frame counts and job counts, by state
    sizes : result of `sizes`
    at : time of the counts, seconds since 1970
    seconds : duration of counting
    """

    frames: Mapping[str, int]
    jobs: Mapping[str, int]
    indexes: Sequence[IndexState]
    sizes: Sizes
    at: float
    seconds: float

    @property
    def is_large(self) -> bool:
        """Return whether the store is too large to be counted on every request."""
        return sum(self.frames.values()) + sum(self.jobs.values()) >= MANY

    @property
    def is_old(self) -> bool:
        """Return whether the counts must be renewed, also because the clock was set back."""
        return not 0 <= time.time() - self.at < self.seconds / COUNTING


def record_start(store: Store, worker: str) -> None:
    """Record the start of a worker; ignore store errors."""
    with suppress(SceneprintError), store.database.write(turn=False) as connection:
        store_counts.add_sample(connection, WORKER, worker, {})


class Statistics:
    """Statistics of a store; safe to share between threads."""

    def __init__(self, context: Context) -> None:
        self._store, self._settings, self._bell = context.store, context.settings, context.bell
        self._counts: StoreCounts | None = None
        self._counting = threading.Lock()  # held while a large store is counted
        self._sizes: tuple[float, Sizes] | None = None
        self._sizes_of: dict[int, tuple[float, Sizes]] = {}
        self._figures: tuple[float, Figures] | None = None
        self._lock = threading.Lock()

    def collect(self, minutes: int = 60, map_name: str | None = None) -> Stats:
        """Return all statistics of the store or of one map.

        Parameters
        ----------
        minutes : length of the history, from 1 to 60
        map_name : map to report; None selects all maps

        Raises
        ------
        UnknownMap : If the map does not exist.
        """
        now = time.time()
        start = (now // MINUTE_S - minutes + 1) * MINUTE_S
        number_events(self._store.database)
        with self._store.database.read() as connection:
            row = None if map_name is None else find_map(connection, map_name)
            kinds = [f"frame.{outcome}" for outcome in OUTCOMES]
            happened = store_counts.count_events(connection, kinds, start, MINUTE_S, map_name)
            samples: list[store_counts.Sample] | None = None
            if row is None:
                counted = self.counts(connection)
                frames, jobs = dict(counted.frames), dict(counted.jobs)
                jobs |= count_jobs(connection, states=PENDING)
                jobs = {state: count for state, count in jobs.items() if count}
                maps, indexes = store_counts.count_maps(connection), list(counted.indexes)
                samples = store_counts.samples_since(connection, SERVICE, start)
                oldest = store_counts.oldest_waiting(connection)
                workers = self.workers(connection)
            else:
                frames = count_states(connection, row.number)
                jobs = count_jobs(connection, row.number)
                maps, indexes = 1, [index_state(connection, self._settings.indexes, row)]
                oldest, workers = store_counts.oldest_waiting(connection, row.number), None
            scrub = None if row is not None else read_scrub(connection)
            used = counted.sizes if row is None else self._sizes_of_map(connection, row)
        return Stats(
            at=when(now), counted_at=when(now if row is not None else counted.at), map=map_name,
            maps=maps, frames=frames, jobs=jobs, waiting=jobs.get(JobState.QUEUED, 0),
            oldest_waiting_s={kind: max(now - at, 0.0) for kind, at in sorted(oldest.items())},
            indexes=indexes, workers=workers, bytes=used,
            use=None if row is None else copy_fields(
                MapUse, row, frames=row.used_frames, bytes=row.used_bytes
            ),
            scrub=None if scrub is None else copy_fields(
                ScrubSeen, scrub, began_at=when(scrub.began_at),
                finished_at=when(scrub.finished_at),
            ),
            total=Counted(**_recent_counts(happened, range(minutes), samples)),
            minutes=_minutes(happened, samples, start, minutes),
        )  # fmt: skip

    def figures(self) -> Figures:
        """Return the metrics of the whole store, at most a second old."""
        with self._lock:  # concurrent requests share one computation
            now = time.monotonic()
            if self._figures is None or now - self._figures[0] > METRICS_CACHE_S:
                self._figures = now, self._collect_figures()
            return self._figures[1]

    def counts(self, connection: Connection) -> StoreCounts:
        """Return the counts of frames and jobs, the index states, and the sizes.

        For a large store, the counts are cached; a background thread renews them, and spends at
        most the share COUNTING of the time on it.
        """
        counts = self._counts
        if counts is None or not counts.is_large:
            return self._count(connection)
        if counts.is_old and self._counting.acquire(blocking=False):
            try:
                threading.Thread(target=self._count_again, name="counts", daemon=True).start()
            except BaseException:  # no thread could be started; the next request retries
                self._counting.release()
                raise
        return counts

    def state_counts(self) -> tuple[dict[str, int], dict[str, int]]:
        """Return the frame counts and the job counts by state; see `counts`."""
        with self._store.database.read() as connection:
            counts = self.counts(connection)
        return dict(counts.frames), dict(counts.jobs)

    def _count_again(self) -> None:
        try:
            with self._store.database.read() as connection:
                self._count(connection)
        except SceneprintError as error:
            log.info("store not counted", extra={"error": str(error)})
        finally:
            self._counting.release()

    def _count(self, connection: Connection) -> StoreCounts:
        began, start = time.time(), time.monotonic()
        self._counts = StoreCounts(
            frames=count_states(connection), jobs=count_jobs(connection),
            indexes=index_states(connection, self._settings.indexes), sizes=self.sizes(), at=began,
            seconds=time.monotonic() - start,
        )  # fmt: skip
        return self._counts

    def _collect_figures(self) -> Figures:
        stats = self.collect(minutes=1)
        with self._store.database.read() as connection:
            began = store_counts.count_samples(connection, WORKER, time.time() - HOUR_S)
            waiting = waiting_by_tenant(connection)
            newest = newest_number(connection)
            return Figures(stats, began, newest, waiting)

    def workers(self, connection: Connection) -> list[WorkerSeen]:
        """Return the processes that wait for a job or run one (on SQLite, only those of this
        machine).
        """
        busy = store_counts.running_jobs(connection, read_clock(connection))
        names = sorted({*self._bell.listeners(connection), *busy})
        return [WorkerSeen(name=name, job_id=busy.get(name)) for name in names]

    def sizes(self) -> Sizes:
        """Return the result of `sizes`, at most MEASURED_S seconds old."""
        now = time.monotonic()
        if self._sizes is None or now - self._sizes[0] > MEASURED_S:
            self._sizes = now, sizes(self._settings, self._store)
        return self._sizes[1]

    def _sizes_of_map(self, connection: Connection, row: MapRow) -> Sizes:
        now = time.monotonic()
        cached = list(self._sizes_of.items())
        recent = {n: entry for n, entry in cached if now - entry[0] <= MEASURED_S}
        if row.number not in recent:
            measured = sizes_of_map(connection, self._store, self._settings.indexes, row)
            recent[row.number] = now, measured
            self._sizes_of = recent
        return recent[row.number][1]


def _minutes(
    happened: Mapping[tuple[int, str], int], samples: list[store_counts.Sample] | None,
    start: float, count: int,
) -> list[Minute]:  # fmt: skip
    """Return a record of counts for each of `count` minutes from `start` (seconds since 1970).

    Parameters
    ----------
    happened : number of events by minute and kind
    samples : request counts of services; None leaves them out
    """
    of_minute: dict[int, list[store_counts.Sample]] = {place: [] for place in range(count)}
    for sample in samples or ():
        place = int((sample.at - start) // MINUTE_S)
        if place in of_minute:  # false for a sample in the future, after a clock was set back
            of_minute[place].append(sample)
    return [
        Minute(
            at=when(start + place * MINUTE_S),
            **_recent_counts(
                happened, range(place, place + 1), None if samples is None else of_minute[place]
            ),
        )
        for place in range(count)
    ]


def _recent_counts(
    happened: Mapping[tuple[int, str], int], places: range,
    samples: list[store_counts.Sample] | None,
) -> dict[str, Any]:  # fmt: skip
    """Return the fields of `Counted` for the minutes `places` together; see `_minutes`."""
    counts: dict[str, Any] = {
        outcome: sum(happened.get((place, f"frame.{outcome}"), 0) for place in places)
        for outcome in OUTCOMES
    }
    if samples is None:
        return counts | dict.fromkeys(
            ("queries", "latency", "requests", "refused", "busy", "broken")
        )
    queries: Counter[str] = Counter()
    statuses: Counter[int] = Counter()
    for sample in samples:
        queries.update(sample.data["queries"])
        statuses.update({int(status): n for status, n in sample.data["statuses"].items()})
    return counts | {
        "queries": dict(queries),
        "latency": _latency([sample.data["latencies"] for sample in samples]),
        "requests": sum(statuses.values()),
        "refused": sum(n for status, n in statuses.items() if 400 <= status < 500),
        "busy": statuses[503],
        "broken": sum(n for status, n in statuses.items() if status >= 500 and status != 503),
    }


def _latency(parts: list[dict[str, int]]) -> Latency | None:
    histogram = merged(parts)  # type: ignore[arg-type]
    quantiles = [quantile(histogram, share) for share in (0.5, 0.95, 0.99)]
    if any(value is None for value in quantiles):
        return None
    p50, p95, p99 = (round(value, 6) for value in quantiles if value is not None)
    return Latency(p50=p50, p95=p95, p99=p99)
