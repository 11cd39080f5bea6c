"""Tests of slow connections and bodies: uvicorn with our limits, and a small application.

The limits are short. Tests wait for the other side to act, and measure no times.
"""

import asyncio
import json
import socket
import ssl
import threading
from contextlib import contextmanager
from functools import partial

import pytest
import uvicorn
from starlette.requests import Request
from starlette.responses import Response

from sceneprint.errors import InvalidRequest
from sceneprint.settings import Settings
from service import limits
from service import server as connections
from service.browser_security import Origins
from service.metrics import Metrics
from service.middleware import RequestMiddleware
from service.server import Connection, Handshake

LARGE = 8 << 20
PATIENCE_S = 30


async def app(scope, receive, send):
    """Answers with the length of the body; otherwise where the path says so."""
    body = b"" if scope["path"] == "/unread" else await Request(scope, receive).body()
    if scope["path"] == "/wait":
        await asyncio.sleep(1.0)
    content = b"a" * LARGE if scope["path"] == "/large" else str(len(body)).encode()
    await Response(content)(scope, receive, send)


@contextmanager
def running(application, context=None):
    http = Connection if context is None else partial(Handshake, context)
    config = uvicorn.Config(
        application, http=http, lifespan="off", log_config=None, access_log=False
    )
    server = uvicorn.Server(config)
    listening = socket.create_server(("127.0.0.1", 0))
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]})
    thread.start()
    try:
        yield listening.getsockname()
    finally:
        server.should_exit = True
        thread.join()
        listening.close()


@pytest.fixture
def opened(monkeypatch, request, certificate):
    """Connections to a service that is soon tired of waiting; by TLS where a test asks for it."""
    cert, key = certificate
    trust = context = None
    if getattr(request, "param", "http") == "https":
        context = connections.tls_context(Settings(tls_cert=cert, tls_key=key))
        trust = ssl.create_default_context(cafile=str(cert))
    monkeypatch.setattr(connections, "HANDSHAKE_S", 0.8)
    monkeypatch.setattr(connections, "SILENT_S", 0.8)
    monkeypatch.setattr(connections, "READING_S", 1.0)
    monkeypatch.setattr(limits, "IDLE_S", 0.8)
    settings = Settings(max_upload_bytes=1 << 20, cors_origins=())
    wires = []
    with running(RequestMiddleware(app, settings, Origins(()), Metrics()), context) as address:

        def connect(said=b"", *, bare=False):
            wire = socket.create_connection(address, timeout=PATIENCE_S)
            if trust is not None and not bare:
                wire = trust.wrap_socket(
                    wire, server_hostname="localhost", suppress_ragged_eofs=True
                )
            wires.append(wire)
            wires[-1].sendall(said)
            return wires[-1]

        try:
            yield connect
        finally:
            for wire in wires:
                wire.close()


by_tls = pytest.mark.parametrize("opened", ["https"], indirect=True)


def rest(wire):
    """All that comes until the other side closes."""
    data = b""
    try:
        while more := wire.recv(1 << 16):
            data += more
    except (ConnectionError, ssl.SSLError):
        pass
    return data


def ask(path, *headers, method="GET"):
    lines = (f"{method} {path} HTTP/1.1", "Host: localhost", *headers, "", "")
    return "\r\n".join(lines).encode()


CLOSE = "Connection: close"


def test_a_silent_connection_is_closed_without_a_word(opened):
    assert rest(opened()) == b""


@contextmanager
def dripping(wire, drop):
    """Meanwhile something comes again and again."""
    ended = threading.Event()

    def drip():
        while not ended.wait(0.05):
            try:
                wire.sendall(drop)
            except OSError:
                return

    thread = threading.Thread(target=drip)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def test_a_head_that_drips_is_not_waited_for(opened):
    wire = opened(b"GET / HTTP/1.1\r\nHost: localhost\r\n")
    with dripping(wire, b"X-A: b\r\n"):
        assert rest(wire) == b""  # closed, though it was never silent


def test_a_connection_may_be_used_again(opened):
    wire = opened(ask("/"))
    for path in ("/wait", "/"):
        data = b""
        while not data.endswith(b"\r\n\r\n0"):
            data += wire.recv(1 << 16)
        wire.sendall(ask(path, CLOSE if path == "/" else "Accept: */*"))
    assert rest(wire).endswith(b"\r\n\r\n0")


def test_the_rest_of_a_body_that_was_refused_is_not_read_for_ever(opened):
    wire = opened(ask("/unread", "Content-Length: 99999", method="POST"))
    with dripping(wire, b"a"):
        assert rest(wire).endswith(b"\r\n\r\n0")


@pytest.fixture
def lost(monkeypatch):
    """Waits until the service has given up the connection of an address."""
    gone = set()
    ended = threading.Event()
    before = Connection.connection_lost

    def noted(self, exc):
        before(self, exc)
        gone.add(self.client)
        ended.set()

    def wait(address):
        while address not in gone:
            assert ended.wait(PATIENCE_S)
            ended.clear()

    monkeypatch.setattr(Connection, "connection_lost", noted)
    return wait


def test_an_answer_nobody_reads_is_given_up(opened, lost):
    wire = opened()
    wire.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    name = wire.getsockname()
    wire.sendall(ask("/large"))
    lost(name)


def test_an_answer_that_is_read_slowly_is_given_whole(opened):
    wire = opened(ask("/large", CLOSE))
    data, seen = b"", threading.Event()
    while more := wire.recv(1 << 18):
        if (len(data) + len(more)) >> 18 > len(data) >> 18:
            seen.wait(0.05)  # 32 pauses, longer together than the limit
        data += more
    assert len(data) > LARGE


def test_who_was_silent_for_longest_makes_room(opened, monkeypatch):
    monkeypatch.setattr(connections, "SILENT_S", 60)
    monkeypatch.setattr(connections, "connection_limit", lambda: 3)
    first, second = opened(), opened()
    working = opened(ask("/wait", CLOSE))
    fourth = opened(ask("/", CLOSE))
    assert rest(fourth).endswith(b"0")
    assert rest(first) == b""  # closed; a request at work is not
    assert rest(working).endswith(b"0")
    second.sendall(ask("/", CLOSE))
    assert rest(second).endswith(b"0")


@by_tls
def test_who_does_not_agree_on_tls_is_closed_without_a_word(opened):
    assert rest(opened(bare=True)) == b""
    with dripping(wire := opened(b"\x16\x03\x01\x10\x00", bare=True), b"\x01"):
        assert rest(wire) == b""
    assert b"HTTP" not in rest(opened(ask("/", CLOSE), bare=True))
    assert rest(opened(ask("/", CLOSE))).endswith(b"\r\n\r\n0")


@by_tls
def test_tls_is_of_version_1_2_or_later(opened, certificate):
    wire = opened()
    assert (wire.version(), wire.cipher()[2]) == ("TLSv1.3", 256)
    cert, key = certificate
    context = connections.tls_context(Settings(tls_cert=cert, tls_key=key))
    assert context.minimum_version == ssl.TLSVersion.TLSv1_2
    assert all("CBC" not in cipher["name"] for cipher in context.get_ciphers())


def test_a_certificate_that_cannot_be_used_is_said(certificate, tmp_path):
    cert, key = certificate
    for options, said in (
        ({"tls_cert": cert, "tls_key": tmp_path / "none.pem"}, "No such file or directory"),
        ({"tls_cert": key, "tls_key": key}, "cannot be used"),
        ({"tls_cert": cert, "tls_key": cert}, "cannot be used"),
    ):
        with pytest.raises(InvalidRequest, match=said):
            connections.tls_context(Settings(**options))
    for half in ({"tls_cert": cert}, {"tls_key": key}):
        with pytest.raises(ValueError, match="HTTPS requires both SCENEPRINT_TLS_CERT"):
            Settings(**half)


def refusal(said):
    head, _, body = said.partition(b"\r\n\r\n")
    assert b"application/problem+json" in head
    assert b"connection: close" in head.lower()
    return int(head.split()[1]), json.loads(body)


@pytest.mark.parametrize("sent", [b"", b"abc"])
def test_a_body_that_stops_is_refused(opened, sent):
    wire = opened(ask("/", "Content-Length: 9", method="POST") + sent)
    status, problem = refusal(rest(wire))
    assert (status, problem["type"]) == (408, "/problems/slow-body")
    assert f" {len(sent)} bytes in " in problem["detail"]


def test_a_body_that_drips_is_refused_in_the_end(opened, monkeypatch):
    monkeypatch.setattr(limits, "IDLE_S", 60)
    monkeypatch.setattr(limits, "BODY_S", 1.0)
    wire = opened(ask("/", "Content-Length: 99999", method="POST"))
    with dripping(wire, b"a"):
        status, problem = refusal(rest(wire))
    assert (status, problem["type"]) == (408, "/problems/slow-body")
