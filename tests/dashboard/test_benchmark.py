"""Rows of `make bench` about the dashboard: each load is a real one, and counts what came."""

from __future__ import annotations

import json
from dataclasses import asdict

import pytest

from benchmarks import dashboard
from benchmarks.rooms import fuse, multiply


@pytest.mark.thorough
def test_pages_are_timed_and_weighed(browser, station, settle, open_page, monkeypatch):
    monkeypatch.setattr(dashboard, "DRAWN", 2)
    sent = station.frames[3].form(k="2")
    found = station.client.post("/v1/maps/building/queries", **sent).json()
    match = found["matches"][-1]["frame_id"]
    overlay = f"#/queries/{found['query_id']}/matches/{match}?map=building"
    first, slow, both, drawn = dashboard.look(browser, station.url, overlay, 1)
    fuse(station.client, "building")
    places, surface = dashboard.visit(browser, station.url, "building", 1)
    multiply(station.data, "building", "large", 60)
    gallery, shown = dashboard.browse(browser, station.url, "large", 1)
    assert shown == 24
    figures = dashboard._figures(1, first, slow, both, drawn, (places, surface), 60, gallery, shown)
    assert figures.faults == 0
    assert 5_000 < figures.code <= first[0].bytes
    # every file of the first page as it is packed, but for the picture in the tab
    page = open_page()
    page.goto(station.home)
    settle(page)
    names = page.evaluate("performance.getEntriesByType('resource').map((one) => one.name)")
    packed = {"Accept-Encoding": "gzip"}
    sizes = [
        int(station.client.get(name, headers=packed).headers["content-length"])
        for name in [station.home, *(one for one in names if one.endswith(("js", "css")))]
    ]
    assert figures.code == sum(sizes)
    query, other = (
        station.client.get(
            f"/v1/queries/{found['query_id']}/matches/{match}/points",
            params={"side": side, "map": "building"},
            headers={"Accept": "application/vnd.sceneprint.points"},
        ).content
        for side in ("query", "match")
    )
    assert figures.points == sum(int.from_bytes(one[8:12], "little") for one in (query, other))
    assert figures.overlay_bytes > len(query) + len(other)
    assert figures.idle == figures.place_idle == 0
    told = station.client.get("/v1/maps/building/surface").json()["parents"][0]["levels"]
    assert figures.cells == told[0]["cells"]
    assert figures.place_bytes > sum(one["bytes"] for one in told)
    assert min(figures.first, figures.slow, figures.overlay, figures.place, figures.gallery) > 0
    assert slow[0].seconds > 0.04  # an answer does not begin earlier
    assert json.loads(json.dumps(asdict(figures))) == asdict(figures)
    text = "\n".join(dashboard.table(figures))
    assert f"| code of the first page, compressed | {figures.code / 1000:.1f} kB | 35 kB |" in text
    with pytest.raises(AssertionError, match="another canvas"):
        dashboard._figures(
            1, first, slow, both, {**drawn, "size": [1, 1]}, (places, surface), 60, gallery, shown
        )
