"""Tests of archives over HTTP: checks, imports, and dying workers."""

import io
import json
import tarfile
import zipfile
from functools import partial

import pytest


def zipped(shots, folder="run", **more):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr(f"{folder}/intrinsics.json", json.dumps(shots[0].camera))
        for i, shot in enumerate(shots):
            archive.writestr(f"{folder}/{i:03d}.png", shot.png)
        for name, data in more.items():
            archive.writestr(name, data)
    return buffer.getvalue()


def sent(data, kind="application/zip", **params):
    return {"content": data, "params": params, "headers": {"Content-Type": kind}}


@pytest.fixture(scope="module")
def yard(served, make_map):
    return make_map(served, "yard")


def test_what_is_wrong_is_said_at_the_door(served, yard, small_shots, refused):
    http, data = served.client, zipped(small_shots[:1])

    def post(**said):
        return http.post(f"{yard}/imports", **said)

    refused(post(**sent(data, "application/json")), 415, "unsupported-type", "application/zip")
    refused(post(**sent(small_shots[0].png)), 422, "unreadable-archive", "not a supported archive")
    refused(post(**sent(b"")), 422, "unreadable-archive", "The archive is empty")
    refused(post(**sent(data, robott="x")), 422, "invalid-request", "robott")
    refused(post(**sent(data, every="0")), 422, "invalid-request", "every")
    refused(post(**sent(data, name="../x")), 422, "invalid-request", "name")
    refused(post(**sent(data, base="1,2")), 422, "invalid-request", "2 numbers")
    refused(post(**sent(data, options="{")), 400, "malformed-body")
    refused(post(**sent(data, options="{}", robot="r")), 422, "invalid-request", "`options`")
    refused(http.post("/v1/maps/none/imports", **sent(data)), 404, "unknown-map")
    assert [path for path in (served.folder / "blobs").iterdir() if path.is_file()] == []


def test_an_archive_has_a_limit_of_its_own(open_house, tmp_path, small_shots, refused):
    limits = {"max_upload_bytes": 20_000, "max_import_bytes": 60_000}
    with open_house(tmp_path, None, {"boss": {"*": "admin"}}, **limits) as house:
        house.ask("boss", "POST", "/v1/maps", json={"name": "yard"})
        post, small = partial(house.ask, "boss", "POST"), zipped(small_shots[:3])
        imports = "/v1/maps/yard/imports"
        assert 20_000 < len(small) < 60_000
        assert post(imports, **sent(small)).status_code == 202
        large = small + bytes(60_000)
        refused(post(imports, **sent(large)), 413, "too-large", "60000")

        async def chunks():  # their length is not sent
            yield large[:30_000]
            yield large[30_000:]

        refused(post(imports, **{**sent(large), "content": chunks()}), 413, "too-large", "60000")
        refused(post("/v1/maps/yard/frames", **sent(small)), 413, "too-large", "20000")
        packed = io.BytesIO()
        with tarfile.open(fileobj=packed, mode="w:xz") as archive:
            info = tarfile.TarInfo("a.npy")
            info.size = 400_000
            archive.addfile(info, io.BytesIO(bytes(info.size)))
        bomb = sent(packed.getvalue(), "application/x-xz")
        refused(post(imports, **bomb), 422, "unreadable-archive", "240000")


def test_recordings_that_are_none_are_refused(served, yard, refused):
    post, kind = partial(served.client.post, f"{yard}/imports"), "application/octet-stream"
    named = {"as": "recording", "name": "run.bag"}
    refused(post(**sent(b"x" * 600, kind, **named)), 422, "unreadable-archive", "run.bag")
    refused(post(**sent(b"x", kind, topic="/b")), 422, "invalid-request", "topic")
