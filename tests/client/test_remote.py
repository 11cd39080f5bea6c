"""Tests of network effects: retries, rejected requests and addresses."""

import logging
import socket
import time
from datetime import UTC, datetime, timedelta
from email.utils import format_datetime

import pytest

from sceneprint import errors as our_errors
from sceneprint_client import Client, errors, http, meta_of
from sceneprint_client.http import retry_after_s
from service.problems import type_of

MAP = {
    "name": "m", "title": None, "model": "paper-0", "model_id": "0", "revision": 0,
    "created_at": "2026-01-01T00:00:00Z", "frames": {},
}  # fmt: skip
ADDED = {"frame_id": "f", "job_id": "j", "state": "received", "reason": None}


def problem(kind, status, **more):
    document = {"type": f"https://x/problems/{kind}", "title": kind, "status": status}
    return status, {}, {**document, "detail": f"it is {kind}", **more}


def test_a_busy_service_is_asked_again_when_it_said(scripted):
    busy = problem("busy", 503)
    server = scripted([(503, {"Retry-After": "1"}, busy[2]), (200, {}, MAP)])
    with Client(server.url) as client:
        start = time.monotonic()
        assert client.map("m").name == "m"
        assert time.monotonic() - start >= 1.0
    assert [request[:2] for request in server.requests] == [("GET", "/v1/maps/m")] * 2


@pytest.mark.usefixtures("hasty")
def test_an_upload_survives_a_broken_connection_whole(scripted, references):
    server = scripted([(0, {}, None), (429, {}, None), (202, {}, ADDED)])
    with Client(server.url, "secret") as client:
        added, new = client.add("m", references[0], wait_s=7.9)
    assert (added.frame_id, new) == ("f", True)
    assert len(server.requests) == 3
    for (method, path, body), headers in zip(server.requests, server.headers, strict=True):
        assert (method, path) == ("POST", "/v1/maps/m/frames")
        assert references[0].path.read_bytes() in body
        assert b'"parent_frame"' not in body  # it is the session's name
        assert headers["Authorization"] == "Bearer secret"
        assert headers["Prefer"] == "wait=7"
        assert headers["User-Agent"].startswith("sceneprint-client/")


@pytest.mark.usefixtures("hasty")
def test_patience_ends(scripted):
    server = scripted([problem("busy", 503)])
    with Client(server.url) as client, pytest.raises(errors.Busy, match="it is busy"):
        client.maps()
    assert len(server.requests) == http.TRIES == 8
    server = scripted([(503, {"Retry-After": "31"}, problem("busy", 503)[2])])
    with Client(server.url) as client, pytest.raises(errors.Busy):
        client.maps()  # at once: nobody waits half a minute
    assert len(server.requests) == 1
    server = scripted([(0, {}, None)])
    with Client(server.url) as client, pytest.raises(errors.Unreachable, match="cannot be reached"):
        client.maps()
    assert len(server.requests) == http.TRIES == 8


@pytest.mark.usefixtures("hasty")
@pytest.mark.parametrize("status", [502, 503, 504])
def test_a_proxy_without_a_service_is_out_of_reach(scripted, status):
    server = scripted([(status, {}, "<h1>Nobody is there</h1>")])
    with (
        Client(server.url) as client,
        pytest.raises(errors.Unreachable, match=rf"answered {status} .*a proxy in front of"),
    ):
        client.maps()


@pytest.mark.usefixtures("hasty")
def test_what_was_deleted_by_a_try_without_answer_is_deleted(scripted):
    server = scripted([(0, {}, None), problem("unknown-frame", 404)])
    with Client(server.url) as client:
        client.delete_frame("m", "f")
    assert len(server.requests) == 2
    server = scripted([problem("unknown-frame", 404)])
    with Client(server.url) as client, pytest.raises(errors.UnknownFrame, match="it is unknown"):
        client.delete_frame("m", "f")


@pytest.mark.parametrize(
    ("kind", "status", "error"),
    [
        ("damaged-blob", 500, errors.DamagedBlob),
        ("of-the-future", 400, errors.Refused),
        ("invalid-request", 422, errors.InvalidRequest),
    ],
)
def test_problems_become_errors_and_are_not_repeated(scripted, kind, status, error):
    fields = [{"field": "k", "reason": "too large"}, "nonsense", {"field": "seed"}]
    server = scripted([problem(kind, status, errors=fields, instance="/requests/7")])
    with Client(server.url) as client, pytest.raises(error, match=f"it is {kind}") as raised:
        client.map("m")
    assert len(server.requests) == 1
    assert type(raised.value) is error
    if error is errors.InvalidRequest:
        assert raised.value.fields == (("k", "too large"),)
    if error is errors.Refused:
        assert (raised.value.status, raised.value.problem["instance"]) == (400, "/requests/7")


def test_another_kind_of_server(scripted):
    for reply, message in (
        ((404, {}, {"message": "nothing here"}), "answered 404 Not Found without a reason"),
        ((301, {"Location": "https://x/"}, None), "answered 301 Moved Permanently without"),
        ((200, {}, {"hello": "world"}), "is not valid for this version"),
    ):
        server = scripted([reply])
        with Client(server.url) as client, pytest.raises(errors.Refused, match=message):
            client.map("m")
        with Client(server.url) as client:
            assert not client.healthy()


def test_pages_are_followed(scripted):
    frame = {
        "map": "m", "state": "received", "reason": None, "job_id": "j", "content_id": "c",
        "bytes": 1, "depth_scale": 1000, "depth_along_ray": False, "robot": None, "session": None,
        "captured_at": None, "received_at": "2026-01-01T00:00:00Z", "indexed_at": None,
        "pose": None, "tags": [],
        "intrinsics": {"width": 1, "height": 1, "fx": 1, "fy": 1, "cx": 0, "cy": 0},
    }  # fmt: skip
    pages = [
        {"items": [{**frame, "frame_id": i} for i in ids], "next_cursor": following}
        for ids, following in (("ab", "2"), ("c", "3"), ("", None))
    ]
    server = scripted([(200, {}, page) for page in pages])
    with Client(server.url) as client:
        assert [frame.frame_id for frame in client.frames("m")] == ["a", "b", "c"]
    assert [path for _, path, _ in server.requests] == [
        "/v1/maps/m/frames?limit=200",
        "/v1/maps/m/frames?cursor=2&limit=200",
        "/v1/maps/m/frames?cursor=3&limit=200",
    ]


@pytest.mark.parametrize("url", ["foo", "ftp://host", "http://", "http://[::1", "", "host:8008"])
def test_addresses_that_are_none(url):
    with pytest.raises(errors.Unreachable, match="not the address of a service"):
        Client(url)


@pytest.mark.usefixtures("hasty")
def test_nobody_there():
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        url = f"http://127.0.0.1:{listener.getsockname()[1]}"
        with Client(url) as client:
            assert not client.healthy()
            with pytest.raises(errors.Unreachable, match="sceneprint serve") as raised:
                client.maps()
    assert "\n" not in str(raised.value)
    assert str(raised.value).startswith(url)


def test_who_answered_before_is_waited_for(scripted, monkeypatch):
    def tries_on(client):
        pauses = []
        with monkeypatch.context() as patch:
            patch.setattr("sceneprint_client.http.time.sleep", pauses.append)
            with pytest.raises(errors.Unreachable):
                client.map("m")
        assert sum(pauses) < http.LIMIT_S
        return 1 + len(pauses)

    server = scripted([(200, {}, MAP)])
    with Client("http://127.0.0.1:1") as stranger, Client(server.url) as client:
        assert tries_on(stranger) == http.TRIES_UNMET == 2
        assert client.map("m").name == "m"
        server.stop()
        assert tries_on(client) == http.TRIES


@pytest.mark.usefixtures("hasty")
def test_a_silent_service():
    with socket.create_server(("127.0.0.1", 0)) as silent:
        url = f"http://127.0.0.1:{silent.getsockname()[1]}"
        with (
            Client(url, timeout_s=0.1) as client,
            pytest.raises(errors.Unreachable, match="did not answer in time"),
        ):
            client.maps()


@pytest.mark.parametrize("key", ["schlüssel☃", "top\nsecret", "top secret", "\n", ""])
def test_a_key_that_cannot_be_sent_is_not_shown(key):
    with pytest.raises(errors.KeyRequired, match="Copy it again") as raised:
        Client("http://127.0.0.1:8008", key)
    assert not key.strip() or key not in str(raised.value)


def test_a_key_is_sent_without_the_newline_of_its_file(scripted):
    server = scripted([(200, {}, MAP)])
    with Client(server.url, " secret\r\n") as client:
        client.map("m")
    assert [headers["Authorization"] for headers in server.headers] == ["Bearer secret"]


def test_too_large_a_body_is_refused_by_the_service(remote, map_name, references):
    remote.create_map(map_name)
    with pytest.raises(errors.TooLarge, match="the limit of 2097152 bytes"):
        remote.upload(map_name, bytes(3 << 20), meta_of(references[0]))
    remote.delete_map(map_name)


def test_no_line_a_request_in_the_users_log(remote, caplog):
    caplog.set_level(logging.INFO)
    remote.maps()
    assert [record for record in caplog.records if record.name.startswith("http")] == []
    logging.getLogger("httpx").info("HTTP Request: %s %s", "GET", "http://elsewhere/")
    assert len(caplog.records) == 1  # what is not ours is left alone


def test_retry_after():
    assert retry_after_s("7") == 7.0
    assert retry_after_s("") == retry_after_s("soon") == retry_after_s("-1") == 0.0
    in_a_minute = datetime.now(UTC) + timedelta(seconds=60)
    assert 58.0 < retry_after_s(format_datetime(in_a_minute, usegmt=True)) <= 60.0
    assert retry_after_s("Wed, 21 Oct 2015 07:28:00 GMT") == 0.0


KINDS = [
    kind
    for kind in vars(errors).values()
    if isinstance(kind, type)
    and issubclass(kind, errors.SceneprintError)
    and not issubclass(kind, errors.ServiceError)
]


def test_every_error_keeps_its_name_over_http():
    assert errors.kebab_case("UnknownMap") == "unknown-map"
    assert errors.kebab_case("Busy") == "busy"
    assert len(KINDS) > 25
    kinds = {type_of(kind.__name__).removeprefix("/problems/"): kind for kind in KINDS}
    assert http.problem_kinds() == kinds
    assert our_errors.kebab_case is errors.kebab_case  # both ask the same place


@pytest.mark.parametrize(
    ("host", "proxied"),
    [("127.0.0.1", False), ("127.9.9.9", False), ("[::1]", False), ("LOCALHOST", False),
     ("192.0.2.1", True), ("localhost.example", True)],
)  # fmt: skip
def test_no_proxy_stands_before_this_machine(monkeypatch, host, proxied):
    monkeypatch.delenv("NO_PROXY", raising=False)
    monkeypatch.delenv("no_proxy", raising=False)
    monkeypatch.setenv("http_proxy", "http://192.0.2.7:3128")
    with Client(f"http://{host}:8008") as client:
        assert bool(client._http._mounts) == proxied
