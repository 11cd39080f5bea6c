"""Point clouds over HTTP: beside depth images in one map, into it, out of it, and refused."""

from __future__ import annotations

import io
import json
import struct
import zipfile
from typing import Any

import numpy as np
import pytest
from PIL import Image

from sceneprint.formats.export import write_ply
from sceneprint.types import DepthFrame, Floats

WAIT = {"Prefer": "wait=200"}
#: Where the second of three clouds says that it was seen from, metres in its own coordinates.
VIEWPOINT = (2.0, -1.0, 0.5)


def points_of(frame: DepthFrame, every: int = 2) -> Floats:
    """What a depth image sees, in its optical frame."""
    depth, k = frame.depth[::every, ::every].astype(float), frame.intrinsics
    y, x = np.nonzero(depth)
    z = depth[y, x]
    return np.stack(
        [(every * x - k.cx) / k.fx * z, (every * y - k.cy) / k.fy * z, z], axis=1
    ).astype(np.float32).astype(float)  # fmt: skip


def pcd(points: Floats, viewpoint: tuple[float, float, float]) -> bytes:
    """In metres from elsewhere: the viewpoint is in the header."""
    place = " ".join(map(str, viewpoint))
    head = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z\nSIZE 8 8 8\n"
        f"TYPE F F F\nCOUNT 1 1 1\nWIDTH {len(points)}\nHEIGHT 1\n"
        f"VIEWPOINT {place} 1 0 0 0\nPOINTS {len(points)}\nDATA binary\n"
    )
    return head.encode() + (points + viewpoint).astype("<f8").tobytes()


def npy(array: np.ndarray) -> bytes:
    out = io.BytesIO()
    np.save(out, array)
    return out.getvalue()


def form(data: bytes, **meta: object) -> dict[str, Any]:
    return {"files": {"frame": ("a", data)}, "data": {"meta": json.dumps(meta)}}


def raw(data: bytes, **params: object) -> dict[str, Any]:
    kind = {"Content-Type": "application/octet-stream"}
    return {"content": data, "params": params, "headers": {**kind, **WAIT}}


@pytest.fixture(scope="module")
def clouds(room_frames) -> list[Floats]:
    return [points_of(frame) for frame in room_frames]


@pytest.fixture(scope="module")
def hall(served, make_map, shots, clouds) -> tuple[str, list[str]]:
    """A depth image, a PLY, and a PCD whose viewpoint is not its origin; three places."""
    path = make_map(served, "clouds")
    pose = {"parent_frame": "room"}
    first = shots[0].form(pose={**pose, "matrix": shots[0].pose})
    second = form(write_ply(clouds[1]), pose={**pose, "matrix": shots[1].pose})
    third = form(pcd(clouds[2], VIEWPOINT))
    ids = []
    for sent in (first, second, third):
        answer = served.client.post(f"{path}/frames", headers=WAIT, **sent)
        assert (answer.status_code, answer.json()["state"]) == (201, "indexed"), answer.text
        ids.append(answer.json()["frame_id"])
    return path, ids


def found(answer: Any, status: str = "found") -> dict[str, Any]:
    assert answer.status_code == 200, answer.text
    told: dict[str, Any] = answer.json()
    assert told["status"] == status, told["reason"]
    return told


def found_by_the_map(answer: Any) -> dict[str, Any]:
    """Return an answer whose only match is weak, and which the map's frames confirm."""
    told = found(answer)
    assert told["location"]["verified_by"] == "map"
    assert told["matches"][0]["validation"]["strength"] == "weak"
    assert told["location"]["strength"] == "weak"
    return told


def test_what_is_told_of_a_cloud(served, hall, clouds):
    path, ids = hall
    image, ply, other = (served.client.get(f"{path}/frames/{one}").json() for one in ids)
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


def test_a_cloud_finds_the_image_of_its_place_and_an_image_the_cloud(served, hall, shots, clouds):
    path, ids = hall
    http = served.client
    by_cloud = found_by_the_map(http.post(f"{path}/queries", **form(write_ply(clouds[0]))))
    first = by_cloud["matches"][0]
    assert (by_cloud["kind"], first["frame_id"]) == ("cloud", ids[0])
    assert first["validation"]["free_space_violations"] is not None
    T = first["transform"]
    assert (T["parent_frame"], T["child_frame"]) == (f"{ids[0]}.optical", "query.sensor")
    assert np.allclose(T["matrix"], np.eye(4), atol=0.02)
    assert np.allclose(by_cloud["location"]["pose"]["matrix"], shots[0].pose, atol=0.02)

    by_image = found(http.post(f"{path}/queries", **shots[1].form()))
    first = by_image["matches"][0]
    assert (by_image["kind"], first["frame_id"]) == ("depth", ids[1])
    T = first["transform"]
    assert (T["parent_frame"], T["child_frame"]) == (f"{ids[1]}.sensor", "query.optical")
    assert np.allclose(T["matrix"], np.eye(4), atol=0.02)
    details = http.get(f"/v1/queries/{by_image['query_id']}/matches/{ids[1]}").json()
    assert details["transform"] == T

    # asked by its own coordinates, half a turn of the sensor and a shift away from those
    turned = clouds[1] * (-1, 1, -1) + (5.0, 0.0, 1.0)
    asked = raw(npy(turned), viewpoint="5,0,1")
    there = found(http.post(f"{path}/localize", **asked))
    expected = np.array(shots[1].pose) @ np.diag([-1.0, 1.0, -1.0, 1.0])
    assert np.allclose(there["pose"]["matrix"], expected, atol=0.02)
    back = np.eye(4)
    back[:3, 3] = (-5.0, 0.0, -1.0)  # T_sensor_cloud
    assert there["base"]["child_frame"] == "cloud"
    assert np.allclose(there["base"]["matrix"], expected @ back, atol=0.1)


def pointcloud2(ros: Any, points: Floats, *, little: bool = True) -> bytes:
    """As a node of ROS 2 would send it, serialised by rosbags: fields in another order."""
    rows = np.zeros(len(points), [("z", "<f4"), ("ring", "<u2"), ("x", "<f4"), ("y", "<f4")])
    for axis, name in enumerate("xyz"):
        rows[name] = points[:, axis]
    writer = ros.messages()
    writer.points(0.0, rows)
    kind = "sensor_msgs/msg/PointCloud2"
    return bytes(writer.types.serialize_cdr(writer.last(), kind, little_endian=little))


def test_a_pointcloud2_is_the_cloud_of_its_points(served, hall, shots, clouds, ros):
    path, ids = hall
    http, kind = served.client, {"Content-Type": "application/x-ros-pointcloud2"}
    sent = {"content": pointcloud2(ros, clouds[1]), "headers": {**kind, **WAIT}}
    meta = {"pose": {"parent_frame": "room", "matrix": shots[1].pose}}
    same = http.post(f"{path}/frames", **sent, params={"meta": json.dumps(meta)})
    assert (same.status_code, same.json()["frame_id"]) == (200, ids[1])
    asked = {"content": pointcloud2(ros, clouds[1], little=False), "headers": kind}
    there = found(http.post(f"{path}/queries", **asked, params={"k": 1}))
    assert (there["kind"], there["matches"][0]["frame_id"]) == ("cloud", ids[1])

    moved = pointcloud2(ros, clouds[0][::2])
    new = http.post(f"{path}/frames", **form(moved, robot="r"))
    assert new.status_code in (201, 202)
    upload = http.get(f"{path}/frames/{new.json()['frame_id']}/upload")
    assert (upload.content, upload.headers["content-type"]) == (moved, kind["Content-Type"])
    assert upload.headers["content-disposition"].endswith('.cdr"')
    assert http.delete(f"{path}/frames/{new.json()['frame_id']}").status_code == 204


def test_two_uploads_are_compared_whatever_they_are(served, shots, clouds):
    files = {"a": ("a", shots[0].png), "b": ("b", write_ply(clouds[0]))}
    metas = {"meta_a": json.dumps({"intrinsics": shots[0].camera}), "meta_b": "{}"}
    said = {**metas, "model": "depth"}
    told = served.client.post("/v1/similarity", files=files, data=said).json()
    assert told["validation"]["status"] == "accepted", told
    assert (told["transform"]["parent_frame"], told["transform"]["child_frame"]) \
        == ("a.optical", "b.sensor")  # fmt: skip


def test_a_cloud_is_who_its_points_are(served, hall, clouds, refused):
    path, ids = hall
    http = served.client

    def post(sent: dict[str, Any]) -> Any:
        return http.post(f"{path}/frames", **sent)

    other = form(pcd(clouds[2], VIEWPOINT))
    assert (post(other).status_code, post(other).json()["frame_id"]) == (200, ids[2])
    repacked = npy(clouds[2] + VIEWPOINT)
    same = form(repacked, viewpoint=dict(zip("xyz", VIEWPOINT, strict=True)))
    assert (post(same).status_code, post(same).json()["frame_id"]) == (200, ids[2])
    robot = form(repacked, robot="r", viewpoint=dict(zip("xyz", VIEWPOINT, strict=True)))
    refused(post(robot), 409, "frame-conflict", "different robot")
    millimetres = raw(npy(1000.0 * (clouds[2] + VIEWPOINT)), viewpoint="2,-1,0.5")
    millimetres["params"]["units_per_metre"] = 1000
    refused(post(millimetres), 409, "frame-conflict", "different units_per_metre")
    elsewhere = post(raw(repacked, viewpoint="2,-1,0.4"))  # another viewpoint, another frame
    assert elsewhere.status_code == 201
    fused = post(raw(repacked, viewpoint="none"))
    assert fused.status_code == 201
    told = http.get(f"{path}/frames/{fused.json()['frame_id']}").json()
    assert (told["viewpoint"], told["base_frame"], told["kind"]) == (None, None, "cloud")
    for one in (elsewhere, fused):
        assert http.delete(f"{path}/frames/{one.json()['frame_id']}").status_code == 204


def test_what_a_cloud_is_made_of(served, hall, clouds):
    path, ids = hall
    http, frame = served.client, f"{path}/frames/{ids[2]}"
    sent = http.get(f"{frame}/upload")
    assert sent.content == pcd(clouds[2], VIEWPOINT)
    assert sent.headers["content-type"] == "application/octet-stream"
    assert f'"{ids[2]}.pcd"' in sent.headers["content-disposition"]
    assert http.get(f"{path}/frames/{ids[1]}/upload").headers["content-type"] == "application/ply"
    for view in ("depth", "normals", "patches"):
        answer = http.get(f"{frame}/preview.png", params={"view": view})
        picture = Image.open(io.BytesIO(answer.content))
        assert picture.width == 320
        assert picture.text["frame"] == f"{ids[2]}.sensor"
        assert len(np.unique(np.asarray(picture.convert("RGB")).reshape(-1, 3), axis=0)) > 20
        assert view != "depth" or picture.text["Description"].startswith("range: yellow ")
    own, base = (
        read_points(http.get(f"{frame}/cloud.ply", params={"frame": one}).content)
        for one in ("optical", "base")
    )
    assert np.allclose(base, own + VIEWPOINT, atol=1e-5)
    near, far = np.percentile(np.linalg.norm(own, axis=1), (5, 95))
    ranges = np.linalg.norm(clouds[2], axis=1)
    assert np.allclose((near, far), np.percentile(ranges, (5, 95)), rtol=0.2)
    assert http.get(f"{frame}/patches").json()["frame"] == f"{ids[2]}.sensor"
    assert len(http.get(f"{frame}/signature").json()["n_patches"]) == 1


def read_points(ply: bytes) -> Floats:
    head, _, body = ply.partition(b"end_header\n")
    assert b"property float nz" in head
    return np.frombuffer(body, "<f4").reshape(-1, 6)[:, :3].astype(float)


def test_a_viewpoint_is_content_and_a_base_can_be_edited(served, hall, refused):
    path, ids = hall
    http, frame = served.client, f"{path}/frames/{ids[2]}"
    refused(http.patch(frame, json={"viewpoint": None}), 422, "invalid-request", "viewpoint")
    matrix = np.diag([-1.0, -1.0, 1.0, 1.0]).tolist()
    told = http.patch(frame, json={"T_base_sensor": {"base_frame": "spot", "matrix": matrix}})
    assert told.json()["base_frame"] == "spot"
    told = http.patch(frame, json={"T_base_sensor": None})
    assert told.json()["base_frame"] == "cloud"
    assert [told.json()["T_base_sensor"]["translation"][x] for x in "xyz"] == [*VIEWPOINT]


@pytest.mark.usefixtures("with_open3d")
def test_a_reconstruction_leaves_clouds_out_and_says_so(served, hall, shots, clouds, until):
    path, ids = hall
    http = served.client
    asked = form(write_ply(clouds[0]))
    answer = found_by_the_map(http.post(f"{path}/queries", **asked))
    begun = http.post(f"/v1/queries/{answer['query_id']}/reconstruction", json={})
    assert begun.status_code == 202, begun.text
    job = f"/v1/reconstructions/{begun.json()['job_id']}"
    until(lambda: http.get(job).json()["state"] in ("succeeded", "failed"))
    told = http.get(job).json()
    assert told["parent_frame"] == "query.sensor"
    assert ids[0] in [one["frame_id"] for one in told["result"]["views"]]
    assert None not in [one["frame_id"] for one in told["result"]["views"]]  # nor the query
    assert told["result"]["query_explained"] > 0.9

    answer = found(http.post(f"{path}/queries", **shots[1].form()))
    begun = http.post(f"/v1/queries/{answer['query_id']}/reconstruction", json={"frames": [ids[1]]})
    job = f"/v1/reconstructions/{begun.json()['job_id']}"
    until(lambda: http.get(job).json()["state"] in ("succeeded", "failed"))
    told = http.get(job).json()
    assert told["state"] == "failed"
    assert told["error"]


@pytest.fixture(scope="module")
def gate(served, make_map) -> str:
    return make_map(served, "gate")


PLY = "ply\nformat binary_little_endian 1.0\nelement vertex {}\n{}end_header\n"
XYZ = "property float x\nproperty float y\nproperty float z\n"
TEN = np.arange(30.0).reshape(10, 3)

#: bytes and parameters -> status, type of the problem, text of its detail
BAD: dict[str, tuple[bytes, dict[str, Any], int, str, str]] = {
    "empty": (b"", {}, 422, "unreadable-frame", "empty"),
    "text": (b"hello", {}, 422, "unreadable-frame", ""),
    "KITTI unsaid": (TEN.astype("<f4").tobytes(), {}, 422, "unreadable-frame", "format=kitti"),
    "a PNG said to be points": (b"\x89PNG\r\n\x1a\n", {"format": "ply"}, 422,
                                "unreadable-cloud", ""),
    "a header that lies": (PLY.format(19_999_999, XYZ).encode() + bytes(120), {}, 422,
                           "unreadable-cloud", ""),
    "a bomb": (b"VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
               b"WIDTH 15000000\nHEIGHT 1\nPOINTS 15000000\nDATA binary_compressed\n"
               + struct.pack("<II", 20, 180_000_000) + bytes(20), {}, 422, "unreadable-cloud", ""),
    "NaN": (npy(np.full((20, 3), np.nan)), {}, 422, "useless-frame", "20 of 20"),
    "far": (npy(TEN * 1e6), {}, 422, "unreadable-cloud", "units_per_metre"),
    "viewpoint": (npy(TEN), {"viewpoint": "1,2"}, 422, "invalid-request", "`viewpoint`"),
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


def test_an_image_has_no_viewpoint_and_needs_a_camera(served, gate, shots, refused):
    for meta, place in (({"viewpoint": None}, "viewpoint"), ({"units_per_metre": 2}, "units_per")):
        answer = served.client.post(f"{gate}/frames", **shots[0].form(**meta))
        problem = refused(answer, 422, "invalid-request", f"a depth image, and `{place}")
        assert problem["errors"][0]["field"].startswith(place)
    answer = served.client.post(f"{gate}/frames", **form(shots[0].png))
    problem = refused(answer, 422, "invalid-request")
    assert [one["field"] for one in problem["errors"]] == ["intrinsics"]
    assert served.client.get(f"{gate}/frames").json()["items"] == []


def test_many_at_once(served, make_map, shots, clouds, until):
    """A batch of both kinds, and an archive of clouds with poses and their units."""
    path, http = make_map(served, "yard-of-clouds"), served.client
    files = [("frame", ("a", shots[4].png)), ("frame", ("b", write_ply(clouds[4])))]
    metas = json.dumps([{"intrinsics": shots[4].camera}, {}])
    batch = http.post(f"{path}/frames/batch", files=files, data={"metas": metas}).json()
    assert [one["status"] for one in batch["items"]] == [202, 202], batch

    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        archive.writestr("run/clouds.json", json.dumps({"units_per_metre": 1000}))
        for i in (0, 1):
            archive.writestr(f"run/{i}.ply", write_ply(1000.0 * clouds[i]))
        archive.writestr("run/0.pose.txt", "\n".join(" ".join(map(str, r)) for r in shots[0].pose))
        archive.writestr("run/2.pcd", b"# .PCD v0.7\nnothing")
    zipped = {"content": packed.getvalue(), "headers": {"Content-Type": "application/zip"}}
    job = http.post(f"{path}/imports", **zipped).headers["location"]
    until(lambda: http.get(job).json()["state"] == "succeeded")
    job_id = job.rpartition("/")[2]
    items = http.get(f"{path}/imports/{job_id}/items").json()["items"]
    assert [(one["name"], one["status"]) for one in items] \
        == [("run/0.ply", 202), ("run/1.ply", 202), ("run/2.pcd", 422)]  # fmt: skip
    until(lambda: http.get(path).json()["frames"].get("indexed") == 4)
    told = http.get(f"{path}/frames/{items[0]['frame_id']}").json()
    assert (told["kind"], told["units_per_metre"], told["session"]) == ("cloud", 1000, "run")
    assert np.allclose(told["pose"]["matrix"], shots[0].pose, atol=1e-6)
    answer = found_by_the_map(http.post(f"{path}/queries", **form(write_ply(clouds[0]))))
    assert answer["matches"][0]["frame_id"] == items[0]["frame_id"]
    assert np.allclose(answer["matches"][0]["transform"]["matrix"], np.eye(4), atol=0.02)
