"""Up over HTTP: with an upload, with a query, of a map; however it is written."""

from __future__ import annotations

import pytest


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
