"""Figures for Prometheus."""

from __future__ import annotations

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, generate_latest

from sceneprint.schemas import Answer, FrameState, JobState

_SECONDS = (0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0)


class Metrics:
    """What one service process counts."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        self._requests = Counter(
            "sceneprint_requests", "Requests answered.", ("method", "route", "status"),
            registry=self.registry,
        )  # fmt: skip
        self._seconds = Histogram(
            "sceneprint_request_seconds", "Time to answer a request.", ("route",),
            buckets=_SECONDS, registry=self.registry,
        )  # fmt: skip
        self._answers = Counter(
            "sceneprint_answers", "Queries by the status of their answer.", ("status",),
            registry=self.registry,
        )  # fmt: skip
        self._stages = Histogram(
            "sceneprint_stage_seconds", "Time of each stage of a query.", ("stage",),
            buckets=_SECONDS, registry=self.registry,
        )  # fmt: skip
        self._frames = Gauge(
            "sceneprint_frames", "Frames in each state.", ("state",), registry=self.registry
        )
        self._jobs = Gauge(
            "sceneprint_jobs", "Jobs in each state.", ("state",), registry=self.registry
        )

    def request(self, method: str, route: str, status: int, seconds: float) -> None:
        """Count a request; `route` is a pattern, so that series stay few."""
        self._requests.labels(method, route, str(status)).inc()
        self._seconds.labels(route).observe(seconds)

    def answer(self, answer: Answer) -> None:
        """Count a query."""
        self._answers.labels(answer.status).inc()
        for stage, milliseconds in answer.milliseconds.items():
            self._stages.labels(stage).observe(milliseconds / 1e3)

    def text(self, frames: dict[str, int], jobs: dict[str, int]) -> bytes:
        """All figures in Prometheus' text format."""
        for state in FrameState:
            self._frames.labels(state).set(frames.get(state, 0))
        for kind in JobState:
            self._jobs.labels(kind).set(jobs.get(kind, 0))
        return generate_latest(self.registry)
