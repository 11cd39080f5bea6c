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
