"""Traces, as a collector of OpenTelemetry receives them from real processes."""

from __future__ import annotations

import gzip
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest
from opentelemetry.proto.collector.trace.v1.trace_service_pb2 import ExportTraceServiceRequest

from benchmarks.waiting import PATIENCE_S

TRACE, PARENT = "4bf92f3577b34da6a3ce929d0e0e4736", "00f067aa0ba902b7"


@dataclass(frozen=True)
class Traced:
    """A span as it came."""

    process: str
    name: str
    trace: str
    id: str
    parent: str
    kind: int
    start: int
    end: int
    attributes: dict[str, object]


class Collector:
    """Receives spans over OTLP/HTTP, as the collector of OpenTelemetry does."""

    def __init__(self) -> None:
        self.spans: list[Traced] = []
        collector = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                body = self.rfile.read(int(self.headers["content-length"]))
                if self.headers.get("content-encoding") == "gzip":
                    body = gzip.decompress(body)
                if self.path == "/v1/traces":
                    collector.take(ExportTraceServiceRequest.FromString(body))
                self.send_response(200)
                self.send_header("content-length", "0")
                self.end_headers()

            def log_message(self, *_: object) -> None:
                """Say nothing."""

        self.server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.server.server_port}"
        self._thread = threading.Thread(target=self.server.serve_forever)
        self._thread.start()

    def take(self, request: ExportTraceServiceRequest) -> None:
        for sender in request.resource_spans:
            about = {one.key: one.value.string_value for one in sender.resource.attributes}
            for scope in sender.scope_spans:
                for one in scope.spans:
                    attributes = {
                        each.key: getattr(each.value, str(each.value.WhichOneof("value")))
                        for each in one.attributes
                    }
                    self.spans.append(
                        Traced(
                            about["service.name"], one.name, one.trace_id.hex(), one.span_id.hex(),
                            one.parent_span_id.hex(), one.kind, one.start_time_unix_nano,
                            one.end_time_unix_nano, attributes,
                        )
                    )  # fmt: skip

    def named(self, name: str) -> list[Traced]:
        return [one for one in self.spans if one.name == name]

    def close(self) -> None:
        self.server.shutdown()
        self._thread.join()
        self.server.server_close()


@pytest.fixture
def collector() -> Iterator[Collector]:
    made = Collector()
    yield made
    made.close()


def test_an_upload_and_its_signing_are_one_trace(begin, make_map, shots, until, collector):
    server = begin(traces_url=collector.url)
    path = make_map(server, "hall")
    headers = {"traceparent": f"00-{TRACE}-{PARENT}-01", "x-request-id": "from-robot-7"}
    sent = server.client.post(f"{path}/frames", headers=headers, **shots[0].form())
    assert sent.status_code == 202
    job = sent.json()["job_id"]
    until(lambda: server.client.get(f"/v1/jobs/{job}").json()["state"] == "succeeded")
    asked = server.client.post(f"{path}/queries", **shots[0].form())
    assert asked.json()["status"] == "found"
    server.client.get("/healthz")
    assert server.end(15) == 0  # what is left is sent at the end

    (upload,) = collector.named("POST /v1/maps/{map_name}/frames")
    assert (upload.process, upload.trace, upload.parent) == ("sceneprint-service", TRACE, PARENT)
    assert upload.kind == 2  # SERVER
    assert upload.attributes == {
        "http.request.method": "POST", "http.route": "/v1/maps/{map_name}/frames",
        "http.response.status_code": 202, "sceneprint.request": "from-robot-7",
    }  # fmt: skip
    (signing,) = collector.named("job sign")
    assert (signing.process, signing.trace, signing.parent) == (
        "sceneprint-worker", TRACE, upload.id,
    )  # fmt: skip
    assert signing.kind == 5  # CONSUMER
    assert signing.attributes == {"sceneprint.job": job}
    stages = [one for one in collector.spans if one.parent == signing.id]
    assert [one.name for one in sorted(stages, key=lambda one: one.start)] == [
        "decode", "sign", "artifact", "commit",
    ]  # fmt: skip
    assert all(signing.start <= one.start <= one.end <= signing.end for one in stages)

    (query,) = collector.named("POST /v1/maps/{map_name}/queries")
    assert query.trace != TRACE
    assert query.parent == ""
    stages = [one for one in collector.spans if one.parent == query.id]
    spent = asked.json()["milliseconds"]
    assert {one.name for one in stages} == spent.keys() - {"total", "prepare", "explain"}
    for one in stages:
        assert abs((one.end - one.start) / 1e6 - spent[one.name]) < 0.02
        assert query.start <= one.start <= one.end <= query.end
    assert not [one for one in collector.spans if "healthz" in one.name]


def test_a_collector_that_is_away_costs_no_answer(begin, make_map, shots, collector):
    collector.server.server_close()  # nobody listens at its address
    server = begin(traces_url=collector.url)
    path = make_map(server, "hall")
    assert server.client.post(f"{path}/frames", **shots[0].form()).status_code == 202
    assert server.end(15) == 0


@pytest.mark.parametrize("package", ["service", "worker"])
def test_without_opentelemetry_nothing_starts_and_it_says_what_to_install(package, tmp_path):
    code = (
        "import sys; sys.modules['opentelemetry'] = None; "
        f"from {package}.__main__ import main; sys.exit(main())"
    )
    settings = {"SCENEPRINT_DATA_DIR": f"{tmp_path}", "SCENEPRINT_TRACES_URL": "http://127.0.0.1:1"}
    done = subprocess.run(
        [sys.executable, "-c", code], env=os.environ | settings, capture_output=True, text=True,
        timeout=PATIENCE_S,
    )  # fmt: skip
    (line,) = done.stderr.splitlines()
    assert (done.returncode, done.stdout) == (2, "")
    assert "pip install 'sceneprint[traces]'" in line
    assert list(tmp_path.iterdir()) == []


def test_nothing_of_it_is_loaded_unless_asked():
    code = (
        "import sys, sceneprint.process as t\n"
        "with t.span('x', 'y'): t.record_span('z', 1.0); t.name_span('n', {'a': 1})\n"
        "assert t.traceparent() is None\n"
        "assert not [name for name in sys.modules if name.startswith('opentelemetry')]"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
