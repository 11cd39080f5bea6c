"""Tests of the priority of an upload over HTTP."""

from __future__ import annotations

import pytest


@pytest.fixture(scope="module")
def path(served, make_map):
    return make_map(served, "ranked")


@pytest.mark.parametrize("given", ["11", "1.0", "high", "", "٣"])
def test_a_priority_is_a_small_whole_number(served, path, small_shots, refused, given):
    form = small_shots[9].form()
    form["data"] |= {"priority": given}
    problem = refused(served.client.post(f"{path}/frames", **form), 422, "invalid-request")
    assert [one["field"] for one in problem["errors"]] == ["priority"]
    query = served.client.post(f"{path}/queries", **form)
    refused(query, 422, "invalid-request", "an unknown part 'priority'")


def test_a_frame_says_its_priority(served, path, small_shots):
    for shot, given, told in ((10, "-10", -10), (11, "+3", 3), (12, None, 0)):
        form = small_shots[shot].form()
        form["data"] |= {} if given is None else {"priority": given}
        answer = served.client.post(f"{path}/frames", **form)
        assert answer.status_code == 202, answer.text
        job = served.client.get(answer.headers["location"]).json()
        assert job["priority"] == told
