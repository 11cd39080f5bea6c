"""Metrics for Prometheus.

Counters (requests, answers, streams) are per process: sum them over all processes. Gauges of the
store (frames, jobs, indexes, disk) are the same in all processes.
"""

from __future__ import annotations

import logging
import os
import platform
import socket
import threading
from collections import Counter as Tally
from collections.abc import Mapping
from typing import Any, NamedTuple

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, generate_latest

from sceneprint import __version__
from sceneprint.engine.admin.statistics import SERVICE, Figures
from sceneprint.errors import SceneprintError
from sceneprint.process import NOBODY, Latencies
from sceneprint.store import Database
from sceneprint.store.store_counts import add_sample
from sceneprint_client.api import Answer, FrameState, JobState

# Counts of this process over some seconds, written to the database at intervals.
#
#     requests, answers  -->  Sampler  --flush-->  table `samples`  -->  GET /v1/stats

log = logging.getLogger(__name__)

#: Seconds between samples.
EVERY_S = 10.0


class Sampler:
    """Counter of requests and answers; thread-safe."""

    def __init__(self) -> None:
        self._process = f"{socket.gethostname()}:{os.getpid()}"
        self._lock = threading.Lock()
        self._begin()

    def _begin(self) -> None:
        self._statuses: Tally[str] = Tally()
        self._queries: Tally[str] = Tally()
        self._latencies = Latencies()

    def request(self, status: int) -> None:
        """Count a request."""
        with self._lock:
            self._statuses[str(status)] += 1

    def answer(self, answer: Answer) -> None:
        """Count the answer to a query."""
        with self._lock:
            self._queries[answer.status] += 1
            if "total" in answer.milliseconds:
                self._latencies.add(answer.milliseconds["total"] / 1e3)

    def flush(self, database: Database) -> bool:
        """Store the counts since the last call; return whether anything was stored.

        If the store is read-only or busy, the counts are lost.
        """
        with self._lock:
            data: dict[str, Any] = {
                "statuses": dict(self._statuses),
                "queries": dict(self._queries),
                "latencies": self._latencies.as_json(),
            }
            self._begin()
        if not any(data.values()) or database.read_only:
            return False
        try:
            with database.write(turn=False) as connection:
                add_sample(connection, SERVICE, self._process, data)
        except SceneprintError as error:
            log.info("metrics sample not stored", extra={"error": str(error)})
            return False
        return True


EVENTS = "/v1/events"
_SECONDS = (0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0)
#: Maximum number of maps with separate series for their indexes, those with the longest tails.
MOST_MAPS = 20
#: Number of tenants with separate series, the first to send requests. All other tenants share one
#: series, whose name no tenant can have.
MOST_TENANTS, OTHERS = 50, "(others)"


class MetricFamily(NamedTuple):
    """A family of time series.

    Parameters
    ----------
    kind : `counter`, `gauge` or `histogram`
    meaning : help text
    labels : names of the labels
    """

    kind: str
    meaning: str
    labels: tuple[str, ...] = ()


#: All metrics by their names without the prefix `sceneprint_`. docs/operations.md lists them.
METRICS = {
    "requests_total": MetricFamily(
        "counter", "Number of answered requests.", ("method", "route", "status")
    ),
    "request_seconds": MetricFamily("histogram", "Time to answer a request.", ("route",)),
    "received_bytes_total": MetricFamily("counter", "Size of the received bodies.", ("route",)),
    "answers_total": MetricFamily("counter", "Number of queries by status.", ("status",)),
    "stage_seconds": MetricFamily("histogram", "Time of each stage of a query.", ("stage",)),
    "queries_lost_total": MetricFamily(
        "counter", "Number of queries that were not recorded; the log says why (`queries lost`)."
    ),
    "event_streams": MetricFamily("gauge", "Number of open event streams."),
    "frames": MetricFamily("gauge", "Number of frames in each state.", ("state",)),
    "jobs": MetricFamily("gauge", "Number of jobs in each state.", ("state",)),
    "maps": MetricFamily("gauge", "Number of maps."),
    "oldest_waiting_seconds": MetricFamily(
        "gauge", "Age of the oldest waiting job of each kind.", ("kind",)
    ),
    "oldest_unsigned_seconds": MetricFamily(
        "gauge", "Age of the oldest frame without a signature; 0 if there is no such frame."
    ),
    "index_version": MetricFamily(
        "gauge", f"Index version of each of the {MOST_MAPS} maps with the longest tails.", ("map",)
    ),
    "index_tail_frames": MetricFamily(
        "gauge",
        "Number of indexed frames of the same maps that are not yet in the newest index.",
        ("map",),
    ),
    "workers": MetricFamily(
        "gauge", "Number of `busy` and `idle` workers; with SQLite, only of this machine.",
        ("state",),
    ),
    "workers_began": MetricFamily(
        "gauge", "Number of workers that started in the last hour. A number above that of the "
        "configured workers means restarts."
    ),
    "newest_event": MetricFamily("gauge", "Number of the newest event; it only grows."),
    "disk_bytes": MetricFamily(
        "gauge", "Disk space of each part of the store, estimated for many blobs.", ("part",)
    ),
    "disk_free_bytes": MetricFamily("gauge", "Free space on the disk of the data folder."),
    "scrub_bytes": MetricFamily("gauge", "Size of the data that this scrub has read."),
    "scrub_damaged": MetricFamily("gauge", "Number of lost or damaged objects in this scrub."),
    "tenant_requests_total": MetricFamily(
        "counter", f"Number of answered requests of each tenant. The first {MOST_TENANTS} tenants "
        f"of a process have their own series; all others share `{OTHERS}`.", ("tenant", "status"),
    ),
    "tenant_request_seconds_total": MetricFamily(
        "counter", "Total time of the tenant's requests, without streams.", ("tenant",)
    ),
    "tenant_requests_in_progress": MetricFamily(
        "gauge", "Number of the tenant's requests in progress.", ("tenant",)
    ),
    "tenant_spool_bytes": MetricFamily(
        "gauge", "Size of the tenant's request bodies on disk.", ("tenant",)
    ),
    "tenant_waiting_jobs": MetricFamily(
        "gauge", "Number of the tenant's jobs that wait for a worker.", ("tenant",)
    ),
    "build_info": MetricFamily("gauge", "Version of the service.", ("version", "python")),
}  # fmt: skip


class TenantMetrics:
    """Metrics by tenant: requests in this process, and waiting jobs."""

    def __init__(self, metrics: Metrics) -> None:
        self._metrics = metrics
        self._named: set[str] = set()

    def request(self, tenant: str, status: int, seconds: float) -> None:
        """Count a request."""
        name = self._name(tenant)
        self._metrics.counters["tenant_requests_total"].labels(name, str(status)).inc()
        self._metrics.counters["tenant_request_seconds_total"].labels(name).inc(seconds)

    def update(self, **values: Mapping[str, int]) -> None:
        """Set `requests_in_progress`, `spool_bytes` and `waiting_jobs` by tenant, except NOBODY."""
        for name, by_tenant in values.items():
            gauge = self._metrics.gauges[f"tenant_{name}"]
            gauge.clear()  # drop tenants without a value
            for tenant, number in by_tenant.items():
                if tenant != NOBODY:
                    gauge.labels(self._name(tenant)).inc(number)

    def _name(self, tenant: str) -> str:
        if tenant not in self._named and len(self._named) < MOST_TENANTS:
            self._named.add(tenant)
        return tenant if tenant in self._named else OTHERS


class Metrics:
    """Metrics of a service process."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        self.sampler = Sampler()
        self.counters: dict[str, Counter] = {}
        self.gauges: dict[str, Gauge] = {}
        self.histograms: dict[str, Histogram] = {}
        for name, (kind, meaning, labels) in METRICS.items():
            full = f"sceneprint_{name}"
            if kind == "counter":
                self.counters[name] = Counter(full, meaning, labels, registry=self.registry)
            elif kind == "gauge":
                self.gauges[name] = Gauge(full, meaning, labels, registry=self.registry)
            else:
                self.histograms[name] = Histogram(
                    full, meaning, labels, buckets=_SECONDS, registry=self.registry
                )
        self.gauges["build_info"].labels(__version__, platform.python_version()).set(1)
        self.tenants = TenantMetrics(self)
        self._reported_lost = 0

    def request(
        self, method: str, route: str, status: int, seconds: float, received: int = 0,
        tenant: str = NOBODY,
    ) -> None:  # fmt: skip
        """Count a request; `route` is its path pattern, and `received` the size of its body."""
        self.counters["requests_total"].labels(method, route, str(status)).inc()
        if tenant != NOBODY:
            self.tenants.request(tenant, status, 0.0 if route == EVENTS else seconds)
        if received:
            self.counters["received_bytes_total"].labels(route).inc(received)
        if route != EVENTS:  # streams last as long as their client
            self.histograms["request_seconds"].labels(route).observe(seconds)
        if route.startswith("/v1/"):
            self.sampler.request(status)

    def answer(self, answer: Answer) -> None:
        """Count the answer to a query."""
        self.counters["answers_total"].labels(answer.status).inc()
        self.sampler.answer(answer)
        for stage, milliseconds in answer.milliseconds.items():
            self.histograms["stage_seconds"].labels(stage).observe(milliseconds / 1e3)

    def text(
        self, figures: Figures, streams: int, lost: int, held: Mapping[str, int],
        spool: Mapping[str, int],
    ) -> bytes:  # fmt: skip
        """Return all metrics in the text format of Prometheus. `lost` is the number of queries that
        were not logged; `held` and `spool` are requests and spooled bytes by tenant.
        """
        self.tenants.update(
            requests_in_progress=held, spool_bytes=spool, waiting_jobs=figures.waiting
        )
        self.counters["queries_lost_total"].inc(lost - self._reported_lost)
        self._reported_lost = lost
        stats, workers, gauges = figures.stats, figures.stats.workers or [], self.gauges
        for state in FrameState:
            gauges["frames"].labels(state).set(stats.frames.get(state, 0))
        for kind in JobState:
            gauges["jobs"].labels(kind).set(stats.jobs.get(kind, 0))
        gauges["event_streams"].set(streams)
        gauges["scrub_bytes"].set(0 if stats.scrub is None else stats.scrub.bytes)
        gauges["scrub_damaged"].set(0 if stats.scrub is None else stats.scrub.damaged)
        gauges["maps"].set(stats.maps)
        for name in ("oldest_waiting_seconds", "index_version", "index_tail_frames"):
            gauges[name].clear()  # drop deleted maps and finished jobs
        for waiting, age in stats.oldest_waiting_s.items():
            gauges["oldest_waiting_seconds"].labels(waiting).set(age)
        gauges["oldest_unsigned_seconds"].set(stats.oldest_waiting_s.get("sign", 0.0))
        for index in stats.indexes[:MOST_MAPS]:
            gauges["index_version"].labels(index.map).set(index.version or 0)
            gauges["index_tail_frames"].labels(index.map).set(index.tail)
        busy = sum(worker.job_id is not None for worker in workers)
        gauges["workers"].labels("busy").set(busy)
        gauges["workers"].labels("idle").set(len(workers) - busy)
        gauges["workers_began"].set(figures.began)
        gauges["newest_event"].set(figures.events)
        gauges["disk_bytes"].labels("database").set(stats.bytes.database or 0)
        gauges["disk_bytes"].labels("blobs").set(stats.bytes.blobs)
        gauges["disk_bytes"].labels("index").set(stats.bytes.index)
        gauges["disk_free_bytes"].set(stats.bytes.free or 0)
        return generate_latest(self.registry)
