"""Metrics for Prometheus.

Counters of a process (requests, answers, streams) add up over processes. Gauges of the store
(frames, jobs, indexes, disk) are the same in all processes.
"""

from __future__ import annotations

import logging
import os
import platform
import socket
import threading
from collections import Counter as Tally
from collections.abc import Mapping
from typing import Any

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, generate_latest

from sceneprint import __version__
from sceneprint.engine.admin.statistics import SERVICE, Figures
from sceneprint.errors import SceneprintError
from sceneprint.process import NOBODY, Latencies
from sceneprint.store import Database
from sceneprint.store.store_counts import add_sample
from sceneprint_client.api import Answer, FrameState, JobState

# Counts of this process in the last seconds, written to the database regularly.
#
#     requests, answers  -->  Sampler  --flush-->  table `samples`  -->  GET /v1/stats

log = logging.getLogger(__name__)

#: Seconds between two samples.
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
#: Number of maps whose indexes have their own series: those with the longest tails.
MOST_MAPS = 20
#: Number of tenants with their own series, in the order in which the process meets them. All other
#: tenants share one series, whose name no tenant can have.
MOST_TENANTS, OTHERS = 50, "(others)"


class TenantMetrics:
    """Metrics of the tenants of keys: their requests in one process, and their waiting jobs."""

    def __init__(self, registry: CollectorRegistry) -> None:
        self._requests = Counter(
            "sceneprint_tenant_requests", "Number of answered requests of each tenant.",
            ("tenant", "status"), registry=registry,
        )  # fmt: skip
        self._seconds = Counter(
            "sceneprint_tenant_request_seconds", "Time of the tenant's requests without streams.",
            ("tenant",), registry=registry,
        )  # fmt: skip
        self._now = {
            name: Gauge(f"sceneprint_tenant_{name}", text, ("tenant",), registry=registry)
            for name, text in (
                ("requests_in_progress", "Number of requests in progress."),
                ("spool_bytes", "Size of request bodies on disk."),
                ("waiting_jobs", "Number of jobs that wait for a worker."),
            )
        }
        self._named: set[str] = set()

    def request(self, tenant: str, status: int, seconds: float) -> None:
        """Count a request."""
        name = self._name(tenant)
        self._requests.labels(name, str(status)).inc()
        self._seconds.labels(name).inc(seconds)

    def update(self, *values: Mapping[str, int]) -> None:
        """Set requests in progress, bytes on disk and waiting jobs by tenant, without NOBODY."""
        for gauge, by_tenant in zip(self._now.values(), values, strict=True):
            gauge.clear()  # drop tenants that have none left
            for tenant, number in by_tenant.items():
                if tenant != NOBODY:
                    gauge.labels(self._name(tenant)).inc(number)

    def _name(self, tenant: str) -> str:
        if tenant not in self._named and len(self._named) < MOST_TENANTS:
            self._named.add(tenant)
        return tenant if tenant in self._named else OTHERS


class Metrics:
    """Metrics of one service process."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        self.sampler = Sampler()
        self._requests = Counter(
            "sceneprint_requests", "Number of answered requests.", ("method", "route", "status"),
            registry=self.registry,
        )  # fmt: skip
        self._seconds = Histogram(
            "sceneprint_request_seconds", "Time to answer a request.", ("route",),
            buckets=_SECONDS, registry=self.registry,
        )  # fmt: skip
        self._received = Counter(
            "sceneprint_received_bytes", "Size of the received bodies.", ("route",),
            registry=self.registry,
        )  # fmt: skip
        self._answers = Counter(
            "sceneprint_answers", "Number of queries by status of the answer.", ("status",),
            registry=self.registry,
        )  # fmt: skip
        self._stages = Histogram(
            "sceneprint_stage_seconds", "Time of each stage of a query.", ("stage",),
            buckets=_SECONDS, registry=self.registry,
        )  # fmt: skip
        self._lost = Counter(
            "sceneprint_queries_lost", "Number of queries that could not be logged.",
            registry=self.registry,
        )  # fmt: skip
        self._reported_lost = 0
        self._by_tenant = TenantMetrics(self.registry)
        self._streams = self._gauge("event_streams", "Number of open event streams.")
        self._frames = self._gauge("frames", "Number of frames in each state.", "state")
        self._jobs = self._gauge("jobs", "Number of jobs in each state.", "state")
        self._maps = self._gauge("maps", "Number of maps.")
        self._oldest = self._gauge(
            "oldest_waiting_seconds", "Age of the oldest waiting job of each kind.", "kind"
        )
        self._oldest_frame = self._gauge(
            "oldest_unsigned_seconds", "Age of the oldest frame without a signature; 0 for none."
        )
        self._version = self._gauge(
            "index_version", "Newest index; of the maps with the longest tails.", "map"
        )
        self._tail = self._gauge(
            "index_tail_frames", "Indexed frames that the newest index lacks; of these maps.", "map"
        )
        self._workers = self._gauge("workers", "Number of busy and idle workers.", "state")
        self._began = self._gauge(
            "workers_began", "Number of workers that started in the last hour. A number above that "
            "of the configured workers means restarts."
        )  # fmt: skip
        self._events = self._gauge("newest_event", "Number of the newest event; it only grows.")
        self._disk = self._gauge("disk_bytes", "Disk space of each part of the store.", "part")
        self._scrubbed = self._gauge("scrub_bytes", "Size of the data that this scrub has read.")
        self._damaged = self._gauge("scrub_damaged", "Lost and damaged objects in this scrub.")
        self._free = self._gauge("disk_free_bytes", "Free space on the disk of the data folder.")
        self._gauge("build_info", "Version of the service.", "version", "python").labels(
            __version__, platform.python_version()
        ).set(1)

    def _gauge(self, name: str, text: str, *labels: str) -> Gauge:
        return Gauge(f"sceneprint_{name}", text, labels, registry=self.registry)

    def request(
        self, method: str, route: str, status: int, seconds: float, received: int = 0,
        tenant: str = NOBODY,
    ) -> None:  # fmt: skip
        """Count a request. `route` is a pattern, which limits the number of series."""
        self._requests.labels(method, route, str(status)).inc()
        if tenant != NOBODY:
            self._by_tenant.request(tenant, status, 0.0 if route == EVENTS else seconds)
        if received:
            self._received.labels(route).inc(received)
        if route != EVENTS:  # a stream lasts as long as its client
            self._seconds.labels(route).observe(seconds)
        if route.startswith("/v1/"):
            self.sampler.request(status)

    def answer(self, answer: Answer) -> None:
        """Count the answer to a query."""
        self._answers.labels(answer.status).inc()
        self.sampler.answer(answer)
        for stage, milliseconds in answer.milliseconds.items():
            self._stages.labels(stage).observe(milliseconds / 1e3)

    def text(
        self, figures: Figures, streams: int, lost: int, held: Mapping[str, int],
        spool: Mapping[str, int],
    ) -> bytes:  # fmt: skip
        """Return all metrics in the text format of Prometheus.

        Parameters
        ----------
        figures : statistics of the store
        streams : number of open event streams
        lost : number of queries lost since the start of the process
        held, spool : requests in progress, and bytes of bodies on disk, by tenant
        """
        self._by_tenant.update(held, spool, figures.waiting)
        self._lost.inc(lost - self._reported_lost)
        self._reported_lost = lost
        stats, workers = figures.stats, figures.stats.workers or []
        for state in FrameState:
            self._frames.labels(state).set(stats.frames.get(state, 0))
        for kind in JobState:
            self._jobs.labels(kind).set(stats.jobs.get(kind, 0))
        self._streams.set(streams)
        self._scrubbed.set(0 if stats.scrub is None else stats.scrub.bytes)
        self._damaged.set(0 if stats.scrub is None else stats.scrub.damaged)
        self._maps.set(stats.maps)
        self._oldest.clear()
        for waiting, age in stats.oldest_waiting_s.items():
            self._oldest.labels(waiting).set(age)
        self._oldest_frame.set(stats.oldest_waiting_s.get("sign", 0.0))
        for gauge in (self._version, self._tail):
            gauge.clear()  # drop deleted maps
        for index in stats.indexes[:MOST_MAPS]:
            self._version.labels(index.map).set(index.version or 0)
            self._tail.labels(index.map).set(index.tail)
        busy = sum(worker.job_id is not None for worker in workers)
        self._workers.labels("busy").set(busy)
        self._workers.labels("idle").set(len(workers) - busy)
        self._began.set(figures.began)
        self._events.set(figures.events)
        self._disk.labels("database").set(stats.bytes.database or 0)
        self._disk.labels("blobs").set(stats.bytes.blobs)
        self._disk.labels("index").set(stats.bytes.index)
        self._free.set(stats.bytes.free or 0)
        return generate_latest(self.registry)
