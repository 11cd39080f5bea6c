"""Fixtures of the service tests: servers in separate process groups, frames and requests."""

from __future__ import annotations

import json
import os
import re
import signal
import socket
import ssl
import subprocess
import sys
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from functools import partial
from ipaddress import IPv4Address
from pathlib import Path

import httpx
import numpy as np
import pytest
from anyio.from_thread import BlockingPortal, start_blocking_portal
from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat

from benchmarks.waiting import PATIENCE_S, until
from sceneprint.formats.dataset import write_depth_png
from sceneprint.settings import Settings
from sceneprint.types import Intrinsics
from service.app import create_app
from tests.whole_engine import Engine

BIN = Path(sys.executable).parent
#: Origin whose pages may use the server.
FLEET = "https://fleet.example"


def members(group):
    """Return the running processes of a group."""
    results = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                state, _, pgrp = (entry / "stat").read_text().rpartition(")")[2].split()[:3]
            except (OSError, ValueError):
                continue
            if int(pgrp) == group and state != "Z":
                results.append(int(entry.name))
    return results


@dataclass
class Server:
    """A serving command with its child processes and its log."""

    process: subprocess.Popen[str]
    folder: Path
    errors: Path
    url: str = ""
    client: httpx.Client = field(
        default_factory=lambda: httpx.Client(timeout=PATIENCE_S, trust_env=False)
    )

    @property
    def workers(self):
        """Return the child processes that run our code."""
        lines = {pid: Path(f"/proc/{pid}/cmdline") for pid in members(self.process.pid)}
        return [pid for pid, line in lines.items() if b"spawn_main" in line.read_bytes()]

    def log(self, message=""):
        """Return the JSON lines of standard error, optionally only those with a message."""
        text = self.errors.read_text()
        # Only this character separates lines: names may contain others, such as U+2028.
        whole = text.split("\n")[:-1]
        try:
            lines = [json.loads(line) for line in whole]
        except json.JSONDecodeError as error:
            raise AssertionError(f"not JSON in the log: {error.doc[:500]!r}") from error
        return [line for line in lines if not message or line["message"] == message]

    def connect(self):
        """Open a connection on which a test can send anything."""
        url = httpx.URL(self.url)
        return socket.create_connection((url.host, url.port), timeout=PATIENCE_S)

    def index(self, path, shot, **meta):
        """Upload a frame to the map at `path`, wait for its signature, and return its id."""
        wait = {"Prefer": "wait=200"}
        sent = self.client.post(f"{path}/frames", **shot.form(**meta), headers=wait)
        assert (sent.status_code, sent.json()["state"]) == (201, "indexed"), sent.text
        return str(sent.json()["frame_id"])

    def ready(self, workers=1):
        """Wait until `workers` workers have started in total."""
        until(lambda: len(self.log("worker ready")) >= workers)

    def tell(self, number):
        """Send a signal to the main process only."""
        self.process.send_signal(number)

    def end(self, number=None):
        """Return the exit code, after sending a signal if one is passed."""
        if number is not None:
            self.tell(number)
        return self.process.wait(PATIENCE_S)

    def gone(self):
        """Wait until the group has no process left."""
        until(lambda: not members(self.process.pid))

    def kill(self):
        """Kill the whole group."""
        self.client.close()
        if members(self.process.pid):
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()
        if self.process.stdout is not None:
            self.process.stdout.close()


class Clock:
    """A clock that tests set."""

    now = 100.0

    def __call__(self):
        return self.now


@pytest.fixture(scope="session")
def certificate(tmp_path_factory):
    """A self-signed certificate of this machine, and its key."""
    folder = tmp_path_factory.mktemp("certificate")
    key, now = ec.generate_private_key(ec.SECP256R1()), datetime.now(UTC)
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "localhost")])
    names = [x509.DNSName("localhost"), x509.IPAddress(IPv4Address("127.0.0.1"))]
    document = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - timedelta(days=1))
        .not_valid_after(now + timedelta(days=1))
        .add_extension(x509.SubjectAlternativeName(names), critical=False)
        .sign(key, hashes.SHA256())
    )
    (folder / "certificate.pem").write_bytes(document.public_bytes(Encoding.PEM))
    (folder / "key.pem").write_bytes(
        key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
    )
    return folder / "certificate.pem", folder / "key.pem"


def promised(document, answer):
    """Check that the OpenAPI document declares the status and the type of an answer."""
    method, path = answer.request.method.lower(), answer.request.url.path
    for pattern, operations in document["paths"].items():
        if method in operations and re.fullmatch(re.sub(r"\{\w+\}", "[^/]+", pattern), path):
            responses = operations[method]["responses"]
            assert str(answer.status_code) in responses, (method, pattern, answer.status_code)
            kinds = responses[str(answer.status_code)].get("content", {})
            kind = answer.headers.get("content-type", "").partition(";")[0]
            assert not kinds or kind in kinds, (method, pattern, answer.status_code, kind)


@pytest.fixture(scope="session")
def starter(tmp_path_factory):
    """A function like `begin`; with `stack`, the server ends with the stack."""
    document = {}  # document of the first server, which all others share

    def start(stack, *arguments, folder=None, command=None, wait=True, **settings):
        folder = folder or tmp_path_factory.mktemp("server")
        errors = tmp_path_factory.mktemp("errors") / "stderr"
        given = {f"SCENEPRINT_{name.upper()}": str(value) for name, value in settings.items()}
        if command is None:
            default = ("--port", "0", "--data", str(folder), "--workers", "1")
            command = (str(BIN / "sceneprint"), "serve", *default)
        with errors.open("w") as out:
            process = subprocess.Popen(
                [*command, *arguments], env=os.environ | given, stdout=subprocess.PIPE, stderr=out,
                text=True, start_new_session=True,
            )  # fmt: skip
        server = Server(process, folder, errors)
        stack.callback(server.kill)
        if wait:
            line = process.stdout.readline()
            assert re.match("sceneprint: serving https?://", line), errors.read_text()
            server.url = line.split()[-1]
            if "tls_cert" in settings:
                server.client = httpx.Client(
                    timeout=PATIENCE_S, trust_env=False,
                    verify=ssl.create_default_context(cafile=str(settings["tls_cert"])),
                )  # fmt: skip
            server.client.base_url = httpx.URL(server.url)
            if not document:
                document.update(server.client.get("/openapi.json").json())
            server.client.event_hooks = {"response": [lambda answer: promised(document, answer)]}
        return server

    return start


@pytest.fixture(scope="module")
def begin(starter):
    """A function that starts `sceneprint serve` or another command with the passed settings."""
    with ExitStack() as stack:
        yield partial(starter, stack)


@pytest.fixture(scope="session")
def served(starter, folder_stack):
    """A server for all tests that change only their own maps."""
    return starter(folder_stack, cors_origins=FLEET, decoders=2)


@dataclass(frozen=True)
class Shot:
    """A frame as it is sent."""

    png: bytes
    camera: dict[str, float]
    pose: list[list[float]] | None = None

    def form(self, **meta):
        """Return the arguments of a request that uploads the frame."""
        fields = {"intrinsics": self.camera, **meta}
        parts = {"frame": ("frame.png", self.png, "image/png")}
        return {"files": parts, "data": {"meta": json.dumps(fields)}}


@pytest.fixture(scope="session")
def shoot(tmp_path_factory):
    """A function that returns a depth image as it is sent."""
    path = tmp_path_factory.mktemp("png") / "frame.png"

    def of(depth, intrinsics, pose=None):
        write_depth_png(path, depth, 1000.0)
        names = ("width", "height", "fx", "fy", "cx", "cy")
        return Shot(path.read_bytes(), {n: getattr(intrinsics, n) for n in names}, pose)

    return of


@pytest.fixture(scope="session")
def shots(room_frames, shoot):
    """Three views of each of two rooms, with their poses."""
    return [
        shoot(frame.depth, frame.intrinsics, None if frame.pose is None else frame.pose.tolist())
        for frame in room_frames
    ]


@pytest.fixture(scope="session")
def small_shots(room_frames, shoot):
    """96 small frames: every fourth sample from each of 16 offsets of each of six views."""
    results = []
    for frame in room_frames:
        k = frame.intrinsics
        for place in range(16):
            y, x = divmod(place, 4)
            depth = np.ascontiguousarray(frame.depth[y::4, x::4])
            lens = Intrinsics(160, 120, k.fx / 4, k.fy / 4, (k.cx - x) / 4, (k.cy - y) / 4)
            results.append(shoot(depth, lens))
    return results


@pytest.fixture(scope="session")
def make_map():
    """A function that creates a map on a server and returns its path."""

    def make(server, name, model="depth"):
        answer = server.client.post("/v1/maps", json={"name": name, "model": model})
        assert answer.status_code == 201, answer.text
        return f"/v1/maps/{name}"

    return make


@pytest.fixture(scope="session")
def refused():
    """A function that checks an answer's problem document and returns it."""

    def check(answer, status, kind, text=""):
        assert answer.status_code == status, answer.text
        assert answer.headers["content-type"] == "application/problem+json"
        problem = answer.json()
        assert (problem["status"], problem["type"]) == (status, f"/problems/{kind}"), problem
        assert {"type", "title", "status", "detail", "instance"} <= set(problem)
        assert problem["instance"] == f"/requests/{answer.headers['x-request-id']}"
        assert text in problem["detail"]
        for leak in ("Traceback", ".py", "/tmp", "/work", "site-packages", "sqlite", "SELECT"):
            assert leak not in answer.text.replace(str(answer.request.url.path), ""), leak
        return problem

    return check


@dataclass(frozen=True)
class Walled:
    """A server that requires keys, with some keys."""

    server: Server
    secrets: dict[str, str]

    def ask(self, key, method, path, **request):
        """Send a request with a key."""
        headers = {"Authorization": f"Bearer {self.secrets[key]}", **request.pop("headers", {})}
        return self.server.client.request(method, path, headers=headers, **request)


def _walled(begin, keys, *arguments, **settings):
    server = begin("--host", "0.0.0.0", *arguments, **settings)
    # The printed address is that of all interfaces.
    server.client.base_url = server.url = server.url.replace("0.0.0.0", "127.0.0.1")
    with Engine(Settings(data_dir=server.folder, database_url=None)) as engine:
        created = {name: engine.create_key(name, grants) for name, grants in keys.items()}
    return Walled(server, {name: key.secret for name, key in created.items()})


@pytest.fixture(scope="module")
def wall(begin):
    """A function that starts a server with keys, whose grants follow from their names."""
    return partial(_walled, begin)


@pytest.fixture(scope="session")
def walled(starter, folder_stack):
    """A server that requires keys, for all tests that change only their own maps.

    Its maps `alpha` and `bravo` belong to test_isolation.
    """
    keys = {
        "boss": {"*": "admin"}, "watcher": {"*": "read"}, "keeper": {"bravo": "admin"},
        "admin": {"alpha": "admin"}, "writer": {"alpha": "write"}, "reader": {"alpha": "read"},
    }  # fmt: skip
    begin = partial(starter, folder_stack)
    return _walled(begin, keys, tenant_requests_per_s=0, wrong_keys_per_minute=0)


@dataclass
class House:
    """A service in its own thread, without workers; this process runs its jobs."""

    client: httpx.AsyncClient
    portal: BlockingPortal
    engine: Engine
    secrets: dict[str, str]

    def ask(self, key, method, path, **request):
        headers = {"Authorization": f"Bearer {self.secrets[key]}", **request.pop("headers", {})}
        call = partial(self.client.request, method, path, headers=headers, **request)
        return self.portal.call(call)

    def work(self):
        """Run all queued jobs."""
        while (work := self.engine.claim("here:1")) is not None:
            self.engine.run(work)


@contextmanager
def _opened(folder, url, keys, **more):
    (folder / "blobs").mkdir()
    fields = {
        "data_dir": folder,
        "database_url": url,
        "require_keys": True,
        "tenant_requests_per_s": 0,
    }
    app = create_app(Settings.model_validate(fields | more))
    with (
        start_blocking_portal() as portal,
        portal.wrap_async_context_manager(app.router.lifespan_context(app)),
        portal.wrap_async_context_manager(
            httpx.AsyncClient(transport=httpx.ASGITransport(app), base_url="http://here")
        ) as client,
    ):
        context = app.state.service.context
        engine = Engine(context.settings, context)
        secrets = {name: engine.create_key(name, grants).secret for name, grants in keys.items()}
        yield House(client, portal, engine, secrets)


@pytest.fixture(scope="session")
def open_house():
    """A function that opens a service with keys in a folder, by default on SQLite."""
    return _opened


@pytest.fixture
def house(request, tmp_path, store_url):
    """A service with the maps alpha and bravo, and with the keys of the test's module."""
    with _opened(tmp_path, store_url, request.module.KEYS) as opened:
        for name in ("alpha", "bravo"):
            opened.ask("boss", "POST", "/v1/maps", json={"name": name, "model": "depth"})
        yield opened
