"""Archives over HTTP: at the door, while they are imported, and when workers die over them."""

from __future__ import annotations

import io
import json
import tarfile
import zipfile
from typing import Any

import pytest


def zipped(shots: list[Any], folder: str = "run", **more: bytes) -> bytes:
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w") as archive:
        archive.writestr(f"{folder}/intrinsics.json", json.dumps(shots[0].camera))
        for i, one in enumerate(shots):
            archive.writestr(f"{folder}/{i:03d}.png", one.png)
        for name, data in more.items():
            archive.writestr(name, data)
    return made.getvalue()


def sent(data: bytes, kind: str = "application/zip", **params: str) -> dict[str, Any]:
    return {"content": data, "params": params, "headers": {"Content-Type": kind}}


@pytest.fixture(scope="module")
def yard(served, make_map) -> str:
    return make_map(served, "yard")


def test_an_archive_from_the_door_to_its_frames(served, yard, small_shots, until, refused) -> None:
    http = served.client
    odd = {"../out.png": b"x", "run/bad.png": b"no image"}
    data = zipped(small_shots[20:24], **odd)
    said = sent(data, robot="r1", tags="a,b", base="0,0,1,0,0,0,1", base_frame="base")
    said["headers"]["Idempotency-Key"] = "import"
    begun = http.post(f"{yard}/imports", **said)
    assert begun.status_code == 202, begun.text
    path = begun.headers["location"]
    assert path == f"/v1/jobs/{begun.json()['job_id']}"
    again = http.post(f"{yard}/imports", **said)
    assert again.headers["idempotent-replayed"] == "true"
    assert again.json()["job_id"] == begun.json()["job_id"]
    other = sent(data, robot="r2")
    other["headers"]["Idempotency-Key"] = "import"
    refused(http.post(f"{yard}/imports", **other), 422, "idempotency-conflict")
    until(lambda: http.get(path).json()["state"] == "succeeded")
    told = http.get(path).json()
    assert (told["progress"]["done"], told["progress"]["total"]) == (6, 6)
    assert told["progress"]["phase"] is None
    summary = told["result"].pop("summary")
    assert summary["text"].startswith(
        "poses of 0 of 5 frames; 4 without: no NAME.pose.txt is beside them, nor NAME.txt in a "
        "folder pose; 1 without: refused; depth "
    )
    assert told["result"] == {
        "sequences": 1, "received": 4, "there": 0, "refused": 2, "ignored": 0,
    }  # fmt: skip
    items_of = f"{yard}/imports/{told['job_id']}/items"
    first = http.get(items_of, params={"limit": 4}).json()
    rest = http.get(items_of, params={"cursor": first["next_cursor"]}).json()
    assert rest["next_cursor"] is None
    items = first["items"] + rest["items"]
    assert [(one["name"], one["status"]) for one in items] == [
        ("../out.png", 422), *((f"run/{i:03d}.png", 202) for i in range(4)), ("run/bad.png", 422),
    ]  # fmt: skip
    frame = http.get(f"{yard}/frames/{items[1]['frame_id']}").json()
    assert (frame["robot"], frame["session"], frame["tags"]) == ("r1", "run", ["a", "b"])
    assert (frame["base_frame"], frame["T_base_sensor"]["translation"]["z"]) == ("base", 1)
    # the archive is gone, the frames' own blobs are there
    assert not any(
        p.read_bytes() == data for p in (served.folder / "blobs").rglob("*") if p.is_file()
    )
    jobs = http.get("/v1/jobs", params={"kind": "import", "map": "yard"}).json()["items"]
    assert [one["job_id"] for one in jobs] == [begun.json()["job_id"]]
    refused(http.get(f"{yard}/imports/{frame['job_id']}/items"), 404, "unknown-job")
    refused(http.get(f"{yard}/imports/{'0' * 32}/items"), 404, "unknown-job")


def test_what_is_wrong_is_said_at_the_door(served, yard, small_shots, refused) -> None:
    http, data = served.client, zipped(small_shots[:1])

    def post(**said: Any) -> Any:
        return http.post(f"{yard}/imports", **said)

    refused(post(**sent(data, "application/json")), 415, "unsupported-type", "application/zip")
    refused(post(**sent(small_shots[0].png)), 422, "unreadable-archive", "no archive")
    refused(post(**sent(b"")), 422, "unreadable-archive", "The archive is empty")
    refused(post(**sent(data, robott="x")), 422, "invalid-request", "robott")
    refused(post(**sent(data, every="0")), 422, "invalid-request", "every")
    refused(post(**sent(data, name="../x")), 422, "invalid-request", "name")
    refused(post(**sent(data, base="1,2")), 422, "invalid-request", "2 numbers")
    refused(post(**sent(data, options="{")), 400, "malformed-body")
    refused(post(**sent(data, options="{}", robot="r")), 422, "invalid-request", "`options`")
    refused(http.post("/v1/maps/none/imports", **sent(data)), 404, "unknown-map")
    assert [path for path in (served.folder / "blobs").iterdir() if path.is_file()] == []


def test_an_archive_has_a_limit_of_its_own(begin, make_map, small_shots, refused) -> None:
    server = begin(max_upload_bytes=20_000, max_import_bytes=60_000, workers=0)
    path = make_map(server, "yard")
    small = zipped(small_shots[:3])
    assert 20_000 < len(small) < 60_000
    assert server.client.post(f"{path}/imports", **sent(small)).status_code == 202
    large = small + bytes(60_000)
    refused(server.client.post(f"{path}/imports", **sent(large)), 413, "too-large", "60000")
    chunks = sent(large)
    chunks["content"] = iter([large[:30_000], large[30_000:]])  # not said beforehand
    refused(server.client.post(f"{path}/imports", **chunks), 413, "too-large", "60000")
    refused(server.client.post(f"{path}/frames", **sent(small)), 413, "too-large", "20000")
    made = io.BytesIO()
    with tarfile.open(fileobj=made, mode="w:xz") as archive:
        info = tarfile.TarInfo("a.npy")
        info.size = 400_000
        archive.addfile(info, io.BytesIO(bytes(info.size)))
    bomb = sent(made.getvalue(), "application/x-xz")
    refused(server.client.post(f"{path}/imports", **bomb), 422, "unreadable-archive", "240000")


#: A camera of few pixels at one height: few views, which are rendered and signed quickly.
_SMALL = {"camera": "73,73,39.5,29.5,80,60", "heights": "1.2"}


def test_a_map_that_is_one_file_becomes_views(
    served, make_map, room_mesh, small_shots, until, refused
) -> None:
    http, path = served.client, make_map(served, "room")
    options = {"as": "map", "name": "room.ply", "up": "z", "offset": "1,0,-2", **_SMALL}

    def post(data: bytes = room_mesh, **more: str) -> Any:
        return http.post(f"{path}/imports", **sent(data, "application/octet-stream", **more))

    refused(
        post(**options | {"up": "0,0,1"}),
        422,
        "invalid-request",
        "up.axis: Input should be 'x', '-x'",
    )
    refused(post(**options | {"camera": "1,2"}), 422, "invalid-request", "6 numbers")
    refused(post(**options | {"offset": "1,2"}), 422, "invalid-request", "3 numbers")
    refused(post(**options | {"every": "2"}), 422, "invalid-request", "every")
    refused(post(heights="1"), 422, "invalid-request", "`as` = `map`")
    refused(post(zipped(small_shots[:1]), **options), 422, "invalid-request", "archive")
    refused(post(b"no map", **options | {"name": "room"}), 422, "unreadable-cloud", "PLY")
    begun = post(**options)
    assert begun.status_code == 202, begun.text
    where = begun.headers["location"]
    assert where == f"/v1/jobs/{begun.json()['job_id']}"
    until(lambda: http.get(where).json()["state"] not in ("queued", "running"))
    told = http.get(where).json()
    assert (told["kind"], told["state"]) == ("import-map", "succeeded"), told
    result, progress = told["result"], told["progress"]
    assert progress["phase"] == "test"
    assert progress["views"] == progress["rendered"] == progress["signed"] > 0
    assert (result["parent_frame"], result["session"]) == ("room", "room")
    assert result["offset"] == {"x": 1, "y": 0, "z": -2}
    assert result["tested"] == progress["tested"] > 0
    assert result["wrong"] == 0
    frames = http.get(f"{path}/frames", params={"tag": "virtual", "limit": 1}).json()["items"]
    assert frames[0]["pose"]["parent_frame"] == "room"
    assert frames[0]["intrinsics"]["width"] == 80
    items = http.get(f"{path}/imports/{told['job_id']}/items", params={"limit": 1}).json()
    assert items["items"][0]["name"] == "room.ply/00000"
