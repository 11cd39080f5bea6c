"""Tests of events, statistics, models and re-encoding through the client."""

from __future__ import annotations

import itertools
from datetime import UTC, datetime

import httpx
import pytest

from benchmarks.waiting import PATIENCE_S
from sceneprint.errors import Conflict, InvalidRequest, UnknownMap
from sceneprint.models import PRESETS, read_model
from sceneprint_client import Client
from sceneprint_client.api.admin import Event
from sceneprint_client.http import ServiceConnection, StreamPosition


def test_events_that_are_kept(client, map_name, references):
    client.create_map(map_name, model="depth")
    added = client.upload(map_name, references[0], wait_s=PATIENCE_S)
    client.delete_frame(map_name, added.frame_id)
    events = list(client.events(map_name, follow=False))
    assert [(event.kind, event.frame_id) for event in events] == [
        ("map.created", None),
        ("frame.received", added.frame_id),
        ("frame.indexed", added.frame_id),
        ("frame.deleted", added.frame_id),
    ]
    page = client.event_page(map_name, kinds=["frame."], limit=2)
    assert page.items == events[:1:-1]
    rest = client.event_page(map_name, kinds=["frame."], limit=2, cursor=page.next_cursor)
    assert (rest.items, rest.next_cursor) == (events[1:2], None)
    assert list(client.events(map_name, after=events[2].id, follow=False)) == events[3:]
    for follow in (False, True):
        with pytest.raises(InvalidRequest, match="Start again"):
            next(client.events(after="none", follow=follow))
        with pytest.raises(UnknownMap):
            next(client.events("nowhere", follow=follow))


def test_models_and_reencoding(embedded, map_name):
    """Nobody works here, so that it is surely under way."""
    client = embedded
    created = client.create_map(map_name, model="depth")
    listed = client.models()
    assert [row.name for row in listed][: len(PRESETS)] == list(PRESETS)
    depth = next(row for row in listed if row.name == "depth")
    assert depth.model_id == read_model("depth").id
    assert map_name in depth.maps
    record = client.reencode(map_name, read_model("paper").label)
    assert record.reencoding.model_id == read_model("paper").id
    with pytest.raises(Conflict):
        client.reencode(map_name, depth.model_id)
    assert client.cancel_reencoding(map_name) == created


EVENT = Event(
    id="7", at=datetime(2026, 11, 21, 20, tzinfo=UTC), kind="map.created", map="hall",
    frame_id=None, job_id=None, data={"a": "b"},
)  # fmt: skip


def test_a_stream_is_read_as_the_standard_says():
    data = EVENT.model_dump_json()
    half = data.index(",") + 1
    lines = [
        "retry: 20", "", ": a comment", "id: 3", "", "event: message", "id:7",
        f"data: {data[:half]}", f"data:{data[half:]}", "", "id: 9", "data: {",
    ]  # fmt: skip
    place = StreamPosition(None)
    result = [(one, place.last) for line in lines if (one := place.read(line)) is not None]
    assert result == [(EVENT, "7")]
    # the position is still before the incomplete event
    assert place == StreamPosition("7", 0.02)


#: Bodies of a stream that ends three times, the service being away in between.
STREAMS = [
    f"retry: 10\n\nid: 4\n\nid: 5\ndata: {EVENT.model_dump_json()}\n\nid: 6\ndata: {{",
    None,
    f"id: 6\ndata: {EVENT.model_dump_json()}\n\n: alive\nid: 8\n\n",
    f"id: 9\ndata: {EVENT.model_dump_json()}\n\n",
]


class Stream:
    def __init__(self):
        self.after: list[str | None] = []

    def __call__(self, request):
        self.after.append(request.headers.get("Last-Event-ID"))
        body = STREAMS[len(self.after) - 1]
        if body is None:
            raise httpx.ProxyError("a proxy restarts")  # is not retried within a request
        return httpx.Response(200, text=body)


def test_a_broken_stream_continues_where_it_broke():
    stream = Stream()
    client = Client.__new__(Client)
    ServiceConnection.__init__(client, "http://x", None, 5.0, httpx.MockTransport(stream))
    with client:
        assert list(itertools.islice(client.events(), 3)) == [EVENT] * 3
    assert stream.after == [None, "5", "5", "8"]
