"""Tests of the query history: a row for each record, and no record of a visit."""

import json

import pytest

ROWS = """() => [...document.querySelectorAll(".queries tbody tr")].map((row) => ({
    id: row.dataset.query, status: row.dataset.status,
    cells: [...row.cells].map((one) => one.innerText.trim()),
    answer: row.querySelector("td:last-child a")?.getAttribute("href") ?? null,
  }))"""
BROKEN = ("frame.png", b"\x89PNG\r\n\x1a\n", "image/png")


@pytest.fixture(scope="module")
def answers(station):
    """Answers to four queries of a map of their own: two found, one of nobody, one that failed."""
    path = station.make_map("seen")
    for sent in station.frames[:2]:
        form = sent.form(priority="10")
        form["data"]["meta"] = json.dumps(sent.meta)
        added = station.client.post(
            f"{path}/frames", headers={"Prefer": "wait=200"}, **form
        )  # fmt: skip
        assert added.json()["state"] == "indexed", added.text
    results = []
    for robot, sent in (("spot", 0), ("cart", 1), (None, 8)):
        form = station.frames[sent].form()
        camera = json.loads(form["data"]["meta"])
        form["data"]["meta"] = json.dumps(
            camera | ({"robot": robot, "session": "run"} if robot else {})
        )
        results.append(station.client.post(f"{path}/queries", **form).json())
    form = station.frames[0].form(keep="false")
    form["files"] = {"frame": BROKEN}
    assert station.client.post(f"{path}/queries", **form).status_code == 422
    return results


def records(station, **params):
    return station.client.get("/v1/queries", params={"map": "seen", **params}).json()["items"]


def test_the_rows_are_the_records_and_filters_are_in_the_address(
    station, answers, page, settle, axe, written
):
    page.goto(f"{station.home}#/maps/seen/queries")
    settle(page)
    listing = records(station)
    rows = page.evaluate(ROWS)
    assert [(row["id"], row["status"]) for row in rows] == [
        (row["query_id"], row["status"]) for row in listing
    ]
    assert [row["status"] for row in rows] == ["failed", "not_found", "found", "found"]
    failed, lost, second, first = (row["cells"] for row in rows)
    assert (failed[1:5], failed[7]) == (["not named", "Failed", "–", "–"], "no answer")
    assert failed[6] == listing[0]["reason"]
    assert lost[2] == "Not found"
    assert lost[6] == written(answers[2]["reason"][0].upper() + answers[2]["reason"][1:]) + "."
    assert (second[1], first[1]) == ("cart\nrun", "spot\nrun")
    place = answers[0]["location"]["pose"]["translation"]
    there = ", ".join(f"{place[axis]:.2f}" for axis in "xyz")
    assert first[3] == f"{there}\nm in room-0"
    assert first[4] == str(answers[0]["location"]["support"])
    assert [row["answer"] for row in rows] == [
        None, *(f"#/queries/{answer['query_id']}" for answer in reversed(answers))
    ]  # fmt: skip
    assert axe(page) == []
    page.select_option("#queries-status", "lost")
    settle(page)
    assert page.url.endswith("#/maps/seen/queries?status=lost")
    assert [row["status"] for row in page.evaluate(ROWS)] == ["failed", "not_found"]
    page.reload()
    settle(page)
    assert [row["status"] for row in page.evaluate(ROWS)] == ["failed", "not_found"]
    page.goto(f"{station.home}#/maps/seen/queries?robot=spot&last=1")
    settle(page)
    assert [row["id"] for row in page.evaluate(ROWS)] == [answers[0]["query_id"]]
    page.goto(f"{station.home}#/maps/seen/queries?until={listing[-1]['at']}")
    settle(page)
    assert page.locator(".state h2").inner_text() == "No queries match"


@pytest.mark.thorough
def test_new_queries_are_announced_and_looking_leaves_none(station, answers, page, settle, until):
    before = records(station)
    page.goto(f"{station.home}#/maps/seen/queries")
    settle(page)
    # the answer, a stored frame with its neighbours, and a query that an address asks once more
    page.get_by_role("link", name=f"Answer {answers[0]['query_id'][:8]}").click()
    settle(page)
    assert page.locator("h1").inner_text().startswith("Answer")
    frame = answers[0]["matches"][0]["frame_id"]
    for place in (f"frames/{frame}", f"query?frame={frame}", "queries"):
        page.goto(f"{station.home}#/maps/seen/{place}")
        settle(page)
    assert records(station) == before
    sent = station.frames[1].form()
    for _ in range(2):
        assert station.client.post("/v1/maps/seen/queries", **sent).status_code == 200
    page.get_by_role("button", name="Show 2 new queries").click()
    settle(page)
    rows = page.evaluate(ROWS)
    assert [row["id"] for row in rows] == [row["query_id"] for row in records(station)]
    assert len(rows) == len(before) + 2
