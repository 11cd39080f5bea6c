"""Tests of uploads under an id, as bodies, with idempotency keys, priorities and in batches."""

import json

import numpy as np
import pytest

from sceneprint.formats.depth_file import encode_npy

BASE = {"translation": {"x": 0.1, "y": 0.0, "z": 0.4}, "rotation": {"x": 0, "y": 0, "z": 0, "w": 1}}


@pytest.fixture(scope="module")
def hall(served, make_map):
    return make_map(served, "put-hall")


def query(shot, **more):
    """The same shot as the body, and what is known of it as parameters."""
    camera = {name: shot.camera[name] for name in ("fx", "fy", "cx", "cy")}
    return {
        "content": shot.png,
        "params": {**camera, **more},
        "headers": {"Content-Type": "image/png"},
    }


def test_depth_that_does_not_look_like_it_is_taken_when_trusted(
    served, hall, small_shots, refused, until
):
    """It is signed from the store as well, where nobody says it again."""
    http, shot = served.client, small_shots[0]
    noise = (2000 * np.random.default_rng(3).gamma(60, 1 / 60, (120, 160))).astype(np.uint16)
    form = {"files": {"frame": ("frame.npy", encode_npy(noise))}}
    problem = refused(http.post(f"{hall}/frames", **shot.form() | form), 422, "unreadable-frame")
    assert "--trust-depth, or `trust_depth` in the metadata" in problem["detail"]
    added = http.post(f"{hall}/frames", **shot.form(trust_depth=True) | form).json()
    near, median, far = np.percentile(noise / 1000, (5, 50, 95))
    expected = {"near": near, "median": median, "far": far, "count": noise.size, "valid": 1.0}
    assert added["samples"] == pytest.approx(expected, abs=1e-4)
    path = f"{hall}/frames/{added['frame_id']}"
    until(lambda: http.get(path).json()["state"] not in ("received", "signing"))
    frame = http.get(path).json()
    assert (frame["trust_depth"], frame["samples"]) == (True, added["samples"])
    assert frame["state"] != "failed"
    assert "no depth" not in (frame["reason"] or "")


@pytest.mark.parametrize("name", [".hidden", "-x", "_x", "a b", "ä", "x" * 65, "a%0ab"])
def test_an_id_that_is_none_is_refused(served, hall, small_shots, refused, name):
    answer = served.client.put(f"{hall}/frames/{name}", **small_shots[0].form())
    refused(answer, 422, "invalid-request", "frame id")


def test_a_body_that_is_the_frame_is_taken_as_the_form_is(served, hall, small_shots):
    http, shot = served.client, small_shots[2]
    said = {
        "session": "raw", "robot": "r2", "tags": "a,b", "captured_at": "2026-01-02T03:04:05Z",
        "name": "depth/2.png", "sequence": "2", "pose": "1,2,3,0,0,0,1",
        "base": "0.1,0,0.4,0,0,0,1", "parent_frame": "hall", "up": "0.6,-0.8,0",
    }  # fmt: skip
    raw = http.put(f"{hall}/frames/raw", **query(shot, **said))
    assert raw.status_code == 202
    form = shot.form(
        session="raw", robot="r2", tags=["a", "b"], captured_at="2026-01-02T03:04:05Z",
        pose={"translation": {"x": 1, "y": 2, "z": 3}, "rotation": BASE["rotation"],
              "parent_frame": "hall"}, T_base_sensor=BASE, up=[0.6, -0.8, 0],
        name="depth/2.png", sequence=2,
    )  # fmt: skip
    again = http.put(f"{hall}/frames/raw", **form)
    assert (again.status_code, again.json()["frame_id"]) == (200, "raw")
    record = http.get(f"{hall}/frames/raw").json()
    assert (record["base_frame"], record["T_base_sensor"]["translation"]["z"]) == ("base_link", 0.4)
    assert record["T_base_sensor"]["child_frame"] == "raw.optical"
    assert record["pose"]["matrix"][0][3] == 1
    assert record["up"] == pytest.approx({"x": 0.6, "y": -0.8, "z": 0.0})


@pytest.mark.parametrize(
    ("params", "reason"),
    [
        ({"fxx": "1"}, "fxx"),
        ({"fx": "1", "fy": "1", "cx": "1"}, "cy"),
        ({"meta": "{}", "fx": "1"}, "Put all fields into `meta`"),
        ({"fx": "40", "fy": "40", "cx": "1", "cy": "1", "base": "0,0,0,0,0,0,9"}, "T_base_sensor"),
    ],
)
def test_what_is_wrong_in_the_query_string_is_said(served, hall, small_shots, params, reason):
    answer = served.client.post(
        f"{hall}/frames", content=small_shots[0].png, params=params,
        headers={"Content-Type": "image/png"},
    )  # fmt: skip
    assert answer.status_code == 422, answer.text
    assert reason in answer.text


def test_other_types_and_no_json_are_refused(served, hall, small_shots, refused):
    http = served.client
    jpeg = http.post(f"{hall}/frames", content=b"x", headers={"Content-Type": "image/jpeg"})
    refused(jpeg, 415, "unsupported-type", "image/png")
    twice = http.post(
        f"{hall}/frames", content=small_shots[0].png, params=[("fx", "1"), ("fx", "2")],
        headers={"Content-Type": "image/png"},
    )  # fmt: skip
    refused(twice, 422, "invalid-request", "twice")
    no_json = http.post(
        f"{hall}/frames", content=b"x", params={"meta": "{"}, headers={"Content-Type": "image/png"}
    )
    refused(no_json, 400, "malformed-body", "not JSON")


def test_a_key_makes_an_upload_take_effect_once(served, hall, small_shots, refused):
    http, shot, key = served.client, small_shots[5], {"Idempotency-Key": "upload 1"}
    first = http.post(f"{hall}/frames", **shot.form(session="k"), headers=key)
    assert "idempotent-replayed" not in first.headers
    again = http.post(
        f"{hall}/frames", **shot.form(session="k"), headers={**key, "Prefer": "wait=200"}
    )
    assert again.headers["idempotent-replayed"] == "true"
    assert again.json() == {**first.json(), "state": "indexed"}
    other = http.post(f"{hall}/frames", **shot.form(session="l"), headers=key)
    refused(other, 422, "idempotency-conflict", "another request")
    # deleted meanwhile: still the same, as it is now, where without the key it would be made anew
    http.delete(f"{hall}/frames/{first.json()['frame_id']}")
    gone = http.post(f"{hall}/frames", **shot.form(session="k"), headers=key).json()
    assert (gone["frame_id"], gone["state"]) == (first.json()["frame_id"], "deleted")
    # what was there already is remembered, too
    there = {"Idempotency-Key": "upload 2"}
    assert http.put(f"{hall}/frames/there", **shot.form(session="k")).status_code == 202
    for expected in (None, "true"):
        answer = http.post(f"{hall}/frames", **shot.form(session="k"), headers=there)
        assert answer.status_code == 200
        assert answer.headers.get("idempotent-replayed") == expected
    bad = http.post(f"{hall}/frames", **shot.form(), headers={"Idempotency-Key": "x" * 256})
    refused(bad, 422, "invalid-request", "Idempotency-Key")


def batch(shots, metas, **fields):
    files = [("frame", ("f.png", shot if isinstance(shot, bytes) else shot.png)) for shot in shots]
    return {"files": files, "data": {"metas": json.dumps(metas), **fields}}


def test_a_batch_that_is_none_is_refused_whole(served, hall, small_shots, refused):
    http, shot, meta = served.client, small_shots[12], {"intrinsics": small_shots[12].camera}

    def post(**sent):
        return http.post(f"{hall}/frames/batch", **sent)

    refused(post(**batch([shot], [meta, meta])), 422, "invalid-request", "a list of 2")
    refused(post(**batch([shot], 5)), 422, "invalid-request", "neither object nor list")
    refused(post(**batch([shot], meta, robot="r")), 422, "invalid-request", "'robot'")
    refused(post(**shot.form()), 422, "invalid-request", "'meta'")
    refused(post(data={"metas": "{}"}, files={"x": b""}), 422, "invalid-request", "'x'")
    refused(post(**batch([shot] * 65, meta)), 400, "malformed-body")
    refused(post(content=b"{}", headers={"Content-Type": "application/json"}), 415,
            "unsupported-type")  # fmt: skip
    frames = http.get(f"{hall}/frames", params={"limit": 200}).json()["items"]
    assert not any(frame["bytes"] == len(shot.png) for frame in frames)


@pytest.mark.parametrize("text", ["11", "1.0", "high", "", "٣"])
def test_a_priority_is_a_small_whole_number(served, hall, small_shots, refused, text):
    form = small_shots[30].form()
    form["data"] |= {"priority": text}
    problem = refused(served.client.post(f"{hall}/frames", **form), 422, "invalid-request")
    assert [error["field"] for error in problem["errors"]] == ["priority"]
    query = served.client.post(f"{hall}/queries", **form)
    refused(query, 422, "invalid-request", "an unknown part 'priority'")
