"""Tests of point clouds over HTTP: upload, query, download, and errors."""

import json

import numpy as np
import pytest

from sceneprint.formats.depth_file import encode_npy
from sceneprint.formats.export import write_ply

WAIT = {"Prefer": "wait=200"}
#: Where the second of three clouds says that it was seen from, metres in its own coordinates.
VIEWPOINT = (2.0, -1.0, 0.5)


def points_of(frame, every=4):
    """What a depth image sees, in its optical frame."""
    depth, k = frame.depth[::every, ::every].astype(float), frame.intrinsics
    y, x = np.nonzero(depth)
    z = depth[y, x]
    return np.stack(
        [(every * x - k.cx) / k.fx * z, (every * y - k.cy) / k.fy * z, z], axis=1
    ).astype(np.float32).astype(float)  # fmt: skip


def pcd(points, viewpoint):
    """In metres from elsewhere: the viewpoint is in the header."""
    place = " ".join(map(str, viewpoint))
    head = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z\nSIZE 8 8 8\n"
        f"TYPE F F F\nCOUNT 1 1 1\nWIDTH {len(points)}\nHEIGHT 1\n"
        f"VIEWPOINT {place} 1 0 0 0\nPOINTS {len(points)}\nDATA binary\n"
    )
    return head.encode() + (points + viewpoint).astype("<f8").tobytes()


def form(data, **meta):
    return {"files": {"frame": ("a", data)}, "data": {"meta": json.dumps(meta)}}


def raw(data, **params):
    kind = {"Content-Type": "application/octet-stream"}
    return {"content": data, "params": params, "headers": {**kind, **WAIT}}


@pytest.fixture(scope="module")
def clouds(room_frames):
    return [points_of(frame) for frame in room_frames]


@pytest.fixture(scope="module")
def hall(served, make_map, shots, small_shots, clouds):
    """A depth image, a PLY, and a PCD whose viewpoint is not its origin; three places."""
    path = make_map(served, "clouds")
    pose = {"parent_frame": "room"}
    first = small_shots[0].form(pose={**pose, "matrix": shots[0].pose})
    second = form(write_ply(clouds[1]), pose={**pose, "matrix": shots[1].pose})
    third = form(pcd(clouds[2], VIEWPOINT))
    ids = []
    for sent in (first, second, third):
        answer = served.client.post(f"{path}/frames", headers=WAIT, **sent)
        assert (answer.status_code, answer.json()["state"]) == (201, "indexed"), answer.text
        ids.append(answer.json()["frame_id"])
    return path, ids


def test_what_is_told_of_a_cloud(served, hall, clouds):
    path, ids = hall
    image, ply, other = (served.client.get(f"{path}/frames/{frame_id}").json() for frame_id in ids)
    assert (image["kind"], image["points"], image["viewpoint"]) == ("depth", None, None)
    assert (ply["kind"], ply["intrinsics"], ply["depth_scale"]) == ("cloud", None, None)
    assert (ply["points"], ply["note"], ply["units_per_metre"]) == (len(clouds[1]), None, 1.0)
    assert ply["viewpoint"] == {"x": 0.0, "y": 0.0, "z": 0.0}
    assert ply["base_frame"] is None
    assert ply["pose"]["child_frame"] == f"{ids[1]}.sensor"
    assert other["viewpoint"] == dict(zip("xyz", VIEWPOINT, strict=True))
    # the coordinates as they came take the place of the robot's base
    assert (other["base_frame"], other["T_base_sensor"]["translation"]) \
        == ("cloud", other["viewpoint"])  # fmt: skip


def test_a_cloud_is_who_its_points_are(served, hall, clouds, refused):
    path, ids = hall
    http = served.client

    def post(sent):
        return http.post(f"{path}/frames", **sent)

    other = form(pcd(clouds[2], VIEWPOINT))
    assert (post(other).status_code, post(other).json()["frame_id"]) == (200, ids[2])
    repacked = encode_npy(clouds[2] + VIEWPOINT)
    same = form(repacked, viewpoint=dict(zip("xyz", VIEWPOINT, strict=True)))
    assert (post(same).status_code, post(same).json()["frame_id"]) == (200, ids[2])
    robot = form(repacked, robot="r", viewpoint=dict(zip("xyz", VIEWPOINT, strict=True)))
    refused(post(robot), 409, "frame-conflict", "different robot")
    millimetres = raw(encode_npy(1000.0 * (clouds[2] + VIEWPOINT)), viewpoint="2,-1,0.5")
    millimetres["params"]["units_per_metre"] = 1000
    refused(post(millimetres), 409, "frame-conflict", "different units_per_metre")
    elsewhere = post(raw(repacked, viewpoint="2,-1,0.4"))  # another viewpoint, another frame
    assert elsewhere.status_code == 201
    fused = post(raw(repacked, viewpoint="none"))
    assert fused.status_code == 201
    record = http.get(f"{path}/frames/{fused.json()['frame_id']}").json()
    assert (record["viewpoint"], record["base_frame"], record["kind"]) == (None, None, "cloud")
    for one in (elsewhere, fused):
        assert http.delete(f"{path}/frames/{one.json()['frame_id']}").status_code == 204


@pytest.fixture(scope="module")
def gate(served, make_map):
    return make_map(served, "gate")


TEN = np.arange(30.0).reshape(10, 3)

#: bytes and parameters -> status, type of the problem, text of its detail
BAD = {
    "empty": (b"", {}, 422, "unreadable-frame", "empty"),
    "KITTI unsaid": (TEN.astype("<f4").tobytes(), {}, 422, "unreadable-frame", "format=kitti"),
    "a PNG said to be points": (b"\x89PNG\r\n\x1a\n", {"format": "ply"}, 422,
                                "unreadable-cloud", ""),
    "NaN": (encode_npy(np.full((20, 3), np.nan)), {}, 422, "useless-frame",
            "0 of 20 points are valid"),
    "far": (encode_npy(TEN * 1e6), {}, 422, "unreadable-cloud", "units_per_metre"),
    "viewpoint": (encode_npy(TEN), {"viewpoint": "1,2"}, 422, "invalid-request", "`viewpoint`"),
    "a camera": (write_ply(TEN), {"fx": 1, "fy": 1, "cx": 0, "cy": 0, "width": 5, "height": 2},
                 422, "invalid-request", "`intrinsics`"),
    "along rays": (write_ply(TEN), {"depth_along_ray": True}, 422, "invalid-request",
                   "`depth_along_ray`"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_a_cloud_that_is_none_is_refused_and_nothing_is_stored(served, gate, refused, name):
    data, params, status, kind, text = BAD[name]
    for route in ("frames", "queries"):
        refused(served.client.post(f"{gate}/{route}", **raw(data, **params)), status, kind, text)
    assert served.client.get(f"{gate}/frames").json()["items"] == []


def test_an_image_has_no_viewpoint_and_needs_a_camera(served, gate, small_shots, refused):
    for meta, place in (({"viewpoint": None}, "viewpoint"), ({"units_per_metre": 2}, "units_per")):
        answer = served.client.post(f"{gate}/frames", **small_shots[0].form(**meta))
        problem = refused(answer, 422, "invalid-request", f"a depth image, and `{place}")
        assert problem["errors"][0]["field"].startswith(place)
    answer = served.client.post(f"{gate}/frames", **form(small_shots[0].png))
    problem = refused(answer, 422, "invalid-request")
    assert [error["field"] for error in problem["errors"]] == ["intrinsics"]
    assert served.client.get(f"{gate}/frames").json()["items"] == []
