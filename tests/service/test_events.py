"""Tests of events over HTTP, as resumable streams and as pages, by permission."""

import json
import signal
import threading
from contextlib import ExitStack

import pytest

from benchmarks.waiting import PATIENCE_S
from sceneprint.settings import Settings
from tests.whole_engine import Engine

STREAM = {"Accept": "text/event-stream"}


@pytest.fixture(scope="module")
def guarded(begin):
    """A server that asks for keys and keeps two streams."""
    server = begin("--host", "0.0.0.0", "--workers", "0", max_event_streams=2)
    server.client.base_url = server.url.replace("0.0.0.0", "127.0.0.1")
    return server


@pytest.fixture(scope="module")
def keys(guarded):
    """Headers that show a key, by what it may."""
    grants = {
        "admin": {"*": "admin"}, "every": {"*": "read"}, "mine": {"mine": "write"}
    }  # fmt: skip
    with Engine(Settings(data_dir=guarded.folder)) as engine:
        tokens = {name: engine.create_key(name, granted).secret for name, granted in grants.items()}
    headers = {name: {"Authorization": f"Bearer {secret}"} for name, secret in tokens.items()}
    for name in ("mine", "theirs"):
        path, body = "/v1/maps", {"name": name, "model": "depth"}
        assert guarded.client.post(path, json=body, headers=headers["admin"]).status_code == 201
    return headers


def parts(response):
    """The messages of a stream, as lines."""
    lines = []
    for line in response.iter_lines():
        if line:
            lines.append(line)
        else:
            yield lines
            lines = []


def event(lines):
    number, data = lines
    assert data.startswith("data: ")
    body = json.loads(data.removeprefix("data: "))
    assert number == f"id: {body['id']}"
    return body


def next_event(messages):
    """The next message that is an event: on a busy machine `: alive` may come before it."""
    return event(next(lines for lines in messages if lines[0] != ": alive"))


def test_a_stream_tells_what_happens_and_goes_on_where_it_broke(served, make_map, small_shots):
    client = served.client
    newest = client.get("/v1/events").json()["newest"]
    with client.stream("GET", "/v1/events", headers=STREAM) as stream:
        assert stream.headers["content-type"] == "text/event-stream; charset=utf-8"
        assert stream.headers["cache-control"] == "no-store"
        came = parts(stream)
        assert next(came) == ["retry: 1000"]
        comment, place = next(came)
        assert comment == ": alive"
        path = make_map(served, "told")
        assert place == f"id: {newest}"
        first = next_event(came)
        assert (first["kind"], first["map"], first["frame_id"]) == ("map.created", "told", None)
        sent = client.post(f"{path}/frames", **small_shots[0].form()).json()
        result = [next_event(came) for _ in range(2)]
    assert [(item["kind"], item["frame_id"], item["job_id"]) for item in result] == [
        ("frame.received", sent["frame_id"], sent["job_id"]),
        ("frame.indexed", sent["frame_id"], sent["job_id"]),
    ]
    client.delete(f"{path}/frames/{sent['frame_id']}")  # while nobody listens
    again = STREAM | {"Last-Event-ID": result[0]["id"]}
    with client.stream("GET", "/v1/events?map=told&after=0", headers=again) as stream:
        came = parts(stream)
        assert next(came) == ["retry: 1000"]
        assert next(came)[0] == ": alive"
        assert [next_event(came)["kind"] for _ in range(2)] == ["frame.indexed", "frame.deleted"]
    filters = {"map": "told", "kind": ["map.", "frame.i"], "order": "oldest"}
    page = client.get("/v1/events", params=filters).json()
    assert [item["kind"] for item in page["items"]] == ["map.created", "frame.indexed"]
    assert page["items"] == [first, result[1]]


@pytest.mark.parametrize(
    ("filters", "headers"),
    [
        ({"kind": "frame%"}, {}),
        ({"after": "0" * 32}, {}),
        ({"cursor": "x"}, {}),
        ({"limit": 1001}, {}),
        ({"order": "random"}, {}),
        ({}, {"Last-Event-ID": "1e3"}),
    ],
)
def test_what_cannot_be_asked_is_refused_before_a_stream_begins(served, refused, filters, headers):
    for accept in ({}, STREAM):
        answer = served.client.get("/v1/events", params=filters, headers=headers | accept)
        refused(answer, 422, "invalid-request")


def test_a_map_that_is_not_there_has_no_events(served, refused):
    for accept in ({}, STREAM):
        answer = served.client.get("/v1/events?map=nowhere", headers=accept)
        refused(answer, 404, "unknown-map", "There is no map 'nowhere'.")


def test_a_key_is_told_of_its_maps_alone(guarded, keys, refused):
    def kinds(key, **filters):
        answer = guarded.client.get("/v1/events", params=filters, headers=keys[key])
        return {(item["kind"], item["map"]) for item in answer.json()["items"]}

    assert kinds("admin") >= {
        ("key.created", None), ("map.created", "mine"), ("map.created", "theirs")
    }  # fmt: skip
    assert kinds("every") == {("map.created", "mine"), ("map.created", "theirs")}
    assert kinds("mine") == {("map.created", "mine")} == kinds("mine", map="mine")
    hidden = guarded.client.get("/v1/events?map=theirs", headers=keys["mine"])
    absent = guarded.client.get("/v1/events?map=absent", headers=keys["mine"])
    refused(hidden, 404, "unknown-map")
    assert hidden.json()["detail"].replace("theirs", "absent") == absent.json()["detail"]
    refused(guarded.client.get("/v1/events", headers=STREAM), 401, "key-required")
    headers = keys["mine"] | STREAM | {"Last-Event-ID": "0"}
    with guarded.client.stream("GET", "/v1/events", headers=headers) as stream:
        came = parts(stream)
        assert next(came) == ["retry: 1000"]
        assert next(came)[0] == ": alive"
        assert next_event(came)["map"] == "mine"
        body = {"name": "theirs-too", "model": "depth"}
        guarded.client.post("/v1/maps", json=body, headers=keys["admin"])
        guarded.client.post("/v1/maps/mine/reencoding", json={"model": "paper"}, **asks(keys))
        assert next_event(came)["kind"] == "map.reencoding"


def asks(keys):
    return {"headers": keys["admin"]}


def test_places_are_given_back_and_the_end_comes_at_once(guarded, keys, refused, until):
    """Last in this file: it stops the server."""
    headers = keys["admin"] | STREAM

    def streams():
        text = guarded.client.get("/metrics", headers=keys["admin"]).text
        (line,) = [x for x in text.splitlines() if x.startswith("sceneprint_event_streams ")]
        return float(line.split()[1])

    until(lambda: streams() == 0)  # of the tests before
    with ExitStack() as open_streams:
        for key in list(keys)[:2]:  # of two tenants: one alone may have three quarters
            own = keys[key] | STREAM
            open_streams.enter_context(guarded.client.stream("GET", "/v1/events", headers=own))
        assert streams() == 2
        answer = guarded.client.get("/v1/events", headers=headers)
        refused(answer, 503, "busy")
        assert answer.headers["retry-after"] == "1"
        page = guarded.client.get("/v1/events", headers=keys["admin"])
        assert page.status_code == 200
    until(lambda: streams() == 0)  # who hangs up frees the place
    ended = threading.Event()

    def listen():
        with guarded.client.stream("GET", "/v1/events", headers=headers) as stream:
            begun.set()
            for _ in stream.iter_lines():
                pass
        ended.set()

    begun = threading.Event()
    listener = threading.Thread(target=listen)
    listener.start()
    assert begun.wait(PATIENCE_S)
    guarded.tell(signal.SIGTERM)
    listener.join(PATIENCE_S)
    assert guarded.end() == 0
    assert ended.is_set()  # by a whole answer: a broken one would have raised
    log = [line for line in guarded.log("request") if line["path"] == "/v1/events"]
    assert log[-1]["status"] == 200
