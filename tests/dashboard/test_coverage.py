"""Tests of the coverage page against the API: a new job, its plan, cells and changes."""

from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from tests.dashboard.conftest import expect

OUTCOMES = ("found", "wrong", "ambiguous", "not_found")
CELLS = """all => all.map(one => ({cell: one.dataset.cell, outcome: one.dataset.outcome,
    x: Number(one.getAttribute("x")), y: Number(one.getAttribute("y")),
    width: Number(one.getAttribute("width"))}))"""


def key(cell):
    return f"{cell['column']},{cell['row']}"


def click_at(page, place):
    """Click on a place of the plan, metres to the right and to the top."""
    project = """([u, v]) => { const { view } = document.querySelector(".plan").plan;
        return [view.x(u), view.y(v)]; }"""
    x, y = page.evaluate(project, [float(one) for one in place])
    page.locator(".plan-sheet").click(position={"x": x, "y": y})


@pytest.fixture
def measured(station, four_sides, page, settle):
    """The result of a job that was begun on the page, which shows it."""
    del four_sides  # its map is measured
    path = "/v1/maps/four-sides/coverage"
    known = {item["job_id"] for item in station.client.get(path).json()["items"]}
    page.goto(f"{station.home}#/maps/four-sides/coverage")
    settle(page)
    if not known:
        expect(page.get_by_role("heading", name="Coverage has not been measured")).to_be_visible()
    page.locator("#cover-begin").click()
    dialog = page.get_by_role("dialog")
    dialog.get_by_label("A frame must not find").select_option("only the frame itself")
    dialog.get_by_text("Tolerance and cells").click()
    dialog.get_by_label("Cell width, m").fill("0.5")
    dialog.get_by_role("button", name="Start").click()
    expect(page.get_by_text("Coverage was measured.")).to_be_visible()
    settle(page)
    (i,) = (i for i in station.client.get(path).json()["items"] if i["job_id"] not in known)
    assert (i["request"]["not_within_s"], i["request"]["cell_m"]) == (0, 0.5)
    record = station.client.get(f"{path}/{i['job_id']}").json()
    frames = station.client.get(f"{path}/{i['job_id']}/frames").json()["items"]
    return {**record, "frames": frames}


@pytest.mark.thorough
def test_a_result_is_begun_shown_and_explained(station, page, settle, measured, axe, written):
    result, (plan,) = measured["result"], measured["plans"]
    assert result["ambiguous"] > 0  # its four sides look the same
    for name in OUTCOMES:
        count = page.locator(f".cover-counts [data-outcome={name}] strong")
        expect(count).to_have_text(str(result[name]))
    drawn = page.locator(".cover-cell").evaluate_all(CELLS)
    cells = {key(cell): cell for cell in plan["cells"]}
    assert {mark["cell"] for mark in drawn} == set(cells)
    for mark in drawn:
        cell = cells[mark["cell"]]
        assert [mark["x"], mark["y"]] == pytest.approx([cell["column"] * 0.5, cell["row"] * 0.5])
        assert mark["width"] == 0.5
        counts = {name: cell[name] for name in OUTCOMES}
        if not sum(counts.values()):
            assert mark["outcome"] == "none"
        else:
            worst = max(("not_found", "ambiguous", "found"), key=lambda name: counts[name])
            assert mark["outcome"] == ("wrong" if counts["wrong"] else worst)
    # the cell of a frame that is mistaken: what stands in it, and what each looks like
    frame = next(frame for frame in measured["frames"] if frame["look_alikes"])
    axes = np.array([plan["x_axis"], plan["y_axis"]])
    places = {
        frame["frame_id"]: axes @ [frame["position"][axis] for axis in "xyz"]
        for frame in measured["frames"]
    }
    cell_of = {name: tuple(np.floor(at / 0.5).astype(int).tolist()) for name, at in places.items()}
    chosen = cell_of[frame["frame_id"]]
    click_at(page, places[frame["frame_id"]])
    settle(page)
    assert f"cell={chosen[0]}%2C{chosen[1]}&frame={frame['frame_id']}" in page.url
    inside = {name for name, cell in cell_of.items() if cell == chosen}
    listed = page.locator(".cover-frames > li").evaluate_all(
        "all => all.map(one => one.dataset.frame)"
    )
    assert set(listed) == inside
    own = page.locator(f".cover-frames [data-frame='{frame['frame_id']}']")
    alike = own.locator("[data-overlay]").evaluate_all("all => all.map(one => one.dataset.overlay)")
    assert alike == frame["look_alikes"]
    assert written(frame["reason"][1:]) in own.inner_text()
    assert page.locator(".cover-link").count() == len(frame["look_alikes"])
    assert axe(page) == []
    # the numbers are those of the API
    path = f"/v1/maps/four-sides/coverage/{measured['job_id']}"
    with page.expect_download() as waited:
        page.get_by_role("button", name="JSON").click()
    assert Path(waited.value.path()).read_bytes() == station.client.get(path).content


@pytest.mark.thorough
def test_two_results_are_compared(station, four_sides, page, settle, until):
    del four_sides  # its map is measured twice, by three of its frames
    path = "/v1/maps/four-sides/coverage"
    before, after = (
        station.client.post(path, json={"not_within_s": 0, "every": 4}).json()["job_id"]
        for _ in range(2)
    )
    for one in (before, after):
        until(lambda one=one: station.client.get(f"{path}/{one}").json()["state"] == "succeeded")
    changes = station.client.get(f"{path}/{after}/changes", params={"since": before}).json()
    page.goto(f"{station.home}#/maps/four-sides/coverage?result={after}")
    settle(page)
    page.locator("#cover-since").select_option(before)
    settle(page)
    trends = page.locator(".cover-cell").evaluate_all("all => all.map(one => one.dataset.trend)")
    assert Counter(trends) == {name: n for name, n in changes["trends"].items() if n}
    for name, n in changes["trends"].items():
        expect(page.locator(f".cover-counts [data-trend={name}] strong")).to_have_text(str(n))
    assert f"since={before}" in page.url
    page.get_by_role("button", name="Delete").click()
    page.get_by_role("button", name="Delete result").click()
    expect(page.get_by_text("The result was deleted.")).to_be_visible()
    settle(page)
    assert station.client.get(f"{path}/{after}").status_code == 404
    expect(page.locator("#cover-result")).not_to_have_value(after)


def test_cells_are_ranked_by_what_robots_lose(run):
    """Worked out by hand: shares found less shares wrong are -1, 0, 0, 0.5 and 1."""

    def cell(column, **counts):
        fields = {"column": column, "row": 0, "frames": 9, "unchecked": 0}
        return {**fields, **dict.fromkeys(OUTCOMES, 0), **counts}

    cells = [
        cell(0, found=1, not_found=1), cell(1, found=3), cell(2, not_found=1), cell(3, ambiguous=2),
        cell(4, wrong=1), cell(5), cell(6, unchecked=2), cell(7, found=1, unchecked=1),
    ]  # fmt: skip
    worst = run("coverage/outcomes", "m.worstCells(given[0]).map((one) => one.column)", cells)
    outcomes = run("coverage/outcomes", "given[0].map(m.outcomeIn)", cells)
    assert worst == [4, 3, 2, 0]
    assert outcomes[:5] == ["not_found", "found", "not_found", "ambiguous", "wrong"]
    assert outcomes[5:] == [None, "unchecked", "found"]
