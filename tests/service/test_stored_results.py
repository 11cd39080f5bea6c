"""Tests of stored results over HTTP, which require access to every map of the query."""

from __future__ import annotations

import uuid
from typing import Any

import numpy as np
import pytest

from sceneprint.engine.results.query_entry import SentQuery, StoredAnswer, query_row
from sceneprint.settings import Settings
from sceneprint.store.maps import add_frame, find_map
from sceneprint_client.api import Answer, Counts, NewMap, Query
from sceneprint_client.api.query import FrameName
from tests.whole_engine import Engine


@pytest.fixture(scope="module")
def asked(served, make_map, shots) -> dict[str, Any]:
    """A map of three views, and the answer to one of them that was cut a little."""
    path = make_map(served, "looked-at")
    for i in (0, 1, 3):
        sent = served.client.post(
            f"{path}/frames", **shots[i].form(session="s"), headers={"Prefer": "wait=200"}
        )
        assert sent.json()["state"] == "indexed"
    form = shots[0].form(pose={"parent_frame": "w", "matrix": np.eye(4).tolist()})
    form["data"]["seed"] = "3"
    reply = served.client.post(f"{path}/queries", **form)
    assert reply.status_code == 200
    answer: dict[str, Any] = reply.json()
    assert answer["status"] == "found"
    return answer | {"text": reply.text}


def test_the_answer_is_told_in_the_same_bytes(served, asked, shots):
    reply = served.client.get(f"/v1/queries/{asked['query_id']}")
    assert reply.status_code == 200
    assert reply.text == asked["text"]
    form = shots[1].form()
    form["data"]["keep"] = "false"
    unkept = served.client.post("/v1/maps/looked-at/queries", **form).json()
    assert served.client.get(f"/v1/queries/{unkept['query_id']}").status_code == 404


def test_what_is_not_there(served, asked, refused):
    path, best = f"/v1/queries/{asked['query_id']}", asked["matches"][0]["frame_id"]
    for tail in ("", "/cloud.ply", "/similarities", "/matches/x", "/matches/x/overlay.ply"):
        for query_id in ("0" * 32, "..%2fsceneprint.db", "x", asked["query_id"].upper()):
            reply = served.client.get(f"/v1/queries/{query_id}{tail}")
            assert reply.status_code == 404
            if "%" not in query_id:
                refused(reply, 404, "unknown-query", "expired")
    refused(served.client.get(f"{path}/matches/nobody"), 404, "unknown-frame", "has no match")
    reply = served.client.get(f"{path}/matches/{best}?map=elsewhere")
    refused(reply, 404, "unknown-frame", "in map 'elsewhere'")
    for wrong in ("color=pink", "transform=best"):
        reply = served.client.get(f"{path}/matches/{best}/overlay.ply?{wrong}")
        refused(reply, 422, "invalid-request", wrong.partition("=")[0])
    for limit in (0, 201, "many"):
        refused(
            served.client.get(f"{path}/similarities?limit={limit}"), 422, "invalid-request", "limit"
        )
    wall = asked["matches"][-1]["frame_id"]
    reply = served.client.get(f"{path}/matches/{wall}/overlay.ply?transform=rival")
    refused(reply, 422, "invalid-request", "has no rival")
    bare = {"frame_id": best, "stages": "retrieve"}
    quick = served.client.post("/v1/maps/looked-at/queries", json=bare).json()
    reply = served.client.get(f"/v1/queries/{quick['query_id']}/cloud.ply")
    refused(reply, 409, "not-indexed", "without validation")
    assert served.client.delete(f"/v1/maps/looked-at/frames/{best}").status_code == 204
    refused(served.client.get(f"{path}/matches/{best}"), 404, "unknown-frame", "was deleted")


def test_an_answer_is_seen_by_who_may_read_all_of_it(begin):
    server = begin("--host", "0.0.0.0", "--workers", "0")
    server.client.base_url = server.url.replace("0.0.0.0", "127.0.0.1")
    counts = Counts(map=0, passed=0, compared=0, ranked=0, selected=0, validated=0, accepted=0)

    def answered(engine: Engine, maps: list[str], home: str | None = None) -> str:
        answer = Answer(
            query_id=uuid.uuid4().hex, status="not_found", matches=[], location=None, seed=0,
            model="m", index_version=0, exact=True, counts=counts, milliseconds={}, maps=maps,
            frame=None if home is None else FrameName(map=home, frame_id="f"),
        )  # fmt: skip
        sent = SentQuery(maps, Query(), frame=answer.frame)
        shown = [] if home is None else [1]
        engine.query_log.note(
            query_row(sent, answer, 0.0),
            StoredAnswer(answer, Query(), "a" * 64, np.zeros(4, np.uint8), None), shown,
        )  # fmt: skip
        assert engine.query_log.flush(60)
        return answer.query_id

    known = {
        "content_id": "c", "blob": "00" * 32, "bytes": 3, "intrinsics": {}, "depth_scale": 1.0,
        "depth_along_ray": False, "tags": [], "robot": None, "session": None,
        "captured_at": None, "pose_parent": None, "pose": None,
    }  # fmt: skip
    with Engine(Settings(data_dir=server.folder)) as engine:
        for name in "ab":
            engine.create_map(NewMap(name=name, model="depth"))
        with engine.store.database.write() as connection:
            add_frame(connection, find_map(connection, "b").number, known, "f")
        keys = {
            "a": engine.create_key("a", {"a": "read"}).secret,
            "both": engine.create_key("both", {"a": "read", "b": "write"}).secret,
            "all": engine.create_key("all", {"*": "read"}).secret,
        }
        ids = {
            "of a": answered(engine, ["a"]),
            "of both": answered(engine, ["a", "b"]),
            "of a, asked with b's": answered(engine, ["a"], "b"),
        }
    seen = {
        (who, what)
        for who, secret in keys.items()
        for what, query_id in ids.items()
        if server.client.get(
            f"/v1/queries/{query_id}", headers={"Authorization": f"Bearer {secret}"}
        ).status_code
        == 200
    }
    assert seen == {("a", "of a")} | {
        (who, what) for who in ("both", "all") for what in list(ids)[:3]
    }
    # word for word as where there is none, on every path
    headers = {"Authorization": f"Bearer {keys['a']}"}
    for tail in ("", "/cloud.ply", "/similarities", "/matches/f", "/matches/f/overlay.ply"):
        told = []
        for query_id in (ids["of both"], "0" * 32):
            reply = server.client.get(f"/v1/queries/{query_id}{tail}", headers=headers)
            told.append({**reply.json(), "instance": ""})
            told[-1]["detail"] = told[-1]["detail"].replace(query_id, "")
        assert told[0] == told[1]
        assert told[0]["status"] == 404
