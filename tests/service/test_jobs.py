"""Jobs over HTTP: listed, cancelled, tried again; and what comes first."""

from __future__ import annotations

import pytest

from sceneprint.engine import Engine
from sceneprint.engine.jobs.lifecycle import cancel, worker_died
from sceneprint.settings import Settings


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
    done = served.client.post(f"{path}/frames", **form, headers={"Prefer": "wait=60"}).json()
    assert done["state"] == "indexed"
    answer = served.client.post(f"/v1/jobs/{done['job_id']}/cancel")
    refused(answer, 409, "job-over", "is succeeded")


def test_dead_jobs_are_listed_with_their_tracebacks(idle, make_map, small_shots, refused):
    path, client = make_map(idle, "dead"), idle.client
    with Engine(Settings(data_dir=idle.folder)) as engine:
        for job in client.get("/v1/jobs", params={"state": "queued"}).json()["items"]:
            cancel(engine.store, job["job_id"])  # of other tests
        ids = [sent(idle, path, shot)["job_id"] for shot in small_shots[2:5]]
        for number in range(1, 4):
            work = engine.claim("w")
            for failure in range(3):
                token = work.job.token - failure  # as if three had died over it
                worker_died(engine.store, work.job.id, token, f"died {number}", "T", counts=True)
    # two of the three deaths were of workers that had lost it
    found = client.get("/v1/jobs", params={"state": "dead", "limit": 2}).json()
    assert [job["job_id"] for job in found["items"]] == ids[:0:-1]
    assert [(job["error"], job["traceback"]) for job in found["items"]] == [
        ("died 3", "T"),
        ("died 2", "T"),
    ]
    asked = {"state": "dead", "limit": 2, "cursor": found["next_cursor"]}
    rest = client.get("/v1/jobs", params=asked).json()
    assert ([job["job_id"] for job in rest["items"]], rest["next_cursor"]) == (ids[:1], None)
    assert client.get("/v1/jobs").json()["items"][0]["job_id"] == ids[2]
    for wrong in ({"state": "asleep"}, {"limit": 0}, {"cursor": "x"}):
        refused(client.get("/v1/jobs", params=wrong), 422, "invalid-request")
    again = client.post(f"/v1/jobs/{ids[0]}/retry").json()
    dead = client.get("/v1/jobs", params={"state": "dead"}).json()["items"]
    assert [job["followed_by"] for job in dead] == [None, None, again["job_id"]]
    for job in (*dead, again):
        told = client.get(f"/v1/jobs/{job['job_id']}").json()["followed_by"]
        assert told == job["followed_by"]
    refused(client.post(f"/v1/jobs/{again['job_id']}/retry"), 409, "cannot-retry")


@pytest.mark.parametrize("given", ["11", "-11", "1.0", "high", "", "1e1", "٣", "0x1"])
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
