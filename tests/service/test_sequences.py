"""Tests of queries with several frames over HTTP."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest


@pytest.fixture(scope="module")
def path(served, make_map, shots) -> str:
    """A map with the first two views of a room, by its path."""
    home = make_map(served, "sequences")
    for shot in shots[:2]:
        meta = {"session": "morning", "robot": "r1", "pose": {"matrix": shot.pose}}
        sent = served.client.post(
            f"{home}/frames", **shot.form(**meta), headers={"Prefer": "wait=200"}
        )
        assert sent.json()["state"] == "indexed"
    return str(home)


def ask(served: Any, path: str, shots: Any, poses: Any, **more: str) -> Any:
    files, metas = [], []
    for shot, pose in zip(shots, poses, strict=True):
        form = shot.form() if pose is None else shot.form(pose=pose)
        files.append(("frame", form["files"]["frame"]))
        metas.append(json.loads(form["data"]["meta"]))
    data = {"metas": json.dumps(metas), **more}
    return served.client.post(f"{path}/localize/sequence", files=files, data=data)


def odometry(T: Any) -> dict[str, Any]:
    return {"matrix": np.array(T).tolist(), "parent_frame": "odom"}


@pytest.mark.parametrize(
    ("count", "poses", "more", "told"),
    [
        (1, True, {}, "The sequence has 1 frames"),
        (2, False, {}, "frame 0 has no pose"),
        (2, True, {"k": "0"}, "greater than or equal to 1"),
        (2, True, {"colour": "red"}, "colour"),
        (2, True, {"stages": "retrieve"}, "stages"),
    ],
)
def test_what_is_no_sequence_is_refused(served, path, shots, count, poses, more, told):
    asked = shots[:count]
    given = [odometry(shot.pose) if poses else None for shot in asked]
    answer = ask(served, path, asked, given, **more)
    assert answer.status_code == 422, answer.text
    assert told in answer.text
    assert answer.headers["content-type"] == "application/problem+json"
