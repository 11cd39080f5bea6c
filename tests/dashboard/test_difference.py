"""Tests of the page that compares two sessions, against the API: a new job, counts and views."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from typing import Any

import pytest

from tests.dashboard.conftest import expect

SIDES = ("monday", "tuesday")


def filled(station: Any, until: Callable[..., Any], name: str, *, apart: bool) -> str:
    """Path of a map whose sessions are one view of a room and the next one, an hour apart.

    They share a parent frame, unless they are to be `apart`.
    """
    path = str(station.make_map(name, title=name.capitalize()))
    for i, (sent, session) in enumerate(zip(station.frames[:2], SIDES, strict=True)):
        form = sent.form()
        meta = {**sent.meta, "session": session, "captured_at": f"2026-11-20T0{i}:00:00Z"}
        if apart:
            meta["pose"] = {**meta["pose"], "parent_frame": session}
        added = station.client.post(
            f"{path}/frames", files=form["files"], data={"meta": json.dumps(meta)}
        )
        assert added.status_code == 202, added.text
    until(lambda: station.client.get(path).json()["frames"].get("indexed") == 2)
    return path


@pytest.fixture(scope="module")
def weeks(station, until):
    """See `filled`."""
    return filled(station, until, "weeks", apart=False)


@pytest.mark.thorough
def test_sessions_that_share_no_frame_are_joined_on_the_page_where_that_is_sure(
    station, until, page, settle
):
    path = filled(station, until, "astray", apart=True)
    page.allowed.append("422")
    page.goto(f"{station.home}#/maps/astray/difference")
    settle(page)
    page.get_by_role("button", name="Compare").click()
    expect(page.get_by_text("they share no parent frame")).to_be_visible()
    page.get_by_role("button", name="Join them, and compare").click()
    # one frame of each is no proof
    expect(page.get_by_role("heading", name="These sessions are not joined")).to_be_visible()
    (told,) = station.client.get(f"{path}/associations").json()["items"]
    assert (told["request"]["sessions"], told["state"]) == (["tuesday", "monday"], "succeeded")
    assert all(join["root"] is None for join in told["result"]["joins"])
    page.goto(f"{station.home}#/")
    settle(page)
    card = page.locator("[data-map=astray]")
    expect(card.get_by_role("link", name="2 frames of reference")).to_be_visible()


@pytest.mark.thorough
def test_two_sessions_are_compared_and_seen_side_by_side(station, weeks, page, settle, axe):
    page.goto(f"{station.home}#/maps/weeks/difference?before=monday&after=tuesday")
    settle(page)
    expect(page.get_by_role("heading", name="Not compared yet")).to_be_visible()
    assert station.client.get(f"{weeks}/differences").json()["items"] == []  # looking begins none
    assert axe(page) == []
    page.goto(f"{station.home}#/maps/weeks/sessions")
    settle(page)
    page.get_by_role("link", name="Compare session tuesday").click()  # which begins one
    expect(page).to_have_url(re.compile(r"difference\?before=monday&after=tuesday$"))
    legend = page.get_by_role("list", name="Legend")
    expect(legend).to_be_visible()
    settle(page)
    (told,) = station.client.get(f"{weeks}/differences").json()["items"]
    result = told["result"]
    assert result["same"] > 500
    shown = {
        "Before": ("same", "gone", "unseen_after"),
        "After": ("same", "new", "unseen_before"),
        "Difference": ("same", "gone", "new", "unseen_after", "unseen_before"),
    }
    for name, kinds in shown.items():
        button = page.get_by_role("button", name=name, exact=True)
        button.click()
        expect(button).to_have_attribute("aria-pressed", "true")
        for kind in kinds:
            expect(legend.locator(f"[data-kind={kind}]")).to_contain_text(f"{result[kind]:,} cells")
        expect(legend.locator("li")).to_have_count(len(kinds))
        drawn = """kinds => { const { viewer } = document.querySelector(".overlay-canvas");
            return kinds.filter((kind) => viewer.layer(kind)?.visible)
                .map((kind) => [kind, viewer.layer(kind).points.count]); }"""
        everything = page.evaluate(drawn, list(shown["Difference"]))
        assert dict(everything) == {kind: result[kind] for kind in kinds if result[kind]}
    assert axe(page) == []
    page.get_by_role("button", name="Before", exact=True).click()
    page.reload()
    settle(page)
    expect(page.get_by_role("button", name="Before", exact=True)).to_have_attribute(
        "aria-pressed", "true"
    )
    page.go_back()
    settle(page)
    page.get_by_role("link", name="Compare session tuesday").click()  # and only one
    expect(legend).to_be_visible()
    assert len(station.client.get(f"{weeks}/differences").json()["items"]) == 1
    page.set_viewport_size({"width": 390, "height": 844})
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    page.get_by_role("link", name="To the sessions").click()
    settle(page)
    assert page.url.endswith("#/maps/weeks/sessions")
