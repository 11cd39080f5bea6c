"""Tests of overload: some requests wait, and others receive Retry-After."""

import os
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack

import pytest


@pytest.fixture(scope="module")
def busy(begin, make_map, small_shots):
    """A server that works on one thing at a time, lets one wait, and has a map of two frames."""
    server = begin(concurrent_requests=1, queued_requests=1)
    path = make_map(server, "hall")
    for shot in small_shots[:2]:
        server.index(path, shot)
    return server


def test_who_comes_too_many_is_sent_away_and_may_come_back(busy, shots, refused):
    def ask(_):
        return busy.client.post("/v1/maps/hall/queries", **shots[0].form())

    with ThreadPoolExecutor(13) as pool:
        asked = [pool.submit(ask, i) for i in range(12)]
        health = pool.submit(busy.client.get, "/healthz")
        answers = [one.result() for one in asked]
        assert health.result().json()["status"] == "ok"
    kinds = sorted(answer.status_code for answer in answers)
    assert set(kinds) == {200, 503}
    for answer in answers:
        if answer.status_code == 503:
            refused(answer, 503, "busy", "Retry in a second")
            assert answer.headers["retry-after"] == "1"
        else:
            assert answer.json()["counts"]["map"] == 2
    assert [ask(i).status_code for i in range(3)] == [200, 200, 200]  # and none is still held
    assert [line for line in busy.log() if line["level"] == "error"] == []


def test_as_many_wait_as_may_and_not_one_more(busy, until, refused, rows):
    """One is at work for as long as the test likes: its artifact comes through a pipe."""
    asked = "SELECT f.id, s.geometry FROM signatures s JOIN frames f ON f.number = frame_number"
    frame_id, blob = rows(busy.folder, asked)[0]
    path = busy.folder / "blobs" / blob[:2] / blob
    content = path.read_bytes()
    path.unlink()
    os.mkfifo(path)

    def ask():
        return busy.client.post("/v1/maps/hall/queries", json={"frame_id": frame_id})

    def opened():
        try:
            return os.open(path, os.O_WRONLY | os.O_NONBLOCK)
        except OSError:
            return 0  # nobody reads yet

    with ThreadPoolExecutor(5) as pool:
        asked = [pool.submit(ask)]
        pipe = until(opened)
        os.set_blocking(pipe, True)
        try:
            whole = path.with_suffix(".whole")
            whole.write_bytes(content)
            whole.replace(path)  # the others read a file
            asked += [pool.submit(ask) for _ in range(4)]
            until(lambda: sum(one.done() for one in asked) == 3)
            for one in asked:
                if one.done():
                    refused(one.result(), 503, "busy")
            os.write(pipe, content)
        finally:
            os.close(pipe)
        assert sorted(one.result().status_code for one in asked) == [200, 200, 503, 503, 503]


def test_who_hangs_up_while_waiting_has_sent_a_frame_nevertheless(busy, until, small_shots):
    form = small_shots[7].form()
    request = busy.client.build_request(
        "POST", "/v1/maps/hall/frames", **form, headers={"Prefer": "wait=200"}
    )
    lines = [f"POST {request.url.path} HTTP/1.1".encode()]
    lines += [key + b": " + value for key, value in request.headers.raw]
    before = {one["frame_id"] for one in busy.client.get("/v1/maps/hall/frames").json()["items"]}
    with busy.connect() as wire:
        wire.sendall(b"\r\n".join(lines) + b"\r\n\r\n" + request.read())

        def came():
            page = busy.client.get("/v1/maps/hall/frames").json()
            return {one["frame_id"] for one in page["items"]} - before

        (frame_id,) = until(came)
    again = busy.client.post("/v1/maps/hall/frames", **form)
    assert (again.status_code, again.json()["frame_id"]) == (200, frame_id)

    def state():
        return str(busy.client.get(f"/v1/maps/hall/frames/{frame_id}").json()["state"])

    until(lambda: state() not in ("received", "signing"))
    assert state() == "indexed"
    assert busy.client.get("/healthz").status_code == 200
    assert [line for line in busy.log() if line["level"] == "error"] == []


@pytest.mark.thorough
def test_slow_uploads_hold_their_places_for_a_while_and_no_queries(busy, small_shots, refused):
    """Two of them take both places for uploads, until their time is over."""
    request = busy.client.build_request("POST", "/v1/maps/hall/frames", **small_shots[20].form())
    lines = [f"POST {request.url.path} HTTP/1.1".encode()]
    lines += [key + b": " + value for key, value in request.headers.raw]
    whole = b"\r\n".join(lines) + b"\r\n\r\n" + request.read()
    with ExitStack() as opened:
        wires = []
        for _ in range(2):
            wires.append(opened.enter_context(busy.connect()))
            wires[-1].sendall(whole[: len(whole) // 2])
        answers = [busy.client.post("/v1/maps/hall/frames", **small_shots[21].form())]
        asked = busy.client.post("/v1/maps/hall/queries", **small_shots[0].form())
        assert asked.status_code == 200
        said = [wire.recv(65536) for wire in wires]
    assert [one.startswith(b"HTTP/1.1 408 ") for one in said] == [True, True]
    assert all(b"connection: close" in one.lower() for one in said)
    while answers[-1].status_code == 503:  # the first may come before the slow heads are read
        refused(answers[-1], 503, "busy")
        answers.append(busy.client.post("/v1/maps/hall/frames", **small_shots[21].form()))
    assert answers[-1].status_code in (200, 202)
