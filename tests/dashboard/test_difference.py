"""Tests of the page that compares two sessions, against the API: a new job, counts and views."""

import json
import re

import pytest

from tests.dashboard.conftest import expect


@pytest.fixture(scope="module")
def weeks(station, until):
    """Path of a map whose sessions are one view of a room and the next one, an hour apart."""
    path = station.make_map("weeks", title="Weeks")
    for i, (sent, session) in enumerate(zip(station.frames, ("monday", "tuesday"), strict=False)):
        meta = {**sent.meta, "session": session, "captured_at": f"2026-11-20T0{i}:00:00Z"}
        form = {"files": sent.form()["files"], "data": {"meta": json.dumps(meta)}}
        added = station.client.post(f"{path}/frames", **form)
        assert added.status_code == 202, added.text
    until(lambda: station.client.get(path).json()["frames"].get("indexed") == 2)
    return path


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
    (difference,) = station.client.get(f"{weeks}/differences").json()["items"]
    result = difference["result"]
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
    page.set_viewport_size({"width": 390, "height": 844})
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
