"""Tests of two robots' sessions in separate parent frames that are joined to one map."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from sceneprint.geometry.rigid import inverse, pose_difference
from sceneprint.types import DepthFrame
from tests.service.conftest import Server, Shot, until

pytestmark = [pytest.mark.thorough, pytest.mark.timeout(600)]


def _origin(seed):
    rng = np.random.default_rng(seed)
    u, _, vt = np.linalg.svd(rng.normal(size=(3, 3)))
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt, rng.normal(0, 4, 3)
    return T


#: T_room_parent of each robot's parent frame.
ORIGINS = {"ann/morning": _origin(1), "bob/evening": _origin(2)}
SESSIONS = {"ann": "morning", "bob": "evening"}


@dataclass(frozen=True)
class Rooms:
    """A map of two sessions on a server, and frames of the same path that are in neither.

    Parameters
    ----------
    server : see Server
    path : of the map
    held_out : frames, with their poses in the room
    shoot : a frame as it is sent
    join : of the association of the two
    association : path of it
    bob : the first frame of bob
    """

    server: Server
    path: str
    held_out: list[DepthFrame]
    shoot: Callable[..., Shot]
    join: dict[str, Any]
    association: str
    bob: Shot

    def post(self, path, **body):
        """Queue a job of the map, and return it once it has succeeded."""
        begun = self.server.client.post(f"{self.path}/{path}", json=body)
        assert begun.status_code == 202, begun.text
        return until(lambda: self._succeeded(begun.headers["location"]))

    def _succeeded(self, location):
        job = self.server.client.get(location).json()
        assert job["state"] not in ("failed", "dead", "cancelled"), job
        return job if job["state"] == "succeeded" else None

    def ask(self, frame, **query):
        """Return the answer to a query."""
        form = self.shoot(frame.depth, frame.intrinsics).form()
        form["data"] |= {name: json.dumps(value) for name, value in query.items()}
        answer = self.server.client.post(f"{self.path}/queries", **form)
        assert answer.status_code == 200, answer.text
        return answer.json()


def _sent(frame, parent, shoot):
    pose = inverse(ORIGINS[parent]) @ frame.pose
    return shoot(frame.depth, frame.intrinsics, pose.tolist())


def _add(server, path, shot, robot, second):
    form = shot.form(
        robot=robot, session=SESSIONS[robot], pose={"matrix": shot.pose},
        captured_at=f"2026-01-01T00:{second // 60:02}:{second % 60:02}Z",
    )  # fmt: skip
    return server.client.post(f"{path}/frames", **form)


@pytest.fixture(scope="module")
def rooms(served, make_map, room_views, shoot):
    """A room of which ann took every third frame, and bob the next ones, after each other."""
    path = make_map(served, "joined")
    room = room_views(21, 0, 960, along_path=True, step=8)
    of_bob = [_sent(frame, "bob/evening", shoot) for frame in room.frames[1::3]]
    runs = {
        "ann": [_sent(frame, "ann/morning", shoot) for frame in room.frames[::3]], "bob": of_bob,
    }  # fmt: skip
    for robot, run in runs.items():
        for i, shot in enumerate(run):
            assert _add(served, path, shot, robot, i).status_code == 202
    total = sum(map(len, runs.values()))
    until(lambda: served.client.get(path).json()["frames"].get("indexed") == total)
    made = Rooms(served, path, list(room.frames[2::3]), shoot, {}, "", of_bob[0])
    found = made.post("associations", sessions=["evening", "morning"])
    (join,) = found["result"]["joins"]
    return replace(made, join=join, association=f"{path}/associations/{found['job_id']}")


def test_every_answer_is_in_the_parent_frame_of_the_first_session(rooms):
    assert (rooms.join["strength"], rooms.join["root"]) == ("strong", "ann/morning")
    matched = set()
    for frame in rooms.held_out:
        answer = rooms.ask(frame)
        assert answer["status"] == "found", answer["reason"]
        pose = answer["location"]["pose"]
        assert pose["parent_frame"] == "ann/morning"
        at = ORIGINS["ann/morning"] @ np.array(pose["matrix"])
        assert pose_difference(at, frame.pose)[0] < 0.1
        for match in answer["matches"]:
            matched.add((match["robot"], match["parent_frame"]))
            assert (match["pose_in_map"] or pose)["parent_frame"] == "ann/morning"
    assert matched == {("ann", "ann/morning"), ("bob", "bob/evening")}


def test_sessions_that_are_joined_can_be_compared_and_covered(rooms):
    parents = {
        one["robot"]: one["parent_frames"]
        for one in rooms.server.client.get(f"{rooms.path}/sessions").json()["items"]
    }
    assert parents == {"ann": ["ann/morning"], "bob": ["ann/morning"]}
    changed = rooms.post("differences", before="morning", after="evening")["result"]
    assert changed["parent_frame"] == "ann/morning"
    assert changed["same"] > 10 * (changed["gone"] + changed["new"])
    covered = rooms.post("coverage", every=10, other_sessions=True)["result"]
    assert covered["unchecked"] == 0
    assert covered["found"] >= 0.8 * covered["frames"]


def test_frames_that_come_later_follow_the_join(rooms):
    client, frame = rooms.server.client, rooms.held_out[0]
    again = _add(rooms.server, rooms.path, rooms.bob, "bob", 0)
    assert again.status_code == 200  # the same content and metadata as before the join
    shot = _sent(frame, "bob/evening", rooms.shoot)
    added = _add(rooms.server, rooms.path, shot, "bob", 3000)
    assert added.status_code == 202
    url = f"{rooms.path}/frames/{added.json()['frame_id']}"
    stored = until(lambda: (one := client.get(url).json())["state"] == "indexed" and one)
    assert stored["pose"]["parent_frame"] == "ann/morning"
    here = ORIGINS["ann/morning"] @ np.array(stored["pose"]["matrix"])
    assert pose_difference(here, frame.pose)[0] < 0.1
    assert stored["sent_pose"]["parent_frame"] == "bob/evening"
    np.testing.assert_allclose(stored["sent_pose"]["matrix"], np.array(shot.pose), atol=1e-12)
    # an edit in bob's frame follows the join too, and one in another frame does not
    sent = {"parent_frame": "bob/evening", "matrix": shot.pose}
    edited = client.patch(url, json={"pose": sent}).json()
    assert (edited["pose"]["parent_frame"], edited["sent_pose"]["parent_frame"]) == (
        "ann/morning", "bob/evening",
    )  # fmt: skip
    np.testing.assert_allclose(edited["pose"]["matrix"], stored["pose"]["matrix"], atol=1e-9)
    renamed = client.patch(url, json={"pose": {"parent_frame": "hall"}}).json()
    assert renamed["pose"]["matrix"] == edited["pose"]["matrix"]
    assert (renamed["pose"]["parent_frame"], renamed["sent_pose"]) == ("hall", None)
    assert client.delete(url).status_code in (200, 204)


def test_a_prior_in_a_joined_frame_is_one_in_the_root(rooms):
    frame = rooms.held_out[-1]
    believed = (inverse(ORIGINS["bob/evening"]) @ frame.pose).tolist()
    answer = rooms.ask(
        frame,
        prior={"pose": {"parent_frame": "bob/evening", "matrix": believed}, "deviation_m": 0.05},
    )
    pose = answer["location"]["pose"]
    assert pose["parent_frame"] == "ann/morning"
    assert pose_difference(ORIGINS["ann/morning"] @ np.array(pose["matrix"]), frame.pose)[0] < 0.1


def test_a_join_is_undone(rooms):
    """The last test of the map."""
    client, url = rooms.server.client, rooms.association
    of_bob = {"robot": "bob", "limit": 1000}
    moved = client.get(f"{rooms.path}/frames", params=of_bob).json()["items"]
    refused = client.delete(url)
    assert (refused.status_code, refused.json()["type"].rpartition("/")[2]) == (409, "join-stands")
    for _ in range(2):  # the second time nothing is left to do
        undone = client.delete(f"{url}/join")
        assert undone.status_code == 200, undone.text
        (join,) = undone.json()["result"]["joins"]
        assert join == rooms.join | {"root": None, "undone": True}
    assert client.get(url).json() == undone.json()
    of_map = {"action": "association.undone", "map": rooms.path.rpartition("/")[2]}
    lines = client.get("/v1/audit", params=of_map).json()["items"]
    assert [one["target"] for one in lines] == [undone.json()["job_id"]]
    sessions = client.get(f"{rooms.path}/sessions").json()["items"]
    assert {one["robot"]: one["parent_frames"] for one in sessions} == {
        "ann": ["ann/morning"], "bob": ["bob/evening"],
    }  # fmt: skip
    now = client.get(f"{rooms.path}/frames", params=of_bob).json()["items"]
    assert [one["pose"] for one in now] == [one["sent_pose"] for one in moved]
    assert {one["sent_pose"] for one in now} == {None}
    found = set()
    for frame in rooms.held_out:
        answer = rooms.ask(frame)
        assert answer["status"] == "found", answer["reason"]
        pose = answer["location"]["pose"]
        found.add(pose["parent_frame"])
        here = ORIGINS[pose["parent_frame"]] @ np.array(pose["matrix"])
        assert pose_difference(here, frame.pose)[0] < 0.1
    assert found <= ORIGINS.keys()
    graph = client.get(f"{url}/graph", params={"format": "json"}).json()
    assert {one["pose"]["parent_frame"] for one in graph["vertices"]} == ORIGINS.keys()
    assert client.delete(url).status_code == 204
