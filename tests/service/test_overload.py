"""Tests of overload: some requests wait, and others receive Retry-After."""

from concurrent.futures import ThreadPoolExecutor

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
        futures = [pool.submit(ask, i) for i in range(12)]
        health = pool.submit(busy.client.get, "/healthz")
        answers = [future.result() for future in futures]
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


def test_who_hangs_up_while_waiting_has_sent_a_frame_nevertheless(busy, until, small_shots):
    form = small_shots[7].form()
    request = busy.client.build_request(
        "POST", "/v1/maps/hall/frames", **form, headers={"Prefer": "wait=200"}
    )
    lines = [f"POST {request.url.path} HTTP/1.1".encode()]
    lines += [key + b": " + value for key, value in request.headers.raw]
    before = {f["frame_id"] for f in busy.client.get("/v1/maps/hall/frames").json()["items"]}
    with busy.connect() as wire:
        wire.sendall(b"\r\n".join(lines) + b"\r\n\r\n" + request.read())

        def came():
            page = busy.client.get("/v1/maps/hall/frames").json()
            return {item["frame_id"] for item in page["items"]} - before

        (frame_id,) = until(came)
    again = busy.client.post("/v1/maps/hall/frames", **form)
    assert (again.status_code, again.json()["frame_id"]) == (200, frame_id)

    def state():
        return str(busy.client.get(f"/v1/maps/hall/frames/{frame_id}").json()["state"])

    until(lambda: state() not in ("received", "signing"))
    assert state() == "indexed"
    assert busy.client.get("/healthz").status_code == 200
    assert [line for line in busy.log() if line["level"] == "error"] == []
