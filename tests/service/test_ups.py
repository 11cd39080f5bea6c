"""Up over HTTP: with an upload, with a query, of a map; however it is written."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

Z = [0.0, 0.0, 1.0]  #: up in the world of synthetic rooms


def up_of(shot: Any) -> list[float]:
    told: list[float] = (np.array(shot.pose)[:3, :3].T @ Z).tolist()
    return told


def test_up_goes_there_and_back(served, make_map, small_shots):
    path, told = make_map(served, "ups"), {"x": 0.6, "y": -0.8, "z": 0.0}
    sent = served.client.post(f"{path}/frames", **small_shots[0].form(up=told))
    assert sent.status_code == 202, sent.text
    frame = f"{path}/frames/{sent.json()['frame_id']}"
    assert served.client.get(frame).json()["up"] == pytest.approx(told)
    listed = served.client.get(f"{path}/frames").json()["items"]
    assert [one["up"] for one in listed] == [pytest.approx(told)]
    # the same as a list, and beside a frame that is the body
    again = served.client.post(f"{path}/frames", **small_shots[0].form(up=[0.6, -0.8, 0]))
    camera = {name: str(value) for name, value in small_shots[0].camera.items()}
    bare = served.client.post(
        f"{path}/frames", params={**camera, "up": "0.6,-0.8,0"}, content=small_shots[0].png,
        headers={"Content-Type": "image/png"},
    )  # fmt: skip
    assert [(one.status_code, one.json()["frame_id"]) for one in (again, bare)] == [
        (200, sent.json()["frame_id"])
    ] * 2
    edited = served.client.patch(frame, json={"up": [0, 0, 1]})
    assert edited.json()["up"] == {"x": 0, "y": 0, "z": 1}
    assert served.client.patch(frame, json={"up": None}).json()["up"] is None


@pytest.mark.parametrize(
    ("up", "why"),
    [
        ([0, 0, 9.81], "length is 9.81, not 1"),
        ([0, 1], "neither {x, y, z} nor a list"),
        ("0,0,1", "neither {x, y, z} nor a list"),
        ({"x": 0, "y": 0, "z": 1, "w": 0}, "Extra inputs"),
        ({"x": 0, "y": 0}, "Field required"),
    ],
)
def test_what_is_no_direction_is_refused(served, small_shots, refused, up, why):
    path = "/v1/maps/no-direction"
    served.client.post("/v1/maps", json={"name": "no-direction"})
    form = small_shots[0].form(up=up)
    for place in ("frames", "queries", "localize"):
        refused(served.client.post(f"{path}/{place}", **form), 422, "invalid-request", why)
    refused(served.client.patch(path, json={"up": up}), 422, "invalid-request", why)
    refused(
        served.client.post("/v1/maps", json={"name": "other", "up": up}),
        422, "invalid-request", why,
    )  # fmt: skip


def test_a_map_has_an_up(served):
    made = served.client.post("/v1/maps", json={"name": "level", "up": Z})
    assert made.status_code == 201
    assert made.json()["up"] == {"x": 0, "y": 0, "z": 1}
    assert served.client.post("/v1/maps", json={"name": "level", "up": Z}).status_code == 200
    edited = served.client.patch("/v1/maps/level", json={"up": {"x": 0, "y": -1, "z": 0}})
    assert edited.json()["up"] == {"x": 0, "y": -1, "z": 0}
    assert served.client.patch("/v1/maps/level", json={"up": None}).json()["up"] is None
    assert served.client.get("/v1/maps/level").json()["up"] is None


def test_a_query_is_found_with_its_up_and_a_wrong_one_is_told(served, make_map, shots):
    path = make_map(served, "gravity")
    served.client.patch(path, json={"up": Z})
    for i in (0, 1):
        sent = served.client.post(
            f"{path}/frames", **shots[i].form(pose={"matrix": shots[i].pose}, session="s"),
            headers={"Prefer": "wait=60"},
        )  # fmt: skip
        assert sent.json()["state"] == "indexed"
    right = up_of(shots[0])
    c, s = np.cos(np.radians(25)), np.sin(np.radians(25))
    wrong = (np.array([[1, 0, 0], [0, c, -s], [0, s, c]]) @ right).tolist()
    found = served.client.post(f"{path}/queries", **shots[0].form(up=right)).json()
    assert found["status"] == "found"
    assert found["matches"][0]["validation"]["tilt_deg"] < 1.0
    told = served.client.post(f"{path}/localize", **shots[0].form(up=wrong)).json()
    assert (told["status"], told["pose"], told["best"]) == ("not_found", None, None)
    assert "tilted by 25 deg against `up`" in told["reason"]
    # a form may say of a frame what JSON may
    sides = {"a": (shots[0], wrong), "b": (shots[1], up_of(shots[1]))}
    both = {
        f"meta_{name}": json.dumps({"intrinsics": shot.camera, "up": up})
        for name, (shot, up) in sides.items()
    }
    files = {name: ("x.png", shot.png, "image/png") for name, (shot, _) in sides.items()}
    alike = served.client.post("/v1/similarity", files=files, data=both).json()
    assert alike["validation"]["status"] != "accepted"
