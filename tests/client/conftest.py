"""Fixtures of the client tests: a service, frames as files, and scripted HTTP servers."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Thread

import numpy as np
import pytest

from sceneprint.formats.dataset import find_sequences, write_depth_png
from sceneprint_client import Client, http
from sceneprint_client.api import FrameMeta, JobState, Localization
from sceneprint_client.poses import quaternion_of
from tests.cli_service.conftest import write_rooms
from tests.conftest import halved


def answer(status, at=0.0, parent="map", **fields):
    """Return an answer of the service; `at` is the pose, or its x in metres."""
    matrix = np.array(at, float)
    if not matrix.shape:
        matrix = np.eye(4)
        matrix[0, 3] = at
    pose = {
        "parent_frame": parent, "child_frame": "query.optical", "matrix": matrix.tolist(),
        "translation": dict(zip("xyz", matrix[:3, 3], strict=True)),
        "rotation": dict(zip("xyzw", quaternion_of(matrix[:3, :3]), strict=True)),
    }  # fmt: skip
    located = status == "found"
    record = {
        "status": status, "reason": f"{status}, told by a test", "map": "m",
        "pose": pose if located else None, "support": 3 * located, "votes": 3 * located,
        "spread_m": None, "spread_deg": None, "strength": "strong" if located else None,
        "verified_by": "matches" if located else None,
        "best": None, "matches": [], "query_id": "q", "seed": 0, "model": "depth",
        "milliseconds": {},
        "alternatives": [{"pose": pose, "confidence": 0.5, "support": 1}]
        if status == "ambiguous" else [],
        **fields,
    }  # fmt: skip
    return Localization.model_validate(record)


@pytest.fixture
def remote(service_url):
    with Client(service_url) as client:
        yield client


@pytest.fixture
def embedded(tmp_path):
    with Client.embedded(tmp_path / "embedded") as client:
        yield client


@pytest.fixture(scope="session")
def client(tmp_path_factory):
    """A service in this process for all tests, each of which uses its own maps."""
    with Client.embedded(tmp_path_factory.mktemp("client")) as client:
        yield client


@pytest.fixture
def map_name(request):
    return "m" + f"{abs(hash(request.node.nodeid)):x}"[:20]


@pytest.fixture(scope="session")
def room_frames(room_frames):
    """The frames of `tests/conftest.py` with a quarter of their samples, which are fast to sign."""
    return tuple(map(halved, room_frames))


@pytest.fixture(scope="session")
def references(room_frames, tmp_path_factory):
    root = write_rooms(tmp_path_factory.mktemp("rooms"), room_frames)
    return tuple(frame for sequence in find_sequences(root) for frame in sequence.frames)


@pytest.fixture(scope="session")
def walk(room_views, tmp_path_factory):
    """A function that creates frames along a path, a second apart, of one or two sessions."""
    path = tmp_path_factory.mktemp("walk") / "depth.png"

    def make(count=4, sessions="a", parent=None, **options):
        results = []
        frames = map(halved, room_views(21, 0, count, along_path=True, **options).frames)
        for i, frame in enumerate(frames):
            write_depth_png(path, frame.depth, 1000.0)
            k = frame.intrinsics
            pose = {"parent_frame": parent, "matrix": frame.pose.tolist()}
            fields = {
                "intrinsics": {"width": k.width, "height": k.height, "fx": k.fx, "fy": k.fy,
                               "cx": k.cx, "cy": k.cy},
                "session": sessions[i % len(sessions)], "robot": "ann",
                "pose": {name: value for name, value in pose.items() if value is not None},
                "captured_at": datetime(2026, 1, 1, tzinfo=UTC) + timedelta(seconds=i),
            }  # fmt: skip
            results.append((path.read_bytes(), FrameMeta.model_validate(fields)))
        return results

    return make


@pytest.fixture(scope="session")
def produced(service_url, walk):
    """A client of the map `produced`: sessions a and b of two frames each in one parent frame."""
    with Client(service_url) as client:
        client.create_map("produced", model="depth")
        frames = walk(sessions="ab", parent="room")
        jobs = [client.upload("produced", *frame).job_id for frame in frames]
        assert {job.state for job in client.wait(jobs)} == {JobState.SUCCEEDED}
        yield client


@pytest.fixture
def hasty(monkeypatch):
    monkeypatch.setattr(http, "FIRST_PAUSE_S", 0.01)
    monkeypatch.setattr(http, "LONGEST_PAUSE_S", 0.02)


@dataclass
class Scripted:
    """A service with scripted answers that records its requests."""

    url: str
    requests: list[tuple[str, str, bytes]] = field(default_factory=list)
    headers: list[dict[str, str]] = field(default_factory=list)
    stop: Callable[[], None] = lambda: None


@pytest.fixture
def scripted():
    """A function that starts a server with replies in order; the last one repeats."""
    servers = []

    def make(replies):
        class Handler(BaseHTTPRequestHandler):
            def answer(self):
                body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
                script.requests.append((self.command, self.path, body))
                script.headers.append(dict(self.headers.items()))
                status, headers, document = replies[min(len(script.requests), len(replies)) - 1]
                if status == 0:
                    self.connection.close()
                    return
                content = b"" if document is None else json.dumps(document).encode()
                self.send_response(status)
                for name, value in {**headers, "Content-Length": str(len(content))}.items():
                    self.send_header(name, value)
                self.end_headers()
                self.wfile.write(content)

            do_GET = do_POST = do_DELETE = answer  # noqa: N815

            def log_message(self, *_):
                pass

        server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        server.handle_error = lambda *_: None
        servers.append(server)
        script = Scripted(f"http://127.0.0.1:{server.server_address[1]}")

        def stop():
            server.shutdown()
            server.server_close()

        script.stop = stop
        Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True).start()
        return script

    yield make
    for server in servers:
        server.shutdown()
        server.server_close()
