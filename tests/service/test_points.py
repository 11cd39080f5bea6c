"""Tests of points over HTTP: type, ETag, limits and errors."""

import struct

import pytest

KIND = "application/vnd.sceneprint.points"


@pytest.fixture(scope="module")
def drawn(served, make_map, small_shots):
    """A map of two views, and an answer to one of them."""
    path = make_map(served, "drawn")
    ids = [served.index(path, shot) for shot in small_shots[:2]]
    reply = served.client.post(f"{path}/queries", json={"frame_id": ids[0], "seed": 1})
    assert reply.status_code == 200
    return {"path": path, "ids": ids, "answer": reply.json()}


def test_points_are_files(served, drawn):
    query = f"/v1/queries/{drawn['answer']['query_id']}"
    match = f"{query}/matches/{drawn['ids'][1]}/points?map=drawn"
    tags = set()
    for url in (f"{drawn['path']}/frames/{drawn['ids'][0]}/points", f"{query}/points", match,
                f"{match}&side=match", f"{match}&transform=none"):  # fmt: skip
        first = served.client.get(url)
        assert (first.status_code, first.headers["content-type"]) == (200, KIND), first.text
        magic, version, _, count, stride = struct.unpack_from("<4sHHII", first.content)
        assert (magic, version, stride) == (b"SPPT", 1, 12)
        assert len(first.content) == 48 + 12 * count > 48
        assert first.headers["cache-control"] == "private, no-cache"
        tags.add(first.headers["etag"])
        again = served.client.get(url, headers={"If-None-Match": first.headers["etag"]})
        assert (again.status_code, again.content) == (304, b"")
        few = served.client.get(url, params=dict(first.url.params) | {"limit": 10})
        assert len(few.content) == 48 + 120
        tags.add(few.headers["etag"])
    assert len(tags) == 10


def test_refusals_of_points(served, drawn, refused):
    frame = f"{drawn['path']}/frames/{drawn['ids'][0]}/points"
    query = f"/v1/queries/{drawn['answer']['query_id']}"
    match = f"{query}/matches/{drawn['ids'][1]}/points"
    for url in (frame, f"{query}/points", match):
        refused(served.client.get(f"{url}?limit=100001"), 422, "invalid-request", "limit")
    refused(served.client.get(f"{frame}?frame=parent"), 422, "invalid-request", "frame")
    refused(served.client.get(f"{match}?side=left"), 422, "invalid-request", "side")
    refused(served.client.get(f"{match}?map=elsewhere"), 404, "unknown-frame", "in map")
    refused(served.client.get(f"/v1/queries/{'0' * 32}/points"), 404, "unknown-query", "expired")
    bare = {"frame_id": drawn["ids"][0], "stages": "retrieve"}
    quick = served.client.post(f"{drawn['path']}/queries", json=bare).json()["query_id"]
    for tail in ("points", f"matches/{drawn['ids'][1]}/points"):
        reply = served.client.get(f"/v1/queries/{quick}/{tail}")
        refused(reply, 409, "not-indexed")
