"""Frames out and edited over HTTP: what the headers promise, and how it is refused."""

from __future__ import annotations

import base64
import io
import re
import socket
from datetime import datetime
from pathlib import Path

import httpx
import numpy as np
import pytest
from PIL import Image

from benchmarks.waiting import PATIENCE_S


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
        added = served.client.post(
            f"{path}/frames", **shot.form(**meta), headers={"Prefer": "wait=200"}
        )
        assert added.json()["state"] == "indexed", added.text
        ids.append(added.json()["frame_id"])
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

    def resident() -> int:
        status = Path(f"/proc/{served.process.pid}/status").read_text()
        return int(re.findall(r"VmRSS:\s+(\d+) kB", status)[0]) << 10

    url, before, wires = httpx.URL(served.url), resident(), []
    head = f"GET {path}/frames/{sent.json()['frame_id']}/upload HTTP/1.1\r\nHost: localhost\r\n\r\n"
    try:
        for _ in range(12):
            wires.append(wire := socket.create_connection((url.host, url.port), timeout=PATIENCE_S))
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


def test_lists_by_metadata(served, shown, refused):
    path, ids = shown

    def listed(query):
        page = served.client.get(f"{path}/frames?{query}")
        assert page.status_code == 200, page.text
        return [one["frame_id"] for one in page.json()["items"]]

    assert listed("order=desc") == ids[::-1]
    assert listed("tag=door&robot=r1&robot=r2") == ids[1:]
    assert listed("captured_after=2026-11-16T10:30:01%2B01:00") == ids[1:]
    assert listed("captured_before=2026-11-16T09:30:01Z&session=monday") == ids[:2]
    assert listed("parent_frame=hall&has_pose=true&order=desc&limit=2") == ids[:0:-1]
    assert listed("has_pose=false") == listed("received_before=2020-01-01T00:00:00Z") == []
    page = served.client.get(f"{path}/frames?order=desc&limit=2").json()
    assert listed(f"order=desc&limit=2&cursor={page['next_cursor']}") == ids[:1]
    content = served.client.get(f"{path}/frames/{ids[1]}").json()["content_id"]
    assert listed(f"content_id={content}") == [ids[1]]
    for bad in ("sesion=monday", "order=up", "captured_after=2026-11-16T09:30:00", "tag=",
                "content_id=abc", "has_pose=perhaps", "limit=0"):  # fmt: skip
        problem = refused(served.client.get(f"{path}/frames?{bad}"), 422, "invalid-request")
        assert bad.partition("=")[0] in problem["errors"][0]["field"]


def test_sessions_and_a_trajectory(served, shown, refused):
    path, ids = shown
    (session,) = served.client.get(f"{path}/sessions").json()["items"]
    assert session == {
        "robot": "r2", "session": "monday", "frames": {"indexed": 3}, "with_pose": 3,
        "first_captured_at": "2026-11-16T09:30:00Z", "last_captured_at": "2026-11-16T09:30:02Z",
        "parent_frames": ["hall"], "tags": ["door"],
    }  # fmt: skip
    text = served.client.get(f"{path}/trajectory?session=monday")
    assert text.headers["content-type"].partition(";")[0] == "text/plain"
    start = datetime.fromisoformat("2026-11-16T09:30:00Z").timestamp()
    lines = [line for line in text.text.splitlines() if not line.startswith("#")]
    assert [[float(word) for word in line.split()] for line in lines] == [
        [start + i, i, 0, 1, 0, 0, 0, 1] for i in range(3)
    ]
    assert "# poses of the sensors' frames in hall, metres" in text.text
    url = f"{path}/trajectory?session=monday&captured_after=2026-11-16T09:30:01Z"
    told = served.client.get(url, headers={"Accept": "application/json"}).json()
    assert (told["frame_ids"], told["parent_frame"], told["left_out"]) == (ids[1:], "hall", 0)
    assert told["poses"] == [[start + i, i, 0, 1, 0, 0, 0, 1] for i in (1, 2)]
    thin = served.client.get(f"{path}/trajectory?session=monday&most=2")
    lines = [line for line in thin.text.splitlines() if not line.startswith("#")]
    assert [float(line.split()[0]) - start for line in lines] == [0, 2]
    assert "# poses: 2 of 3, evenly spaced; frames left out: 1" in thin.text
    refused(served.client.get(f"{path}/trajectory"), 422, "invalid-request", "session: ")
    for most in (1, 10_001):
        bad = served.client.get(f"{path}/trajectory?session=monday&most={most}")
        refused(bad, 422, "invalid-request", "most: ")
    refused(served.client.get(f"{path}/sessions?cursor=x"), 422, "invalid-request", "is not valid")


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


def test_edits_that_are_none(served, shown, refused):
    path, ids = shown
    for url in (path, f"{path}/frames/{ids[0]}"):
        before = served.client.get(url).json()
        for body, headers, status, kind in (
            (b"{}", {"Content-Type": "text/plain"}, 415, "unsupported-type"),
            (b"{", {"Content-Type": "application/json"}, 400, "malformed-body"),
            (b"[]", {"Content-Type": "application/json"}, 422, "invalid-request"),
            (b'{"nobody": 1}', {"Content-Type": "application/json"}, 422, "invalid-request"),
            (b" " * (1 << 19), {"Content-Type": "application/json"}, 413, "too-large"),
        ):
            refused(served.client.patch(url, content=body, headers=headers), status, kind)
        assert served.client.get(url).json() == before
    refused(served.client.patch(f"{path}/frames/x", json={}), 404, "unknown-frame")
    refused(served.client.patch("/v1/maps/nowhere", json={}), 404, "unknown-map")
    matrix = [[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1]]
    url = f"{path}/frames/{ids[0]}"
    refused(served.client.patch(url, json={"pose": {"matrix": matrix}}), 422, "invalid-pose")
