"""Tests of machine faults under a running service, reported without secrets."""

import re

import pytest


@pytest.fixture(scope="module")
def shaken(begin, make_map, small_shots):
    """A server whose store is about to be damaged, with one indexed frame."""
    server = begin()
    path = make_map(server, "hall")
    for shot in small_shots[:2]:
        server.index(path, shot)
    return server


def test_a_database_that_vanishes_is_told_of_and_comes_back(
    shaken, small_shots, refused, truth, until
):
    path = "/v1/maps/hall/frames"
    with truth(shaken.folder) as connection:
        connection.exec_driver_sql("ALTER TABLE jobs RENAME TO away")
    until(lambda: shaken.client.get("/readyz").status_code == 503)
    for answer in (
        shaken.client.get("/readyz"),
        shaken.client.get(path),
        shaken.client.post(path, **small_shots[2].form()),
    ):
        refused(answer, 503, "unusable-store", "Its log has the details")
        assert answer.headers["retry-after"] == "1"
        own = answer.headers["x-request-id"]
        noted = [line for line in shaken.log("request failed") if line["request_id"] == own]
        # to the operator all of it, in the words of either database
        assert re.search('no such table: jobs|relation "jobs" does not', noted[0]["error"])
    assert shaken.client.get("/healthz").json()["status"] == "ok"
    with truth(shaken.folder) as connection:
        connection.exec_driver_sql("ALTER TABLE away RENAME TO jobs")
    until(lambda: shaken.client.get("/readyz").status_code == 200)
    shaken.index("/v1/maps/hall", small_shots[2])
    assert len(shaken.workers) == 1
    assert shaken.log("worker died") == []


def test_what_nobody_thought_of_is_told_by_its_id_alone(shaken, refused, truth):
    with truth(shaken.folder) as connection:
        connection.exec_driver_sql("UPDATE maps SET model_id = model_id, created_at = 1e30")
    answer = shaken.client.get("/v1/maps", headers={"X-Request-Id": "unheard-of"})
    refused(answer, 500, "internal-error", "Please report it")
    assert answer.headers["x-request-id"] == "unheard-of"
    (noted,) = shaken.log("unexpected error")
    assert noted["request_id"] == "unheard-of"
    assert "Traceback" in noted["traceback"]
    (line,) = [line for line in shaken.log("request") if line["request_id"] == "unheard-of"]
    assert (line["status"], line["method"], line["path"]) == (500, "GET", "/v1/maps")
    counted = 'sceneprint_requests_total{method="GET",route="/v1/maps",status="500"} 1.0'
    assert counted in shaken.client.get("/metrics").text


def test_methods_that_are_none_make_no_figures_of_their_own(shaken):
    for i in range(3):
        assert shaken.client.request(f"BREW{i}", "/healthz").status_code == 405
    text = shaken.client.get("/metrics").text
    assert "BREW" not in text
    assert 'method="other"' in text
