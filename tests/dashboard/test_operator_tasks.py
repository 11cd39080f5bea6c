"""What operators come for, and how many clicks each takes from the list of maps."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest
from playwright.sync_api import Locator, Page, expect

Settle = Callable[[Page], None]


class Operator:
    """Someone who looks at the list of maps, and whose clicks are counted."""

    def __init__(self, page: Page, settle: Settle) -> None:
        self.page, self.settle, self.clicks = page, settle, 0

    def click(self, what: Locator) -> None:
        what.click()
        self.clicks += 1
        self.settle(self.page)

    def map(self, name: str) -> None:
        self.click(self.page.locator(f".map[data-map={name}] h2 a"))

    def tab(self, name: str) -> None:
        self.click(self.page.locator("#tabs").get_by_role("link", name=name, exact=True))


@pytest.fixture
def within(station: Any, page: Page, settle: Settle) -> Callable[[int], Any]:
    """`with within(2) as operator`: what is done there takes no more clicks."""

    @contextmanager
    def begin(most: int) -> Iterator[Operator]:
        page.goto("about:blank")
        page.goto(f"{station.home}#/")
        settle(page)
        operator = Operator(page, settle)
        yield operator
        assert operator.clicks <= most

    return begin


@pytest.fixture(scope="module")
def lost(station: Any, four_sides: dict[str, Any], until: Callable[..., Any]) -> dict[str, Any]:
    """The answer to a robot that is elsewhere; its map is measured, and has a frame with a name."""
    del four_sides
    sent = station.frames[0]
    form = sent.form()
    meta = {**json.loads(form["data"]["meta"]), "robot": "spot"}
    answer = station.client.post(
        "/v1/maps/four-sides/queries", files=form["files"], data={"meta": json.dumps(meta)}
    ).json()
    assert answer["status"] == "not_found"
    asked = {"not_within_s": 0, "every": 6}
    begun = station.client.post("/v1/maps/four-sides/coverage", json=asked).json()
    path = f"/v1/maps/four-sides/coverage/{begun['coverage_id']}"
    until(lambda: station.client.get(path).json()["state"] == "succeeded")
    station.make_map("named")
    meta |= {"name": "dock-entrance-0042.png", "session": 5 * "a-long-name-of-a-session"}
    added = station.client.post(
        "/v1/maps/named/frames", files=form["files"], data={"meta": json.dumps(meta)}
    )
    assert added.status_code == 202, added.text
    told: dict[str, Any] = answer
    return told


def test_whether_ingest_is_healthy_takes_1(within: Any, page: Page) -> None:
    with within(1) as operator:
        operator.click(page.get_by_role("link", name="Operations", exact=True))
        expect(page.locator(".health .badge").first).to_have_text("ready")


def test_why_a_query_of_a_robot_failed_takes_3(
    within: Any, page: Page, lost: dict[str, Any]
) -> None:
    with within(3) as operator:
        operator.map("four-sides")
        operator.tab("Queries")
        row = page.locator(f".queries tr[data-query='{lost['query_id']}']")
        expect(row.locator("th")).to_have_text("spot")
        operator.click(row.get_by_role("link", name="Answer"))
        verdict = page.locator(".query-verdict")
        expect(verdict).to_contain_text("Not found. Nothing like it in the map")
        expect(verdict.locator(".query-next")).to_have_text(
            "Move on and ask again, or add frames of this place to the map."
        )


def test_a_frame_is_found_by_its_name_in_2(within: Any, page: Page, lost: dict[str, Any]) -> None:
    del lost  # its fixture has named a frame
    asked: list[str] = []
    page.on("request", lambda one: "/queries" in one.url and asked.append(one.url))
    with within(2) as operator:
        operator.click(page.locator(".map[data-map=named] .map-count"))
        operator.click(page.get_by_label("Find"))
        page.keyboard.type("dock-entr")
        page.keyboard.press("Enter")
        operator.settle(page)
        expect(page.locator("#frames .tile")).to_have_count(1)
        expect(page.locator("#frames .tile-name a")).to_have_text("dock-entrance-0042")
    assert asked == []  # to look for a frame is no query


def test_the_whole_map_is_seen_after_1(within: Any, page: Page) -> None:
    with within(1) as operator:
        operator.map("building")
        expect(page.locator(".paths-run")).to_have_count(2)


def test_a_robot_that_is_lost_is_seen_after_1(
    within: Any, page: Page, lost: dict[str, Any]
) -> None:
    with within(1) as operator:
        operator.map("four-sides")
        robot = page.locator(".place-robots > li[data-robot=spot]")
        expect(robot).to_contain_text("not found", ignore_case=True)
        expect(robot.get_by_role("link", name="Not found")).to_have_attribute(
            "href", f"#/queries/{lost['query_id']}"
        )


def test_badly_covered_areas_take_2(within: Any, page: Page, lost: dict[str, Any]) -> None:
    del lost  # its fixture has measured the map
    with within(2) as operator:
        operator.map("four-sides")
        operator.tab("Coverage")
        expect(page.locator(".cover-worst li").first).to_contain_text("ambiguous")
        expect(page.locator(".cover-cell").first).to_be_visible()


def test_a_session_is_deleted_in_3(within: Any, page: Page, lost: dict[str, Any]) -> None:
    del lost  # its fixture has named the session
    name = 5 * "a-long-name-of-a-session"
    with within(3) as operator:
        operator.map("named")
        operator.tab("Sessions")
        row = page.locator("tbody tr", has_text=name)
        operator.click(row.get_by_role("button", name="Delete"))
        page.get_by_role("dialog").get_by_role("textbox").fill(name)
        page.keyboard.press("Enter")
        expect(row).to_have_count(0)
    page.locator(".toast", has_text="Deleted").get_by_role("button", name="Undo").click()
    expect(row).to_have_count(1)


def test_two_sessions_are_compared_in_3(
    within: Any, page: Page, settle: Settle, station: Any, until: Callable[..., Any]
) -> None:
    path = station.make_map("twice")
    for sent, session in zip(station.frames[:2], ("first", "second"), strict=True):
        form = sent.form()
        meta = {**sent.meta, "session": session}
        added = station.client.post(
            f"{path}/frames", files=form["files"], data={"meta": json.dumps(meta)}
        )
        assert added.status_code == 202, added.text
    until(lambda: station.client.get(path).json()["frames"].get("indexed") == 2)
    with within(3) as operator:
        page.goto(f"{station.home}#/maps/twice/sessions")
        settle(page)
        operator.click(page.get_by_role("link", name="Compare session second"))
        operator.click(page.get_by_role("button", name="Compare"))
        legend = page.get_by_role("list", name="Legend")
        expect(legend.locator("[data-kind=same]")).to_contain_text("in both")


def test_an_answer_is_kept_and_shared_in_2(
    within: Any, page: Page, settle: Settle, station: Any, lost: dict[str, Any]
) -> None:
    with within(2) as operator:
        page.goto(f"{station.home}#/queries/{lost['query_id']}")
        settle(page)
        panel = page.get_by_role("group", name="Keep this answer")
        operator.click(panel.get_by_role("button", name="Keep answer"))
        operator.click(panel.get_by_role("button", name="Copy link"))
        expect(page.locator(".toast, .query-keep input")).to_have_count(1)
    assert station.client.get(f"/v1/queries/{lost['query_id']}/keep").json()["kept"] is True


# Failed jobs and their retry are in test_operations.py.
