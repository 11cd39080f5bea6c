"""Tests of two robots' sessions in separate parent frames that are joined to one map."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import httpx
import numpy as np
import pytest

from sceneprint.geometry.rigid import inverse, pose_difference
from sceneprint.types import DepthFrame
from tests.service.conftest import Shot, until

pytestmark = [pytest.mark.thorough, pytest.mark.timeout(600)]


def _origin(seed):
    rng = np.random.default_rng(seed)
    u, _, vt = np.linalg.svd(rng.normal(size=(3, 3)))
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt, rng.normal(0, 4, 3)
    return T


#: T_room_parent of each robot's parent frame.
ORIGINS = {"ann/morning": _origin(1), "bob/evening": _origin(2)}


@dataclass(frozen=True)
class Rooms:
    """A joined map of two sessions, and frames of the same path that are in neither."""

    client: httpx.Client
    path: str
    held_out: list[DepthFrame]
    shoot: Callable[..., Shot]
    job: dict[str, Any]

    def ask(self, frame, **query):
        """Return the answer to a query."""
        form = self.shoot(frame.depth, frame.intrinsics).form()
        form["data"] |= {name: json.dumps(value) for name, value in query.items()}
        answer = self.client.post(f"{self.path}/queries", **form)
        assert answer.status_code == 200, answer.text
        return answer.json()


@pytest.fixture(scope="module")
def rooms(served, make_map, room_views, shoot):
    """A room of which ann took every third frame, and bob the next ones, after each other."""
    path, client = make_map(served, "joined"), served.client
    room = room_views(21, 0, 960, along_path=True, step=8)
    runs = {"ann/morning": room.frames[::3], "bob/evening": room.frames[1::3]}
    for parent, frames in runs.items():
        robot, session = parent.split("/")
        for i, frame in enumerate(frames):
            pose = {"matrix": (inverse(ORIGINS[parent]) @ frame.pose).tolist()}
            form = shoot(frame.depth, frame.intrinsics).form(
                robot=robot, session=session, pose=pose,
                captured_at=f"2026-01-01T00:{i // 60:02}:{i % 60:02}Z",
            )  # fmt: skip
            assert client.post(f"{path}/frames", **form).status_code == 202
    total = sum(map(len, runs.values()))
    until(lambda: client.get(path).json()["frames"].get("indexed") == total)
    begun = client.post(f"{path}/associations", json={"sessions": ["evening", "morning"]})
    assert begun.status_code == 202, begun.text

    def succeeded():
        job = client.get(begun.headers["location"]).json()
        assert job["state"] not in ("failed", "dead", "cancelled"), job
        return job if job["state"] == "succeeded" else None

    return Rooms(client, path, list(room.frames[2::3]), shoot, until(succeeded))


def test_every_answer_is_in_the_parent_frame_of_the_first_session(rooms):
    (join,) = rooms.job["result"]["joins"]
    assert (join["strength"], join["root"]) == ("strong", "ann/morning")
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
    client, url = rooms.client, f"{rooms.path}/associations/{rooms.job['job_id']}"
    of_bob = {"robot": "bob", "limit": 200}
    moved = client.get(f"{rooms.path}/frames", params=of_bob).json()["items"]
    refused = client.delete(url)
    assert (refused.status_code, refused.json()["type"].rpartition("/")[2]) == (409, "join-stands")
    for _ in range(2):  # the second time nothing is left to do
        undone = client.delete(f"{url}/join")
        assert undone.status_code == 200, undone.text
        (join,) = undone.json()["result"]["joins"]
        assert join == rooms.job["result"]["joins"][0] | {"root": None, "undone": True}
    assert client.get(url).json() == undone.json()
    sessions = client.get(f"{rooms.path}/sessions").json()["items"]
    assert {session["robot"]: session["parent_frames"] for session in sessions} == {
        "ann": ["ann/morning"], "bob": ["bob/evening"],
    }  # fmt: skip
    now = client.get(f"{rooms.path}/frames", params=of_bob).json()["items"]
    assert [one["pose"] for one in now] == [one["sent_pose"] for one in moved]
    assert {one["sent_pose"] for one in now} == {None}
    assert client.delete(url).status_code == 204
