"""Tests of queries over HTTP: pose, stored options and repeatability."""

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
            f"{path}/frames", **shot.form(**meta), headers={"Prefer": "wait=200"}
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


def test_what_is_asked_is_not_kept(served, rooms, moved):
    before = served.client.get(rooms["path"]).json()
    asked(served, rooms, moved, stages="retrieve")
    after = served.client.get(rooms["path"]).json()
    assert before.keys() == after.keys()
    del before["recent_queries"], after["recent_queries"]  # they are counted a moment later
    assert after == before


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
