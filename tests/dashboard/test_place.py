"""Tests of the place of a map against the API: surface, spots and robots."""

import json
from urllib.parse import parse_qs, urlsplit

import numpy as np
import pytest

from tests.dashboard.conftest import click_at, expect

CANVAS = ".paths-canvas"
CELL = np.dtype([("at", "u1", 3), ("seen", "u1"), ("session", "<u2"), ("taken", "<u2")])


@pytest.fixture(scope="module")
def built(station, until):
    """The surface of `building`, and all of its finest cells in room-0: (N, 3) metres."""
    path = "/v1/maps/building/surface"
    begun = station.client.post(path)
    assert begun.status_code in (200, 202), begun.text
    until(lambda: station.client.get(path).json()["state"] == "ready")
    record = station.client.get(path).json()
    (parent,) = (parent for parent in record["parents"] if parent["parent_frame"] == "room-0")
    tile_m, cells, seen = parent["levels"][0]["tile_m"], [], []
    params = {"parent": "room-0", "level": 0, "limit": 1000}
    for tile in station.client.get(f"{path}/tiles", params=params).json()["items"]:
        rows = np.frombuffer(station.client.get(f"{path}/tiles/{tile['digest']}").content, CELL)
        corner = np.array([tile["column"], tile["row"], tile["floor"]])
        cells.append((corner + (rows["at"] + 0.5) / 256) * tile_m)
        seen.append(rows["seen"])
    return {"record": record, "parent": parent, "cells": np.concatenate(cells),
            "seen": np.concatenate(seen), "path": path}  # fmt: skip


def opened(page, station, settle, address, until):
    """Open a place and wait until its tiles are drawn, and nothing is drawn any more."""
    page.goto(f"{station.home}{address}")
    settle(page)
    expect(page.locator("#place-surface")).to_be_visible()
    quiet(page, until)


def quiet(page, until):
    """Wait until a quarter of a second passes without a picture; how many were drawn in all."""
    frames = "css => document.querySelector(css).viewer.frames"
    before = -1

    def same():
        nonlocal before
        last, before = before, page.evaluate(frames, CANVAS)
        page.wait_for_timeout(250)
        return bool(last == page.evaluate(frames, CANVAS))

    until(same)
    return int(before)


def highest(built):
    """The cell nearest to the middle of the canvas that no other hides in a plan."""
    up = np.array([built["parent"]["up"][k] for k in "xyz"])
    axes = np.array([built["parent"]["x_axis"], built["parent"]["y_axis"]])
    flat, height = built["cells"] @ axes.T, built["cells"] @ up
    free = [
        i for i, p in enumerate(flat)
        if (height[(np.abs(flat - p) < 0.3).all(1)] <= height[i] + 0.02).all()
    ]  # fmt: skip
    middle = (flat.min(0) + flat.max(0)) / 2
    return built["cells"][min(free, key=lambda i: float(np.linalg.norm(flat[i] - middle)))]


@pytest.mark.thorough
def test_a_spot_names_the_frames_that_saw_it(page, station, built, settle, axe, until):
    urls = []
    page.on("request", lambda one: urls.append(urlsplit(one.url)))
    opened(page, station, settle, "#/maps/building/place?parent=room-0&heights=all", until)
    spot = highest(built)
    click_at(page, spot)
    section = page.locator("section", has=page.locator("#place-spot"))
    expect(section.locator("[role=status]")).to_contain_text("frame")
    settle(page)
    (sent,) = [parse_qs(url.query) for url in urls if url.path.endswith("/surface/frames")]
    assert np.array(sent["at"][0].split(","), float) == pytest.approx(spot, abs=0.06)
    frames = station.client.get(
        f"{built['path']}/frames", params={name: values[0] for name, values in sent.items()}
    ).json()["items"]
    assert frames
    links = section.locator(".place-frames .paths-told a:first-child")
    hrefs = links.evaluate_all("all => all.map((one) => one.getAttribute('href'))")
    assert hrefs == [f"#/maps/building/frames/{frame['frame_id']}" for frame in frames]
    assert axe(page) == []


@pytest.fixture(scope="module")
def patrolled(station):
    """Send queries of two robots: spot is found twice, cart once and then not found."""
    path = station.make_map("patrolled")
    for sent in station.frames[:3]:
        form = sent.form(priority="10")
        form["data"]["meta"] = json.dumps(sent.meta)
        added = station.client.post(f"{path}/frames", headers={"Prefer": "wait=200"}, **form)
        assert added.json()["state"] == "indexed", added.text
    answers = [ask(station, robot, sent) for robot, sent in
               (("spot", 0), ("cart", 1), ("cart", 8), ("spot", 2))]  # fmt: skip
    assert [answer["status"] for answer in answers] == ["found", "found", "not_found", "found"]
    return {"path": path, "answers": answers}


def ask(station, robot, sent):
    form = station.frames[sent].form()
    meta = json.loads(form["data"]["meta"]) | {"robot": robot, "session": "patrol"}
    form["data"]["meta"] = json.dumps(meta)
    answer = station.client.post("/v1/maps/patrolled/queries", **form)
    assert answer.status_code == 200, answer.text
    return dict(answer.json())


@pytest.mark.thorough
def test_robots_stand_where_their_queries_found_them(page, station, patrolled, settle, axe, until):
    listed = {"map": "patrolled", "limit": 100}
    until(lambda: len(station.client.get("/v1/queries", params=listed).json()["items"]) == 4)
    page.goto(f"{station.home}#/maps/patrolled/place")
    settle(page)
    rows = page.locator(".place-robots > li")
    expect(rows).to_have_count(2)
    assert rows.evaluate_all("all => all.map((one) => one.dataset.robot)") == ["spot", "cart"]
    first, second, lost, last = patrolled["answers"]
    expect(rows.nth(1).locator(".badge")).to_have_text("Not found")
    expect(rows.nth(1).get_by_role("link", name="Not found")).to_have_attribute(
        "href", f"#/queries/{lost['query_id']}"
    )
    place = """([css, kind, text, p]) => {
      const { viewer, scene } = document.querySelector(css);
      const label = [...document.querySelectorAll(`.paths-label[data-kind=${kind}]`)].find((one) =>
        one.textContent === text);
      if (!label) return Infinity;
      const [x, y] = viewer.project(scene.near(p));
      const [left, top] = label.style.transform.match(/[-0-9.]+(?=px)/g).map(Number);
      return Math.hypot(left - x, top - y); }"""

    def stands(kind, text, answer):
        at = [answer["location"]["pose"]["translation"][axis] for axis in "xyz"]
        return bool(page.evaluate(place, [CANVAS, kind, text, at]) < 1)

    until(lambda: stands("robot", "spot", last) and stands("robot", "cart", second))
    until(lambda: stands("lost", "!", second))  # where it was known to be last
    expect(page.locator(".paths-label[data-kind=lost]")).to_have_attribute(
        "href", f"#/queries/{lost['query_id']}"
    )
    assert axe(page) == []
    # a query that is answered meanwhile moves its robot
    moved = ask(station, "cart", 0)
    until(lambda: stands("robot", "cart", moved))
    # back in time: cart is not lost yet, and spot stands where it was before
    slider = page.locator("#place-time")
    for _ in range(3):
        slider.press("ArrowLeft")
    expect(page.locator(".place-when")).to_contain_text("query 2 of 5")
    until(lambda: stands("robot", "spot", first))
    expect(page.locator(".paths-label[data-kind=lost]")).to_have_count(0)


def test_detail_by_value(run):
    """Which tiles are drawn, of a pyramid by hand; and where robots are, of records by hand."""
    levels = [
        {"level": 0, "cell_m": 1, "tile_m": 64, "cells": 30_001},  # too many to do without others
        {"level": 1, "cell_m": 4, "tile_m": 256, "cells": 55},
    ]

    def tile(column, row, cells):
        named = {"column": column, "row": row, "floor": 0, "cells": cells}
        return {**named, "digest": f"{column} {row}"}

    fine = [
        tile(0, 0, 100), tile(2, 2, 900), tile(3, 3, 100), tile(-1, 0, 50), tile(4, 0, 500)
    ]  # fmt: skip
    coarse = [tile(0, 0, 20), tile(-1, 0, 5), tile(1, 0, 30)]
    script = """(() => {
      const p = new m.Pyramid("a", given[0]);
      p.list(1, given[2]); if (given[1]) p.list(0, given[1]);
      const size = (one) => ({ "0 0": 9, "-1 0": 7, "1 0": 8, "2 2": 0 })[one.digest] ?? 1;
      const parts = (one) => p.parts(one);
      const found = m.refine(p.roots, { parts, size, budget: given[3], least: 2 });
      const cover = m.cover(p.roots, { refined: found.refined, parts,
        isSeen: (one) => size(one) > 0,
        there: (one) => one.level === 1 || !given[4].includes(one.digest) });
      const names = (all) => all.map((one) => `${one.level}:${one.digest}`);
      return [names([...found.refined]), found.cells, [...found.coarse], names(cover.drawn),
        names(cover.missing)];
    })()"""
    # all but the largest fits: the one at 1 0 would take 500. What is not in view is not counted,
    # and drawn if it is there
    assert run("place/detail", script, levels, fine, coarse, 400, ["2 2"]) == [
        ["1:0 0", "1:-1 0"], 280, [], ["0:0 0", "0:3 3", "0:-1 0", "1:1 0"], []
    ]  # fmt: skip
    # one of its parts is on its way: the coarse tile stays until then
    assert run("place/detail", script, levels, fine, coarse, 400, ["2 2", "3 3"])[3:] == [
        ["1:0 0", "0:-1 0", "1:1 0"], ["0:3 3"]
    ]  # fmt: skip
    # the finer level is not listed yet
    assert run("place/detail", script, levels, None, coarse, 400, [])[:3] == [[], 55, [1]]
    pose = {"parent_frame": "a", "translation": {"x": 1, "y": 2, "z": 3}}
    records = [
        {"robot": robot, "key": None, "status": status, "pose": pose if status == "found" else None,
         "query_id": i}
        for i, (robot, status) in enumerate([
            ("spot", "not_found"), ("spot", "found"), ("cart", "found"), ("spot", "ambiguous"),
            (None, "unvalidated"), ("cart", "found"), ("spot", "failed"),
        ])
    ]  # fmt: skip
    result = run("place/robots", """m.robotsOf(given[0]).map((one) => [one.name, one.last.query_id,
        one.found?.query_id ?? null, one.trail.map((each) => each.query_id),
        one.lost.map((each) => [each.record.query_id, each.near?.query_id ?? null])])""",
        records)  # fmt: skip
    assert result == [
        ["spot", 6, 1, [], [[0, None], [3, 1], [6, 1]]],
        ["cart", 5, 5, [2], []],
        ["not named", 4, None, [], []],
    ]  # fmt: skip
    # a ceiling over three of four columns; and walls, which reach up in one of four
    hall = [[0, 3], [0.2, 3], [0, 3], [0, 0]]
    assert run("place/surface", "m.ceiling(given[0], [0, 3])", hall) == [-1e9, pytest.approx(2.1)]
    walls = [[0, 3], [0, 0], [1, 1], [3, 3]]
    assert run("place/surface", "m.ceiling(given[0], [0, 3])", walls) is None
