"""Tests of the listening socket, and of TLS."""

import signal
import socket

import pytest

from benchmarks.waiting import PATIENCE_S
from sceneprint.cli import main
from sceneprint_client import Client
from sceneprint_client.errors import Unreachable


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
