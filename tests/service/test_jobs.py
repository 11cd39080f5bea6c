"""Jobs over HTTP: listed, cancelled, tried again; and what comes first."""

from __future__ import annotations

import pytest


@pytest.fixture(scope="module")
def idle(begin):
    """A server without workers: jobs stay as they are."""
    return begin("--workers", "0")


def sent(server, path, shot, **fields):
    form = shot.form()
    form["data"] |= {name: str(value) for name, value in fields.items()}
    answer = server.client.post(f"{path}/frames", **form)
    assert answer.status_code == 202, answer.text
    return answer.json()


def test_a_job_is_cancelled_and_tried_again(idle, make_map, small_shots, refused):
    path, client = make_map(idle, "given-up"), idle.client
    first = sent(idle, path, small_shots[0])
    place = f"/v1/jobs/{first['job_id']}"
    refused(
        client.post(f"{place}/retry"), 409, "cannot-retry", "is queued and its frame is received"
    )
    for _ in range(2):
        cancelled = client.post(f"{place}/cancel")
        assert (cancelled.status_code, cancelled.json()["state"]) == (200, "cancelled")
    frame = client.get(f"{path}/frames/{first['frame_id']}").json()
    assert (frame["state"], frame["reason"]) == ("failed", "its job was cancelled")
    again = client.post(f"{place}/retry")
    assert (again.status_code, again.json()["state"]) == (202, "queued")
    assert again.headers["location"] == f"/v1/jobs/{again.json()['job_id']}"
    twice = client.post(f"{place}/retry")
    assert (twice.status_code, twice.json()) == (200, again.json())
    assert client.get(f"{path}/frames/{first['frame_id']}").json()["state"] == "received"
    for what in ("cancel", "retry"):
        refused(client.post(f"/v1/jobs/nobody/{what}"), 404, "unknown-job")


def test_what_is_over_cannot_be_cancelled(served, make_map, small_shots, refused):
    path = make_map(served, "over")
    form = small_shots[1].form()
    done = served.client.post(f"{path}/frames", **form, headers={"Prefer": "wait=200"}).json()
    assert done["state"] == "indexed"
    answer = served.client.post(f"/v1/jobs/{done['job_id']}/cancel")
    refused(answer, 409, "job-over", "is succeeded")


@pytest.mark.parametrize("given", ["11", "1.0", "high", "", "٣"])
def test_a_priority_is_a_small_whole_number(idle, make_map, small_shots, refused, given):
    path = f"/v1/maps/{idle.client.get('/v1/maps').json()['items'][0]['name']}"
    form = small_shots[9].form()
    form["data"] |= {"priority": given}
    problem = refused(idle.client.post(f"{path}/frames", **form), 422, "invalid-request")
    assert [one["field"] for one in problem["errors"]] == ["priority"]
    query = idle.client.post(f"{path}/queries", **form)
    refused(query, 422, "invalid-request", "an unknown part 'priority'")


def test_a_frame_says_its_priority(idle, make_map, small_shots):
    path = make_map(idle, "ranked")
    for shot, given, told in (
        (10, {"priority": "-10"}, -10),
        (11, {"priority": "+3"}, 3),
        (12, {}, 0),
    ):
        job = sent(idle, path, small_shots[shot], **given)["job_id"]
        assert idle.client.get(f"/v1/jobs/{job}").json()["priority"] == told
