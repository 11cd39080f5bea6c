"""Queries over HTTP: found with the right pose, told as they were asked, the same every time."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest

STAGES = ("prepare", "retrieve", "diversify", "validate", "locate", "total")


@pytest.fixture(scope="module")
def rooms(served, make_map, shots) -> dict[str, Any]:
    """A map with the first two views of each of two rooms, by its path and frame ids."""
    path = make_map(served, "rooms")
    ids = []
    for i in (0, 1, 3, 4):
        shot = shots[i]
        meta = {"session": f"room {i // 3}", "robot": "r1", "pose": {"matrix": shot.pose}}
        sent = served.client.post(
            f"{path}/frames", **shot.form(**meta), headers={"Prefer": "wait=60"}
        )
        assert sent.json()["state"] == "indexed"
        ids.append(sent.json()["frame_id"])
    return {"path": path, "ids": ids, "views": [0, 1, 3, 4]}


@pytest.fixture(scope="module")
def moved(room_frames, shoot) -> Any:
    """The first view without its top and left, as another camera would have taken it."""
    frame = room_frames[0]
    k = frame.intrinsics
    from sceneprint.types import Intrinsics

    lens = Intrinsics(600, 440, k.fx, k.fy, k.cx - 40, k.cy - 40)
    return shoot(np.ascontiguousarray(frame.depth[40:, 40:]), lens, frame.pose.tolist())


def asked(served, rooms, shot, **options: object) -> dict[str, Any]:
    form = shot.form()
    form["data"].update({key: str(value) for key, value in options.items()})
    answer = served.client.post(f"{rooms['path']}/queries", **form)
    assert answer.status_code == 200, answer.text
    found: dict[str, Any] = json.loads(answer.text, parse_constant=lambda s: pytest.fail(s))
    return found


def matrix(transform: dict[str, Any]) -> np.ndarray:
    T = np.array(transform["matrix"])
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-9)
    np.testing.assert_array_equal(T[3], [0, 0, 0, 1])
    t, r = transform["translation"], transform["rotation"]
    np.testing.assert_array_equal(T[:3, 3], [t["x"], t["y"], t["z"]])
    x, y, z, w = r["x"], r["y"], r["z"], r["w"]
    assert math.isclose(x * x + y * y + z * z + w * w, 1, abs_tol=1e-9)
    turned = 2 * np.array([[-y * y - z * z, x * y - z * w, x * z + y * w],
                           [x * y + z * w, -x * x - z * z, y * z - x * w],
                           [x * z - y * w, y * z + x * w, -x * x - y * y]]) + np.eye(3)  # fmt: skip
    np.testing.assert_allclose(T[:3, :3], turned, atol=1e-9)
    return T


def apart(A: np.ndarray, B: np.ndarray) -> tuple[float, float]:
    """Metres and degrees between two poses."""
    D = np.linalg.inv(A) @ B
    cosine = np.clip((np.trace(D[:3, :3]) - 1) / 2, -1, 1)
    return float(np.linalg.norm(D[:3, 3])), float(np.degrees(np.arccos(cosine)))


def timeless(answer: dict[str, Any]) -> dict[str, Any]:
    return {k: v for k, v in answer.items() if k not in ("query_id", "milliseconds")}


def test_a_view_is_found_with_its_pose(served, rooms, moved):
    answer = asked(served, rooms, moved, seed=7)
    assert (answer["status"], answer["seed"], answer["exact"]) == ("found", 7, True)
    best = answer["matches"][0]
    assert (best["frame_id"], best["map"], best["robot"]) == (rooms["ids"][0], "rooms", "r1")
    assert (best["rank"], best["session"], best["selected"]) == (1, "room 0", True)
    assert best["validation"]["status"] == "accepted"
    assert best["validation"]["strength"] == "strong"
    assert best["transform"]["parent_frame"] == f"{best['frame_id']}.optical"
    assert best["transform"]["child_frame"] == "query.optical"
    truth = np.array(moved.pose)  # the same sensor at the same place
    T, in_map = matrix(best["transform"]), matrix(best["pose_in_map"])
    np.testing.assert_allclose(in_map, truth @ T, atol=1e-9)  # pose of the match, then T
    assert best["pose_in_map"]["parent_frame"] == "r1/room 0"
    for pose in (in_map, matrix(answer["location"]["pose"])):
        metres, degrees = apart(truth, pose)
        assert (metres < 0.05, degrees < 5) == (True, True), (metres, degrees)
    assert answer["location"]["pose"]["parent_frame"] == "r1/room 0"
    counts = answer["counts"]
    accepted = sum(m["validation"]["status"] == "accepted" for m in answer["matches"])
    assert (counts["map"], counts["compared"], counts["ranked"]) == (4, 4, 4)
    assert (counts["accepted"], counts["selected"]) == (accepted, 4)
    for match in answer["matches"]:
        if match["session"] == "room 1":
            assert match["validation"]["status"] != "accepted"
    assert list(answer["milliseconds"]) == list(STAGES)
    spent = [answer["milliseconds"][stage] for stage in STAGES]
    assert sum(spent[:-1]) == pytest.approx(spent[-1], abs=0.05)
    assert all(value >= 0 for value in spent)


def test_a_view_that_shares_too_little_is_not_found(served, rooms, shots):
    answer = asked(served, rooms, shots[2])
    assert (answer["status"], answer["location"]) == ("not_found", None)
    assert (answer["counts"]["accepted"], answer["counts"]["validated"]) == (0, 4)
    for match in answer["matches"]:
        assert match["validation"]["status"] == "rejected"
        assert len(match["validation"]["reason"]) > 10


def test_the_same_question_has_the_same_answer(served, rooms, moved):
    first = asked(served, rooms, moved, seed=3)
    again = asked(served, rooms, moved, seed=3)
    assert timeless(first) == timeless(again)
    assert first["query_id"] != again["query_id"]
    scanned = asked(served, rooms, moved, seed=3, exact="true")
    assert timeless(scanned) == timeless(first)  # so small a map is always scanned


def test_a_frame_of_the_map_finds_others_and_not_itself(served, rooms, shots):
    own = rooms["ids"][0]
    reply = served.client.post(f"{rooms['path']}/queries", json={"frame_id": own, "seed": 4})
    assert reply.status_code == 200
    answer = reply.json()
    found = [match["frame_id"] for match in answer["matches"]]
    assert sorted(found) == sorted(rooms["ids"][1:])
    assert (answer["counts"]["map"], answer["counts"]["ranked"], answer["seed"]) == (3, 3, 4)
    for match in answer["matches"]:
        if match["transform"] is not None:
            assert match["transform"]["child_frame"] == f"{own}.optical"
    uploaded = asked(served, rooms, shots[0], seed=4)  # the same frame from outside finds it
    assert uploaded["matches"][0]["frame_id"] == own
    assert uploaded["matches"][0]["distance"] == 0
    assert uploaded["matches"][0]["similarity"] == 1.0


def test_stages_and_k_are_as_asked(served, rooms, moved):
    plain = asked(served, rooms, moved, stages="retrieve", k=2)
    assert (plain["status"], plain["location"]) == ("unvalidated", None)
    assert [match["rank"] for match in plain["matches"]] == [1, 2]
    for match in plain["matches"]:
        assert match["validation"] == {
            "status": "skipped", "strength": None, "reason": "not requested", "residual": None,
            "overlap": None, "plane_overlap": None, "free_space_violations": None,
            "planes": None, "plane_violations": None, "inliers": None, "ambiguity": None,
            "search": None, "directions": [], "tilt_deg": None,
        }  # fmt: skip
        assert (match["selected"], match["diversity_gain"]) == (None, None)
        assert (match["transform"], match["pose_in_map"]) == (None, None)
    distances = [match["distance"] for match in plain["matches"]]
    assert distances == sorted(distances)
    diverse = asked(served, rooms, moved, stages="retrieve, diversify", k=3)
    assert [match["selected"] for match in diverse["matches"]] == [True] * 3
    assert diverse["matches"][0]["diversity_gain"] == 1.0
    assert (diverse["counts"]["selected"], diverse["counts"]["validated"]) == (3, 0)
    told = []
    for stages in ("retrieve, diversify", ["retrieve", "diversify"]):  # JSON takes text as well
        body = {"frame_id": rooms["ids"][0], "k": 2, "stages": stages}
        reply = served.client.post(f"{rooms['path']}/queries", json=body)
        assert (reply.status_code, reply.json()["counts"]["selected"]) == (200, 2)
        told.append(timeless(reply.json()))
    assert told[0] == told[1]
    checked = asked(served, rooms, moved, stages="retrieve,validate", k=1)
    assert checked["counts"]["accepted"] == 1
    assert checked["counts"]["selected"] == 0
    skipped = [m for m in checked["matches"] if m["validation"]["status"] == "skipped"]
    assert {m["validation"]["reason"] for m in skipped} <= {
        "enough matches were accepted before it"
    }
    assert len(skipped) == 4 - checked["counts"]["validated"]


def test_what_is_asked_is_not_kept(served, rooms, moved):
    before = served.client.get(rooms["path"]).json()
    asked(served, rooms, moved, stages="retrieve")
    assert served.client.get(rooms["path"]).json() == before


def test_answers_are_counted(served, rooms, moved):
    def figure(name: str) -> float:
        lines = served.client.get("/metrics").text.splitlines()
        return sum(float(line.split()[-1]) for line in lines if line.startswith(name))

    before = figure('sceneprint_answers_total{status="unvalidated"}')
    asked(served, rooms, moved, stages="retrieve")
    assert figure('sceneprint_answers_total{status="unvalidated"}') == before + 1
    route = 'route="/v1/maps/{map_name}/queries",status="200"}'
    assert figure(f'sceneprint_requests_total{{method="POST",{route}') >= 1
    assert figure('sceneprint_frames{state="indexed"}') >= 4
