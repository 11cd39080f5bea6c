"""Spans of OpenTelemetry: how long a request, its queries' stages, and the jobs it queued took.

Off unless SCENEPRINT_TRACES_URL names a collector. A job carries the `traceparent` of the request
that queued it, so that an upload and its signing are one trace over processes and hosts.

    request --(traceparent in the job)--> job --> decode, sign, artifact, commit
    query   --> prepare, retrieve, diversify, validate, locate
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from opentelemetry.trace import Tracer

#: Attributes of a span, by OpenTelemetry's names, such as `http.route`.
Attributes = Mapping[str, str | int]
#: Milliseconds between two messages to the collector, and for one of them at most.
EVERY_MS, TIMEOUT_MS = 2000, 5000

_tracer: Tracer | None = None


@contextmanager
def tracing(url: str | None, process: str, version: str) -> Iterator[None]:
    """Send the spans that end meanwhile to a collector; what is left is sent at the end.

    A collector that is away costs the spans, a line of the log, and nothing else.

    Parameters
    ----------
    url : of a collector that speaks OTLP over HTTP, such as http://127.0.0.1:4318; None for none
    process, version : what spans say of this process
    """
    global _tracer  # one for each process, as that of OpenTelemetry is
    if url is None:
        yield
        return
    from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter
    from opentelemetry.sdk.resources import Resource
    from opentelemetry.sdk.trace import TracerProvider
    from opentelemetry.sdk.trace.export import BatchSpanProcessor

    exporter = OTLPSpanExporter(f"{url.rstrip('/')}/v1/traces", timeout=TIMEOUT_MS / 1e3)
    about = {"service.name": process, "service.version": version}
    provider = TracerProvider(resource=Resource.create(about), shutdown_on_exit=False)
    provider.add_span_processor(
        BatchSpanProcessor(
            exporter, schedule_delay_millis=EVERY_MS, export_timeout_millis=TIMEOUT_MS
        )
    )
    _tracer = provider.get_tracer("sceneprint", version)
    try:
        yield
    finally:
        _tracer = None
        provider.shutdown()


@contextmanager
def span(
    name: str,
    parent: str | None = None,
    kind: str = "INTERNAL",
    attributes: Attributes | None = None,
) -> Iterator[None]:
    """A span of what is done meanwhile, below the current one; nothing where nothing is traced.

    Parameters
    ----------
    name : short, of few kinds
    parent : `traceparent` of another process; an invalid one is ignored
    kind : of OpenTelemetry: SERVER, CONSUMER or INTERNAL
    attributes : of the span
    """
    if _tracer is None:
        yield
        return
    from opentelemetry.trace import SpanKind
    from opentelemetry.trace.propagation.tracecontext import TraceContextTextMapPropagator

    given = None if parent is None else {"traceparent": parent}
    context = None if given is None else TraceContextTextMapPropagator().extract(given)
    with _tracer.start_as_current_span(name, context, SpanKind[kind], attributes):
        yield


def name_span(name: str, attributes: Attributes) -> None:
    """Rename and describe the current span: a request's route is known only at its end."""
    if _tracer is not None:
        from opentelemetry.trace import get_current_span

        current = get_current_span()
        current.update_name(name)
        current.set_attributes(attributes)


def record_span(name: str, seconds: float) -> None:
    """A span below the current one, of what ends now and took so long."""
    if _tracer is not None:
        end = time.time_ns()
        _tracer.start_span(name, start_time=end - int(1e9 * seconds)).end(end)


def traceparent() -> str | None:
    """The current span for another process, as W3C's Trace Context writes it."""
    if _tracer is None:
        return None
    from opentelemetry.trace.propagation.tracecontext import TraceContextTextMapPropagator

    carrier: dict[str, str] = {}
    TraceContextTextMapPropagator().inject(carrier)
    return carrier.get("traceparent")
