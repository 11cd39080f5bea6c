"""Tests of the service in the client's process: streaming, waiting and shutdown."""

import sys
import threading

import httpx
import pytest

from benchmarks.waiting import PATIENCE_S
from sceneprint_client import Client, errors
from service.embedded import LocalService, embedded_settings


@pytest.fixture
def local(tmp_path):
    transport = LocalService(tmp_path / "local")
    with httpx.Client(base_url="http://here", transport=transport) as http:
        yield http


def test_a_response_streams_until_it_is_closed(local):
    with local.stream("GET", "/v1/events", headers={"Accept": "text/event-stream"}) as stream:
        parts = stream.iter_text()
        assert next(parts).startswith("retry: ")
        local.post("/v1/maps", json={"name": "m"}).raise_for_status()
        assert any("map.created" in part for part in parts)
    assert local.get("/v1/stats").json()["maps"] == 1


def test_no_key_and_no_limit_whatever_the_environment_says(tmp_path, monkeypatch):
    for name, value in (
        ("REQUIRE_KEYS", "1"), ("HOST", "0.0.0.0"), ("TENANT_REQUESTS_PER_S", "0.1"),
        ("QUEUED_REQUESTS", "0"), ("CORS_ORIGINS", "*"), ("MAX_UPLOAD_BYTES", "1024"),
    ):  # fmt: skip
        monkeypatch.setenv(f"SCENEPRINT_{name}", value)
    with Client.embedded(tmp_path) as client:
        for _ in range(5):
            client.create_map("m")
        assert client.me().name is None
        with pytest.raises(errors.UnreadableCloud):
            client.upload("m", b"ply\n" + bytes(4096))
    assert (
        embedded_settings(tmp_path).max_upload_bytes == 2 << 30
    )  # more than a service may be given


def test_closing_ends_streams_and_threads(tmp_path):
    before = set(threading.enumerate())
    client = Client.embedded(tmp_path)
    client.create_map("m")
    stream = client.events(after="0")
    assert next(stream).kind == "map.created"
    ended = []

    def listen():
        try:
            next(stream)
        except RuntimeError as error:
            ended.append(error)

    listener = threading.Thread(target=listen)
    listener.start()
    client.close()
    listener.join(PATIENCE_S)
    assert "closed" in str(ended[0])
    for thread in set(threading.enumerate()) - before:
        thread.join(PATIENCE_S)  # the last of the loop's workers may still be on its way out
    assert set(threading.enumerate()) <= before
    client.close()  # again: nothing more to do
    with pytest.raises(RuntimeError, match="closed"):
        client.maps()


def test_without_the_package_of_the_service(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "service.embedded", None)
    with pytest.raises(errors.MissingDependency, match=r"In a clone, run: pip install \."):
        Client.embedded(tmp_path)
