"""Tests of the listening socket, and of TLS."""

import signal
import socket

import pytest

from benchmarks.waiting import PATIENCE_S
from sceneprint.cli import main
from sceneprint.errors import UnusableStore
from sceneprint.settings import Settings
from sceneprint_client import Client
from sceneprint_client.errors import Unreachable
from service.server import listen


def test_accepted_connections_do_not_wait_for_acknowledgements(tmp_path):
    """asyncio turns Nagle off where the protocol says TCP, and leaves it on where it says 0."""
    with listen(Settings(data_dir=tmp_path, port=0)) as listening:
        assert (listening.type, listening.proto) == (socket.SOCK_STREAM, socket.IPPROTO_TCP)
        listening.listen()
        host, port = listening.getsockname()
        assert host == "127.0.0.1"
        with socket.create_connection((host, port)):
            accepted, _ = listening.accept()
            with accepted:
                assert accepted.proto == socket.IPPROTO_TCP
        with pytest.raises(UnusableStore, match=f"127.0.0.1:{port} is not available"):
            listen(Settings(data_dir=tmp_path, port=port))


def test_by_two_settings_the_service_speaks_https(begin, certificate, monkeypatch):
    cert, key = certificate
    server = begin(tls_cert=cert, tls_key=key, workers=0)
    assert server.url.startswith("https://127.0.0.1:")
    answer = server.client.get("/healthz", headers={"Origin": server.url})
    assert answer.json()["status"] == "ok"
    port = server.client.base_url.port
    with pytest.raises(Unreachable, match=r"not trusted here .* set SSL_CERT_FILE"):
        Client(server.url).status()
    with socket.create_connection(("127.0.0.1", port), timeout=PATIENCE_S) as wire:
        wire.sendall(b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n")
        assert not wire.recv(1 << 16).startswith(b"HTTP")
    monkeypatch.setenv("SSL_CERT_FILE", str(cert))
    with Client(server.url) as client:  # which keeps its connection until the service ends
        assert client.status().version == answer.json()["version"]
        assert main(["maps", "--url", f"https://localhost:{port}"]) == 0
        assert server.end(signal.SIGTERM) == 0
