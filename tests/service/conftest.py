"""Fixtures of the service tests: servers in separate process groups, frames and requests."""

from __future__ import annotations

import json
import os
import re
import signal
import ssl
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from functools import partial
from ipaddress import IPv4Address
from pathlib import Path
from typing import Any

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
from sceneprint.types import DepthFrame, Floats32, Intrinsics
from sceneprint_client.api.admin import Scope
from service.app import create_app
from tests.whole_engine import Engine

BIN = Path(sys.executable).parent
#: The origin whose pages may ask the server for all tests.
FLEET = "https://fleet.example"


def members(group: int) -> list[int]:
    """Processes of a group that still run."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                state, _, pgrp = (entry / "stat").read_text().rpartition(")")[2].split()[:3]
            except (OSError, ValueError):
                continue
            if int(pgrp) == group and state != "Z":
                found.append(int(entry.name))
    return found


@dataclass
class Server:
    """A command of ours that serves, with all its children, and what it says."""

    process: subprocess.Popen[str]
    folder: Path
    errors: Path
    url: str = ""
    client: httpx.Client = field(
        default_factory=lambda: httpx.Client(timeout=PATIENCE_S, trust_env=False)
    )

    @property
    def workers(self) -> list[int]:
        """Worker processes: children that run our code."""
        lines = {pid: Path(f"/proc/{pid}/cmdline") for pid in members(self.process.pid)}
        return [pid for pid, line in lines.items() if b"spawn_main" in line.read_bytes()]

    def log(self, message: str = "") -> list[dict[str, Any]]:
        """Lines of standard error, or those with a message; each must be JSON."""
        text = self.errors.read_text()
        # by this mark alone: a name in a line may hold others, such as U+2028
        whole = text.split("\n")[:-1]
        try:
            lines = [json.loads(line) for line in whole]
        except json.JSONDecodeError as error:
            raise AssertionError(f"not JSON in the log: {error.doc[:500]!r}") from error
        return [line for line in lines if not message or line["message"] == message]

    def ready(self, workers: int = 1) -> None:
        """Wait until that many workers have begun, in all."""
        until(lambda: len(self.log("worker ready")) >= workers)

    def tell(self, number: int) -> None:
        """Send a signal to the command alone."""
        self.process.send_signal(number)

    def end(self, number: int | None = None) -> int:
        """Exit code, after a signal if one is given."""
        if number is not None:
            self.tell(number)
        return self.process.wait(PATIENCE_S)

    def gone(self) -> None:
        """Wait until no process of the group is left."""
        until(lambda: not members(self.process.pid))

    def kill(self) -> None:
        """End all of it, whatever state it is in."""
        self.client.close()
        if members(self.process.pid):
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()
        if self.process.stdout is not None:
            self.process.stdout.close()


@pytest.fixture(scope="session")
def certificate(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A certificate of this machine that nobody else vouches for, and its key."""
    folder = tmp_path_factory.mktemp("certificate")
    key, now = ec.generate_private_key(ec.SECP256R1()), datetime.now(UTC)
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "localhost")])
    names = [x509.DNSName("localhost"), x509.IPAddress(IPv4Address("127.0.0.1"))]
    made = (
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
    (folder / "certificate.pem").write_bytes(made.public_bytes(Encoding.PEM))
    (folder / "key.pem").write_bytes(
        key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
    )
    return folder / "certificate.pem", folder / "key.pem"


def promised(document: dict[str, Any], answer: httpx.Response) -> None:
    """Hold an answer to the OpenAPI document: its status and its type are declared."""
    method, path = answer.request.method.lower(), answer.request.url.path
    for pattern, operations in document["paths"].items():
        if method in operations and re.fullmatch(re.sub(r"\{\w+\}", "[^/]+", pattern), path):
            responses = operations[method]["responses"]
            assert str(answer.status_code) in responses, (method, pattern, answer.status_code)
            kinds = responses[str(answer.status_code)].get("content", {})
            kind = answer.headers.get("content-type", "").partition(";")[0]
            assert not kinds or kind in kinds, (method, pattern, answer.status_code, kind)


@pytest.fixture(scope="session")
def starter(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Server]:
    """See `begin`; with `stack`, the server ends when that does."""
    document: dict[str, Any] = {}  # of the first: they all have the same, and it takes a while

    def start(
        stack: ExitStack, *arguments: str, folder: Path | None = None,
        command: tuple[str, ...] | None = None, wait: bool = True, **settings: object,
    ) -> Server:  # fmt: skip
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
            assert process.stdout is not None
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
def begin(starter: Callable[..., Server]) -> Iterator[Callable[..., Server]]:
    """Start `sceneprint serve` or another command; settings are given as for Settings."""
    with ExitStack() as stack:
        yield partial(starter, stack)


@pytest.fixture(scope="session")
def served(starter: Callable[..., Server], folder_stack: ExitStack) -> Server:
    """One server for all tests that leave it as it was but for maps of their own."""
    return starter(folder_stack, cors_origins=FLEET, decoders=2)


@dataclass(frozen=True)
class Shot:
    """A frame as it is sent."""

    png: bytes
    camera: dict[str, float]
    pose: list[list[float]] | None = None

    def form(self, **meta: object) -> dict[str, Any]:
        """Arguments of a request that uploads it."""
        known = {"intrinsics": self.camera, **meta}
        parts = {"frame": ("frame.png", self.png, "image/png")}
        return {"files": parts, "data": {"meta": json.dumps(known)}}


@pytest.fixture(scope="session")
def shoot(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Shot]:
    """A depth image of a camera as it is sent."""
    path = tmp_path_factory.mktemp("png") / "frame.png"

    def of(depth: Floats32, intrinsics: Intrinsics, pose: Any = None) -> Shot:
        write_depth_png(path, depth, 1000.0)
        names = ("width", "height", "fx", "fy", "cx", "cy")
        return Shot(path.read_bytes(), {n: getattr(intrinsics, n) for n in names}, pose)

    return of


@pytest.fixture(scope="session")
def shots(room_frames: tuple[DepthFrame, ...], shoot: Callable[..., Shot]) -> list[Shot]:
    """Three views of each of two rooms, with their poses."""
    return [
        shoot(one.depth, one.intrinsics, None if one.pose is None else one.pose.tolist())
        for one in room_frames
    ]


@pytest.fixture(scope="session")
def small_shots(room_frames: tuple[DepthFrame, ...], shoot: Callable[..., Shot]) -> list[Shot]:
    """96 small frames: every fourth sample from each of 16 corners of each of six views."""
    found = []
    for frame in room_frames:
        k = frame.intrinsics
        for place in range(16):
            y, x = divmod(place, 4)
            depth = np.ascontiguousarray(frame.depth[y::4, x::4])
            lens = Intrinsics(160, 120, k.fx / 4, k.fy / 4, (k.cx - x) / 4, (k.cy - y) / 4)
            found.append(shoot(depth, lens))
    return found


@pytest.fixture(scope="session")
def make_map() -> Callable[..., str]:
    """Make a map on a server; its path is returned."""

    def make(server: Server, name: str, model: str = "depth") -> str:
        made = server.client.post("/v1/maps", json={"name": name, "model": model})
        assert made.status_code == 201, made.text
        return f"/v1/maps/{name}"

    return make


@pytest.fixture(scope="session")
def refused() -> Callable[..., dict[str, Any]]:
    """Check that an answer is a problem document and as we write them; return it."""

    def check(answer: httpx.Response, status: int, kind: str, text: str = "") -> dict[str, Any]:
        assert answer.status_code == status, answer.text
        assert answer.headers["content-type"] == "application/problem+json"
        problem: dict[str, Any] = answer.json()
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
    """A server that asks for keys, with some that were made on its folder."""

    server: Server
    secrets: dict[str, str]

    def ask(self, key: str, method: str, path: str, **request: Any) -> httpx.Response:
        """A request with the secret of a key."""
        headers = {"Authorization": f"Bearer {self.secrets[key]}", **request.pop("headers", {})}
        return self.server.client.request(method, path, headers=headers, **request)


def _walled(
    begin: Callable[..., Server], keys: dict[str, dict[str, Scope]], *arguments: str,
    **settings: object,
) -> Walled:  # fmt: skip
    server = begin("--host", "0.0.0.0", *arguments, **settings)
    # the address that is printed is that of every interface; asked from here it is this one
    server.client.base_url = server.url = server.url.replace("0.0.0.0", "127.0.0.1")
    with Engine(Settings(data_dir=server.folder, database_url=None)) as engine:
        made = {name: engine.create_key(name, grants) for name, grants in keys.items()}
    return Walled(server, {name: key.secret for name, key in made.items()})


@pytest.fixture(scope="module")
def wall(begin: Callable[..., Server]) -> Callable[..., Walled]:
    """Begin a server that asks for keys; what each may do is given by its name."""
    return partial(_walled, begin)


@pytest.fixture(scope="session")
def walled(starter: Callable[..., Server], folder_stack: ExitStack) -> Walled:
    """One server that asks for keys, for all tests that leave it as it was but for maps of their
    own; `alpha` and `bravo` are those of test_isolation.
    """
    keys = {
        "boss": {"*": "admin"}, "watcher": {"*": "read"}, "keeper": {"bravo": "admin"},
        "admin": {"alpha": "admin"}, "writer": {"alpha": "write"}, "reader": {"alpha": "read"},
    }  # fmt: skip
    begin = partial(starter, folder_stack)
    return _walled(begin, keys, tenant_requests_per_s=0, wrong_keys_per_minute=0)


@dataclass
class House:
    """A service without workers, whose jobs are done here, its engine, and keys to it.

    Parameters
    ----------
    client, portal, engine : of the service, which runs in a thread of its own
    secrets : of the keys
    """

    client: httpx.AsyncClient
    portal: BlockingPortal
    engine: Engine
    secrets: dict[str, str]

    def ask(self, key: str, method: str, path: str, **request: Any) -> httpx.Response:
        headers = {"Authorization": f"Bearer {self.secrets[key]}", **request.pop("headers", {})}
        asked = partial(self.client.request, method, path, headers=headers, **request)
        answer: httpx.Response = self.portal.call(asked)
        return answer

    def work(self) -> None:
        """Do all jobs that wait."""
        while (work := self.engine.claim("here:1")) is not None:
            self.engine.run(work)


@contextmanager
def _opened(
    folder: Path, url: str | None, keys: Mapping[str, Mapping[str, Scope]], **more: object
) -> Iterator[House]:
    (folder / "blobs").mkdir()
    given = {
        "data_dir": folder,
        "database_url": url,
        "require_keys": True,
        "tenant_requests_per_s": 0,
    }
    app = create_app(Settings.model_validate(given | more))
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
def open_house() -> Callable[..., Any]:
    """Opens a service in a folder, on SQLite where no database is given, with some keys."""
    return _opened


@pytest.fixture
def house(request: Any, tmp_path: Path, store_url: str) -> Iterator[Any]:
    """A service with the maps alpha and bravo, and with the keys of the test's module."""
    with _opened(tmp_path, store_url, request.module.KEYS) as opened:
        for name in ("alpha", "bravo"):
            opened.ask("boss", "POST", "/v1/maps", json={"name": name, "model": "depth"})
        yield opened
