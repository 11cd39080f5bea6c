"""Tests of stored queries: their results, and repetitions with the same or other options."""

import numpy as np
import pytest


@pytest.fixture(scope="module")
def shots(small_shots):
    """Three views of each of two rooms."""
    return small_shots[::16]


@pytest.fixture(scope="module")
def original(served, make_map, shots):
    """Three views of a room in a map, and the answer to an upload with a base and a session."""
    path = make_map(served, "again")
    for i in (0, 1, 3):
        served.index(path, shots[i], session="s", captured_at=f"2026-11-16T09:30:0{i}Z")
    base = {"base_frame": "base_link", "matrix": np.eye(4).tolist()}
    form = shots[0].form(
        session="s", robot="r", captured_at="2026-11-16T09:30:00Z", T_base_sensor=base
    )
    form["data"] |= {"seed": "3", "validation": '{"residual_m": 0.05}'}
    reply = served.client.post(f"{path}/queries", **form)
    answer = reply.json()
    assert answer["status"] == "found"
    assert served.client.get(f"/v1/queries/{answer['query_id']}").text == reply.text
    return answer


def again(served, query_id, **options):
    question = served.client.get(f"/v1/queries/{query_id}/question").json()
    body = {"maps": question["maps"], **question["options"], **options, "query_id": query_id}
    body = {name: value for name, value in body.items() if value is not None}
    reply = served.client.post("/v1/queries", json=body)
    assert reply.status_code == 200, reply.text
    return reply.json()


def same(answer):
    """What of an answer must not change when it is asked again."""
    return {
        name: value for name, value in answer.items() if name not in ("query_id", "milliseconds")
    }


def test_an_upload_is_asked_again_without_its_file(served, original):
    repeated = again(served, original["query_id"])
    assert repeated["query_id"] != original["query_id"]
    assert same(repeated) == same(original)
    assert same(served.client.get(f"/v1/queries/{repeated['query_id']}").json()) == same(original)
    fewer = again(served, repeated["query_id"], k=1, candidates=2)
    assert (fewer["counts"]["selected"], fewer["seed"]) == (2, 3)
    assert again(served, fewer["query_id"], k=None, candidates=None)["counts"] == original["counts"]
    # the session and the time that came with the upload are known still
    apart = again(served, original["query_id"], filter={"not_within_s": 2.0})
    assert apart["counts"]["passed"] == 1


def test_another_frame_of_the_same_id_is_not_asked_in_its_place(served, make_map, shots, refused):
    path = make_map(served, "again-other")

    def put(i):
        reply = served.client.put(
            f"{path}/frames/door", **shots[i].form(), headers={"Prefer": "wait=200"}
        )
        assert reply.json()["state"] == "indexed", reply.text

    put(0)
    by_id = {"frame_id": "door", "stages": "retrieve"}
    query_id = served.client.post(f"{path}/queries", json=by_id).json()["query_id"]
    assert served.client.delete(f"{path}/frames/door").status_code == 204
    put(2)
    body = {"maps": ["again-other"], "query_id": query_id}
    refused(served.client.post("/v1/queries", json=body), 404, "unknown-query")


def test_what_cannot_be_asked_again(served, original, shots, refused):
    path = f"/v1/queries/{original['query_id']}"
    reply = served.client.get(f"{path}/preview.png?view=patches")
    refused(reply, 422, "invalid-request", "not stored")
    frame = {"map": "again", "frame_id": "x"}
    for wrong in ({"kk": 2}, {"frame": frame}):
        body = {"maps": ["again"], "query_id": original["query_id"]} | wrong
        refused(served.client.post("/v1/queries", json=body), 422, "invalid-request", "")
    form = shots[0].form()
    form["data"] |= {"maps": "again", "query_id": original["query_id"]}
    refused(served.client.post("/v1/queries", **form), 422, "invalid-request", "two frames")
    for body, kind in (
        ({"maps": ["nowhere"], "query_id": original["query_id"]}, "unknown-map"),
        ({"maps": ["again"], "query_id": "0" * 32}, "unknown-query"),
    ):
        refused(served.client.post("/v1/queries", json=body), 404, kind)
    # without validation there are no points to validate or draw
    form = shots[0].form()
    form["data"]["stages"] = "retrieve"
    bare = served.client.post("/v1/maps/again/queries", **form).json()["query_id"]
    refused(served.client.get(f"/v1/queries/{bare}/preview.png"), 409, "not-indexed", "validate")
    assert not served.client.get(f"/v1/queries/{bare}/question").json()["validates"]
    reply = served.client.post("/v1/queries", json={"maps": ["again"], "query_id": bare})
    refused(reply, 409, "not-indexed", "Send the frame")


def test_stored_results_that_are_not_there(served, original, shots, refused):
    form = shots[1].form()
    form["data"]["keep"] = "false"
    unkept = served.client.post("/v1/maps/again/queries", **form).json()
    assert served.client.get(f"/v1/queries/{unkept['query_id']}").status_code == 404
    path, best = f"/v1/queries/{original['query_id']}", original["matches"][0]["frame_id"]
    for tail in ("", "/cloud.ply", "/similarities", "/matches/x", "/matches/x/overlay.ply"):
        for query_id in ("0" * 32, "..%2fsceneprint.db", "x", original["query_id"].upper()):
            reply = served.client.get(f"/v1/queries/{query_id}{tail}")
            assert reply.status_code == 404
            if "%" not in query_id:
                refused(reply, 404, "unknown-query", "expired")
    refused(served.client.get(f"{path}/matches/nobody"), 404, "unknown-frame", "has no match")
    wall = original["matches"][-1]["frame_id"]
    reply = served.client.get(f"{path}/matches/{wall}/overlay.ply?transform=rival")
    refused(reply, 422, "invalid-request", "has no rival")
    assert served.client.delete(f"/v1/maps/again/frames/{best}").status_code == 204
    refused(served.client.get(f"{path}/matches/{best}"), 404, "unknown-frame", "was deleted")
