"""Tests of downloads and edits of frames over HTTP: headers and errors."""

import base64
import io

import numpy as np
import pytest
from PIL import Image


@pytest.fixture(scope="module")
def shown(served, make_map, small_shots):
    """Path of a map with three indexed frames of one session, and their ids."""
    path = make_map(served, "shown")
    ids = []
    for i, shot in enumerate(small_shots[:3]):
        meta = {"robot": "r2", "session": "monday", "captured_at": f"2026-11-16T09:30:0{i}Z",
                "tags": ["door"] if i else [],
                "pose": {"parent_frame": "hall", "translation": {"x": i, "y": 0, "z": 1},
                         "rotation": {"x": 0, "y": 0, "z": 0, "w": 1}}}  # fmt: skip
        ids.append(served.index(path, shot, **meta))
    return path, ids


FILES = {
    "cloud.ply": "application/ply",
    "cloud.ply?frame=parent": "application/ply",
    "preview.png": "image/png",
    "preview.png?view=normals&width=64": "image/png",
    "preview.png?view=patches": "image/png",
    "patches": "application/json",
    "signature": "application/json",
    "upload": "image/png",
}


def test_what_a_caller_has_is_not_sent_again(served, shown):
    path, ids = shown
    tags = set()
    for name, kind in FILES.items():
        url = f"{path}/frames/{ids[0]}/{name}"
        first = served.client.get(url)
        assert (first.status_code, first.headers["content-type"]) == (200, kind), first.text
        assert first.headers["cache-control"] == "private, no-cache"
        tag = first.headers["etag"]
        tags.add(tag)
        for known in (tag, f'"other", W/{tag}', "*"):
            again = served.client.get(url, headers={"If-None-Match": known})
            assert (again.status_code, again.content) == (304, b"")
            assert again.headers["etag"] == tag
        other = served.client.get(url, headers={"If-None-Match": '"other"'})
        assert (other.status_code, other.content) == (200, first.content)
    assert len(tags) == len(FILES)


def test_a_signature_in_the_form_that_is_asked_for(served, shown):
    path, ids = shown
    url = f"{path}/frames/{ids[0]}/signature"
    as_json = served.client.get(url)
    vector = base64.b64decode(as_json.json()["base64"])
    assert (as_json.json()["length"], as_json.json()["frame_id"]) == (len(vector), ids[0])
    answers = {}
    for accept, kind in {
        "application/octet-stream": "application/octet-stream",
        "application/x-npy": "application/x-npy",
        "text/html, application/*;q=0.5, application/x-npy;q=0.9": "application/x-npy",
        "*/*": "application/json",
    }.items():
        answer = served.client.get(url, headers={"Accept": accept})
        assert answer.headers["content-type"] == kind, accept
        assert "Accept" in answer.headers["vary"].split(", ")
        answers[kind] = answer
    assert answers["application/octet-stream"].content == vector
    read = np.load(io.BytesIO(answers["application/x-npy"].content), allow_pickle=False)
    assert read.tobytes() == vector
    assert len({answer.headers["etag"] for answer in answers.values()}) == 3


def test_pictures_and_uploads_are_files(served, shown, small_shots):
    path, ids = shown
    picture = served.client.get(f"{path}/frames/{ids[0]}/preview.png?width=400")
    with Image.open(io.BytesIO(picture.content)) as image:
        assert image.size[0] == 400
    assert picture.headers["content-disposition"] == f'inline; filename="{ids[0]}-depth.png"'
    upload = served.client.get(f"{path}/frames/{ids[0]}/upload")
    assert upload.content == small_shots[0].png
    assert upload.headers["content-disposition"] == f'inline; filename="{ids[0]}.png"'
    assert upload.headers["content-type"] == "image/png"
    rest = {"Range": "bytes=100-", "If-Range": upload.headers["etag"]}
    part = served.client.get(f"{path}/frames/{ids[0]}/upload", headers=rest)
    assert (part.status_code, part.content) == (206, small_shots[0].png[100:])


def test_an_edit_does_not_overwrite_another(served, shown, refused):
    path, ids = shown
    url = f"{path}/frames/{ids[2]}"
    read = served.client.get(url)
    tag = read.headers["etag"]
    assert tag == f'"{read.json()["etag"]}"'
    kind = {"Content-Type": "application/merge-patch+json"}
    done = served.client.patch(
        url, content='{"tags": ["window"], "robot": null}', headers={"If-Match": tag, **kind}
    )
    assert done.status_code == 200, done.text
    assert (done.json()["tags"], done.json()["robot"]) == (["window"], None)
    assert done.headers["etag"] == served.client.get(url).headers["etag"] != tag
    assert done.json() == served.client.get(url).json()
    for options in (tag, f"W/{done.headers['etag']}", '"a", "b"'):
        late = served.client.patch(url, json={"tags": []}, headers={"If-Match": options})
        refused(late, 412, "precondition-failed")
    refused(
        served.client.patch(url, json={}, headers={"If-Match": "5"}),
        422, "invalid-request", "including its quotes",
    )  # fmt: skip
    for options in ({}, {"If-Match": "*"}, {"If-Match": f'"x", {done.headers["etag"]}'}):
        assert served.client.patch(url, json={"robot": None}, headers=options).status_code == 200
    back = {"tags": ["door"], "robot": "r2"}
    assert served.client.patch(url, json=back).headers["etag"] == tag
