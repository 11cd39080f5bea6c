"""Tests of downloads and edits of frames over HTTP: headers and errors."""

import base64
import io
import re
import socket
from pathlib import Path

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
    told = served.client.get(url)
    vector = base64.b64decode(told.json()["base64"])
    assert (told.json()["length"], told.json()["frame_id"]) == (len(vector), ids[0])
    answers = {}
    for accept, kind in {
        "application/octet-stream": "application/octet-stream",
        "application/x-npy": "application/x-npy",
        "text/html, application/*;q=0.5, application/x-npy;q=0.9": "application/x-npy",
        "application/json;q=0.2, application/octet-stream;q=0.8": "application/octet-stream",
        "application/*, application/json;q=0": "application/octet-stream",
        "*/*": "application/json",
        "text/html": "application/json",
        ";;,q=": "application/json",
    }.items():
        answer = served.client.get(url, headers={"Accept": accept})
        assert answer.headers["content-type"] == kind, accept
        assert "Accept" in answer.headers["vary"].split(", ")
        answers[kind] = answer
    assert answers["application/octet-stream"].content == vector
    read = np.load(io.BytesIO(answers["application/x-npy"].content), allow_pickle=False)
    assert read.tobytes() == vector
    assert len({one.headers["etag"] for one in answers.values()}) == 3


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


def test_who_does_not_read_an_upload_costs_no_memory(served, make_map):
    path = make_map(served, "unread")
    rows, columns = np.mgrid[:1400, :1600]
    out = io.BytesIO()
    np.save(out, 2 + np.sin(rows / 900) / 3 + np.cos(columns / 700) / 5)
    sent = served.client.post(
        f"{path}/frames?fx=2000&fy=2000&cx=800&cy=700", content=out.getvalue(),
        headers={"Content-Type": "application/x-npy"},
    )  # fmt: skip
    assert sent.status_code == 202, sent.text

    def resident():
        status = Path(f"/proc/{served.process.pid}/status").read_text()
        return int(re.findall(r"VmRSS:\s+(\d+) kB", status)[0]) << 10

    before, wires = resident(), []
    head = f"GET {path}/frames/{sent.json()['frame_id']}/upload HTTP/1.1\r\nHost: localhost\r\n\r\n"
    try:
        for _ in range(12):
            wires.append(wire := served.connect())
            wire.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            wire.sendall(head.encode())
            assert wire.recv(12) == b"HTTP/1.1 200"
        assert resident() - before < 4 * len(out.getvalue())
    finally:
        for wire in wires:
            wire.close()
    assert served.client.delete(path).status_code == 204


@pytest.mark.parametrize(
    ("query", "field"),
    [
        ("cloud.ply?frame=world", "frame"),
        ("cloud.ply?frame=base", "frame"),
        ("preview.png?view=colour", "view"),
        ("preview.png?width=63", "width"),
        ("preview.png?width=1281", "width"),
    ],
)
def test_what_cannot_be_made_is_refused(served, shown, refused, query, field):
    path, ids = shown
    answer = served.client.get(f"{path}/frames/{ids[0]}/{query}")
    problem = refused(answer, 422, "invalid-request")
    assert [one["field"] for one in problem["errors"]] == [field]


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
    for given in (tag, f"W/{done.headers['etag']}", '"a", "b"'):
        late = served.client.patch(url, json={"tags": []}, headers={"If-Match": given})
        refused(late, 412, "precondition-failed")
    refused(
        served.client.patch(url, json={}, headers={"If-Match": "5"}),
        422, "invalid-request", "including its quotes",
    )  # fmt: skip
    for given in ({}, {"If-Match": "*"}, {"If-Match": f'"x", {done.headers["etag"]}'}):
        assert served.client.patch(url, json={"robot": None}, headers=given).status_code == 200
    back = {"tags": ["door"], "robot": "r2"}
    assert served.client.patch(url, json=back).headers["etag"] == tag

    whole = served.client.get(path)
    assert whole.headers["etag"] == f'"{whole.json()["etag"]}"'
    titled = served.client.patch(
        path, json={"title": "Shown"}, headers={"If-Match": whole.headers["etag"]}
    )
    assert titled.json() == served.client.get(path).json()
    assert titled.json()["title"] == "Shown"
    late = served.client.patch(
        path, json={"title": None}, headers={"If-Match": whole.headers["etag"]}
    )
    refused(late, 412, "precondition-failed")
