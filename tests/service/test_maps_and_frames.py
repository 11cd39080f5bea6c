"""Tests of maps and frames over HTTP: creation, upload, lists and deletion."""

from datetime import datetime

import numpy as np
import pytest

from benchmarks.waiting import until


def test_a_map_is_made_once_and_stays_as_it_was_made(served, refused):
    first = served.client.post("/v1/maps", json={"name": "hall", "title": "The hall"})
    again = served.client.post("/v1/maps", json={"name": "hall", "title": "The hall"})
    assert (first.status_code, again.status_code) == (201, 200)
    assert first.headers["location"] == "/v1/maps/hall" == again.headers["location"]
    assert first.json() == again.json() == served.client.get("/v1/maps/hall").json()
    record = first.json()
    assert (record["name"], record["title"], record["frames"], record["revision"]) == (
        "hall", "The hall", {}, 0,
    )  # fmt: skip
    assert record["model"] == f"depth-{record['model_id'][:12]}"
    assert datetime.fromisoformat(record["created_at"]).utcoffset() is not None
    for other in ({"title": "Another"}, {}, {"title": "The hall", "model": "paper"}):
        answer = served.client.post("/v1/maps", json={"name": "hall", **other})
        refused(answer, 409, "map-exists", "'hall'")
    assert served.client.get("/v1/maps/hall").json()["title"] == "The hall"
    names = [map_["name"] for map_ in served.client.get("/v1/maps").json()["items"]]
    assert "hall" in names
    assert names == sorted(names)


@pytest.mark.parametrize("name", ["../x", "", "a" * 64, "é"])
def test_what_is_no_slug_is_no_name(served, refused, name):
    problem = refused(
        served.client.post("/v1/maps", json={"name": name}), 422, "invalid-request", "name: "
    )
    assert [error["field"] for error in problem["errors"]] == ["name"]
    assert name not in [map_["name"] for map_ in served.client.get("/v1/maps").json()["items"]]


def test_an_upload_is_safe_then_signed_and_the_same_one_is_there_already(
    served, make_map, small_shots, refused
):
    path = make_map(served, "once")
    shot = small_shots[0]
    meta = {"robot": "r2", "session": "monday", "tags": ["a", "b"],
            "captured_at": "2024-05-01T12:00:00.250+02:00"}  # fmt: skip
    sent = served.client.post(f"{path}/frames", **shot.form(**meta))
    assert sent.status_code == 202
    added = sent.json()
    assert added["state"] in ("received", "signing")
    assert sent.headers["location"] == f"/v1/jobs/{added['job_id']}"
    assert served.client.get(sent.headers["location"]).json()["frame_id"] == added["frame_id"]
    waited = served.client.post(
        f"{path}/frames", **small_shots[1].form(**meta), headers={"Prefer": "wait=200"}
    )
    assert waited.status_code == 201, waited.text
    assert waited.headers["preference-applied"] == "wait=200"
    assert waited.json()["state"] == "indexed"
    assert waited.json()["frame_id"] != added["frame_id"]
    again = served.client.post(f"{path}/frames", **shot.form(**meta))
    assert again.status_code == 200
    assert again.json() == {**added, "state": "indexed"}  # the one worker takes them in order
    assert again.headers["location"] == sent.headers["location"]
    for other, names in (
        ({**meta, "robot": "d2"}, "robot"),
        ({**meta, "tags": ["b", "a"], "session": None}, "session, tags"),
        ({**meta, "captured_at": "2024-05-01T12:00:00.251+02:00"}, "captured_at"),
    ):
        answer = served.client.post(f"{path}/frames", **shot.form(**other))
        text = f"Frame {added['frame_id']} has the same content, but a different {names}."
        refused(answer, 409, "frame-conflict", text)
    frame = served.client.get(f"{path}/frames/{added['frame_id']}").json()
    assert (frame["state"], frame["bytes"]) == ("indexed", len(shot.png))
    assert frame["captured_at"] == "2024-05-01T10:00:00.250000Z"
    assert frame["intrinsics"] == {**shot.camera, "distortion": []}
    assert frame["job_id"] == added["job_id"]
    job = served.client.get(f"/v1/jobs/{added['job_id']}").json()
    assert (job["state"], job["attempts"], job["error"]) == ("succeeded", 1, None)
    assert job["created_at"] <= job["started_at"] <= job["finished_at"]
    assert served.client.get(path).json()["frames"] == {"indexed": 2}


NO_WAIT = ("wait=0", "wait=-5", "respond-async", "awaited=9", "wait=x", "wait")


@pytest.mark.parametrize("prefer", NO_WAIT)
def test_what_asks_for_no_wait_is_not_waited_for(served, small_shots, prefer):
    served.client.post("/v1/maps", json={"name": "hurried", "model": "depth"})
    shot = small_shots[80 + NO_WAIT.index(prefer)]
    sent = served.client.post("/v1/maps/hurried/frames", **shot.form(), headers={"Prefer": prefer})
    assert (sent.status_code, sent.headers.get("preference-applied")) == (202, None)


def test_a_list_of_maps_is_the_maps_one_by_one(served, small_shots):
    """The list counts frames, poses and queries of all maps together."""
    pose = {"parent_frame": "odom", "matrix": np.eye(4).tolist()}
    for name, number in (("counted", 90), ("queried", 91)):
        served.client.post("/v1/maps", json={"name": name, "model": "depth"})
        form = small_shots[number].form(pose=pose)
        sent = served.client.post(f"/v1/maps/{name}/frames", **form, headers={"Prefer": "wait=200"})
        assert sent.json()["state"] == "indexed", sent.text
    answer = served.client.post("/v1/maps/queried/queries", **small_shots[91].form())
    assert answer.status_code == 200
    # the query log is written after the answer
    until(lambda: served.client.get("/v1/maps/queried").json()["recent_queries"])
    listed = {map_["name"]: map_ for map_ in served.client.get("/v1/maps").json()["items"]}
    for name, queries in (("counted", {}), ("queried", {answer.json()["status"]: 1})):
        one = listed[name]
        assert one == served.client.get(f"/v1/maps/{name}").json()
        assert (one["frames"], one["posed_frames"], one["parent_frames"], one["recent_queries"]) \
            == ({"indexed": 1}, 1, 1, queries)  # fmt: skip
