"""Tests of the place of a map against the API: surface, spots and robots."""

from __future__ import annotations

import io
import json
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qs, urlsplit

import numpy as np
import pytest
from PIL import Image

from tests.dashboard.conftest import expect

if TYPE_CHECKING:
    from playwright.sync_api import Page

CANVAS = ".paths-canvas"
CELL = np.dtype([("at", "u1", 3), ("seen", "u1"), ("session", "<u2"), ("taken", "<u2")])
#: Where a point of the picture's frame is on the canvas, CSS pixels.
PROJECT = """([css, p]) => { const { viewer, scene } = document.querySelector(css);
  return viewer.project(scene.near(p)); }"""


@pytest.fixture(scope="module")
def built(station, until):
    """The surface of `building`, and all of its finest cells in room-0: (N, 3) metres."""
    path = "/v1/maps/building/surface"
    begun = station.client.post(path)
    assert begun.status_code in (200, 202), begun.text
    until(lambda: station.client.get(path).json()["state"] == "ready")
    record = station.client.get(path).json()
    (parent,) = (one for one in record["parents"] if one["parent_frame"] == "room-0")
    tile_m, cells, seen = parent["levels"][0]["tile_m"], [], []
    params = {"parent": "room-0", "level": 0, "limit": 1000}
    for tile in station.client.get(f"{path}/tiles", params=params).json()["items"]:
        rows = np.frombuffer(station.client.get(f"{path}/tiles/{tile['digest']}").content, CELL)
        corner = np.array([tile["column"], tile["row"], tile["floor"]])
        cells.append((corner + (rows["at"] + 0.5) / 256) * tile_m)
        seen.append(rows["seen"])
    return {"record": record, "parent": parent, "cells": np.concatenate(cells),
            "seen": np.concatenate(seen), "path": path}  # fmt: skip


def opened(page: Page, station: Any, settle: Any, address: str, until: Any) -> None:
    """Open a place and wait until its tiles are drawn, and nothing is drawn any more."""
    page.goto(f"{station.home}{address}")
    settle(page)
    expect(page.locator("#place-surface")).to_be_visible()
    quiet(page, until)


def quiet(page: Page, until: Any) -> int:
    """Wait until a quarter of a second passes without a picture; how many were drawn in all."""
    frames = "css => document.querySelector(css).viewer.frames"
    before = -1

    def same() -> bool:
        nonlocal before
        last, before = before, page.evaluate(frames, CANVAS)
        page.wait_for_timeout(250)
        return bool(last == page.evaluate(frames, CANVAS))

    until(same)
    return int(before)


def click_at(page: Page, point: Any) -> None:
    x, y, _ = page.evaluate(PROJECT, [CANVAS, [float(v) for v in point]])
    page.locator(CANVAS).click(position={"x": x, "y": y})


def highest(built: dict[str, Any]) -> Any:
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
    asked: list[Any] = []
    page.on("request", lambda one: asked.append(urlsplit(one.url)))
    opened(page, station, settle, "#/maps/building/place?parent=room-0&heights=all", until)
    drawn = page.evaluate(
        """(css) => { const { viewer } = document.querySelector(css);
          const tiles = viewer.layer("surface").tiles;
          return tiles.map((one) => [one.cell, one.data.byteLength / 8]); }""",
        CANVAS,
    )
    assert sum(n for cell, n in drawn if cell == built["parent"]["levels"][0]["cell_m"]) == len(
        built["cells"]
    )  # a small place is drawn in its finest cells
    # and so few need no coarser ones before them
    fetched = [one.path for one in asked if "/surface/tiles/" in one.path]
    assert len(built["cells"]) < 30_000
    assert len(fetched) == len(set(fetched)) == built["parent"]["levels"][0]["tiles"]

    spot = highest(built)
    click_at(page, spot)
    section = page.locator("section", has=page.locator("#place-spot"))
    expect(section.locator("[role=status]")).to_contain_text("frame")
    settle(page)
    (sent,) = [parse_qs(one.query) for one in asked if one.path.endswith("/surface/frames")]
    assert np.array(sent["at"][0].split(","), float) == pytest.approx(spot, abs=0.06)
    told = station.client.get(
        f"{built['path']}/frames", params={name: values[0] for name, values in sent.items()}
    ).json()["items"]
    assert told
    links = section.locator(".place-frames .paths-told a:first-child")
    hrefs = links.evaluate_all("all => all.map((one) => one.getAttribute('href'))")
    assert hrefs == [f"#/maps/building/frames/{one['frame_id']}" for one in told]
    assert axe(page) == []
    before = quiet(page, until)
    page.wait_for_timeout(500)
    assert page.evaluate("css => document.querySelector(css).viewer.frames", CANVAS) == before


@pytest.mark.thorough
def test_what_is_drawn_is_in_the_address_and_reached_by_keys(page, station, built, settle, until):
    opened(page, station, settle, "#/maps/building/place?parent=room-0", until)
    for _ in range(2):  # the link past the rail, and what it leads to
        page.keyboard.press("Tab")
        if page.evaluate("document.activeElement.classList.contains('skip')"):
            page.keyboard.press("Enter")
    assert page.evaluate("document.activeElement.textContent") == "Plan"
    page.get_by_role("button", name="3-D").press("Enter")
    page.select_option("#place-colour", "seen")
    most = page.locator(".place-legend .number span").last
    known = np.sort(built["seen"])
    assert int(most.inner_text().split()[0]) <= round(2 ** (known[-1] / 16) - 1)
    page.locator("#place-high").press("ArrowLeft")
    expect(page.locator(".place-cut").locator("..")).to_contain_text("m to")
    search = parse_qs(page.url.partition("?")[2])
    assert {name: search[name] for name in ("view", "colour")} == {
        "view": ["3d"],
        "colour": ["seen"],
    }
    page.reload()
    settle(page)
    expect(page.locator("#place-colour")).to_have_value("seen")
    expect(page.get_by_role("button", name="3-D")).to_have_attribute("aria-pressed", "true")
    assert parse_qs(page.url.partition("?")[2]) == search
    page.get_by_role("button", name="Plan").click()
    quiet(page, until)
    # Enter takes what is in the middle of the picture
    page.evaluate(
        """([css, p]) => { const { viewer, scene } = document.querySelector(css);
          viewer.look({ target: scene.near(p) }); }""",
        [CANVAS, highest(built).tolist()],
    )
    quiet(page, until)
    page.locator(CANVAS).press("Enter")
    expect(page.locator("#place-spot")).to_contain_text("Frames that saw")
    page.set_viewport_size({"width": 390, "height": 844})
    assert page.evaluate("document.documentElement.scrollWidth") == 390


@pytest.mark.thorough
def test_it_is_measured_and_frames_are_boxed(page, station, built, settle, until):
    opened(page, station, settle, "#/maps/building/place?parent=room-0&heights=all", until)
    one = highest(built)
    page.get_by_role("button", name="Measure").click()
    click_at(page, one)
    # the other end is on the plan, beside the surface, at the height of the target
    page.locator(CANVAS).click(position={"x": 6, "y": 6})
    level = page.evaluate(
        """([css, p]) => { const { viewer, scene } = document.querySelector(css);
          const [x, y] = viewer.project(scene.near(p)), { orbit, canvas } = viewer;
          const size = 2 * Math.tan(Math.PI / 8) * orbit.distance / canvas.clientHeight;
          return Math.hypot(x - 6, y - 6) * size; }""",
        [CANVAS, one.tolist()],
    )
    said = page.locator(".place-said")
    expect(said).to_contain_text("level")
    text = said.inner_text()
    assert float(text.split(": ")[1].split(" m level")[0]) == pytest.approx(level, abs=0.06)
    page.get_by_role("button", name="Select frames").press("Enter")
    page.locator(".place-cover").press("Enter")  # all that is in view
    section = page.locator("section", has=page.locator("#place-spot"))
    taken = [np.array(sent.meta["pose"]["matrix"])[:3, 3] for sent in station.frames[:8]]
    expect(section.locator("[role=status]")).to_have_text("8 frames")
    # a box about some sensors, aslant to the axes of the room
    page.evaluate("css => document.querySelector(css).viewer.look({ azimuth: 0.7 })", CANVAS)
    quiet(page, until)
    at = np.array([page.evaluate(PROJECT, [CANVAS, p.tolist()])[:2] for p in taken])
    order = np.argsort(at[:, 0])
    gap = int(np.argmax(np.diff(at[order, 0])))
    low = at.min(0) - 8
    high = np.array([at[order[gap : gap + 2], 0].mean(), at[:, 1].max() + 8])
    page.get_by_role("button", name="Select frames").click()
    corner = page.locator(CANVAS).bounding_box()
    left, top = corner["x"], corner["y"]
    page.mouse.move(left + low[0], top + low[1])
    page.mouse.down()
    page.mouse.move(left + high[0], top + high[1])
    page.mouse.up()
    count = gap + 1
    expect(section.locator("[role=status]")).to_have_text(f"{count} frame{'s'[: count > 1]}")
    links = section.locator(".paths-told a:first-child")
    hrefs = links.evaluate_all("all => all.map((one) => one.getAttribute('href'))")
    assert set(hrefs) == {
        f"#/maps/building/frames/{station.frames[i].frame_id}" for i in order[:count]
    }
    with page.expect_download() as kept:
        page.get_by_role("button", name="Save picture").click()
    assert kept.value.suggested_filename.startswith("building-place-")
    picture = Image.open(io.BytesIO(kept.value.path().read_bytes())).convert("RGB")
    assert picture.size == (round(corner["width"]), round(corner["height"]))
    x, y, _ = page.evaluate(PROJECT, [CANVAS, one.tolist()])
    ground = picture.getpixel((picture.width - 3, 3))
    assert picture.getpixel((round(x), round(y))) != ground


FOLLOWED = """([css, p]) => {
  const { viewer, scene } = document.querySelector(css), { target, distance } = viewer.camera;
  return [Math.hypot(...scene.near(p).map((x, k) => x - target[k])), distance]; }"""


@pytest.fixture(scope="module")
def patrolled(station):
    """A map that two robots asked: spot was found twice, cart once, and then not any more."""
    path = station.make_map("patrolled")
    for sent in station.frames[:3]:
        form = sent.form(priority="10")
        form["data"]["meta"] = json.dumps(sent.meta)
        added = station.client.post(f"{path}/frames", headers={"Prefer": "wait=200"}, **form)
        assert added.json()["state"] == "indexed", added.text
    answers = [ask(station, who, sent) for who, sent in
               (("spot", 0), ("cart", 1), ("cart", 8), ("spot", 2))]  # fmt: skip
    assert [one["status"] for one in answers] == ["found", "found", "not_found", "found"]
    return {"path": path, "answers": answers}


def ask(station: Any, robot: str, sent: int) -> dict[str, Any]:
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
    before = station.client.get("/v1/queries", params=listed).json()["items"]
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

    def stands(kind: str, text: str, answer: dict[str, Any]) -> bool:
        at = [answer["location"]["pose"]["translation"][axis] for axis in "xyz"]
        return bool(page.evaluate(place, [CANVAS, kind, text, at]) < 1)

    until(lambda: stands("robot", "spot", last) and stands("robot", "cart", second))
    until(lambda: stands("lost", "!", second))  # where it was known to be last
    expect(page.locator(".paths-label[data-kind=lost]")).to_have_attribute(
        "href", f"#/queries/{lost['query_id']}"
    )
    assert axe(page) == []
    # back in time: cart is not lost yet, and spot stands where it was before
    slider = page.locator("#place-time")
    for _ in range(2):
        slider.press("ArrowLeft")
    expect(page.locator(".place-when")).to_contain_text("query 2 of 4")
    until(lambda: stands("robot", "spot", first))
    expect(page.locator(".paths-label[data-kind=lost]")).to_have_count(0)
    told = parse_qs(page.url.partition("?")[2])["at"]
    assert told == [next(one["at"] for one in before if one["query_id"] == second["query_id"])]
    page.reload()
    settle(page)
    expect(page.locator(".place-when")).to_contain_text("query 2 of 4")
    page.get_by_role("button", name="Play").click()
    expect(page.locator(".place-when")).to_contain_text("query 4 of 4")
    expect(page.get_by_role("button", name="Play")).to_be_visible()
    page.goto(f"{station.home}#/maps/patrolled/place?until={before[0]['at']}")
    expect(page.locator(".place-when")).to_contain_text("query 3 of 3")
    page.goto(f"{station.home}#/maps/patrolled/place")
    settle(page)
    assert station.client.get("/v1/queries", params=listed).json()["items"] == before

    def followed(answer: dict[str, Any]) -> list[float]:
        """Return the robot's offset from the middle of the picture, and its distance."""
        at = [answer["location"]["pose"]["translation"][axis] for axis in "xyz"]
        off, far = page.evaluate(FOLLOWED, [CANVAS, at])
        return [round(off, 6), far]

    follow = page.get_by_role("button", name="Follow cart")
    follow.click()
    expect(follow).to_have_attribute("aria-pressed", "true")
    assert followed(second)[0] == 0
    page.locator(CANVAS).press("+")
    _, near = followed(second)
    # a query that is answered meanwhile moves its robot, and the camera with it
    moved = ask(station, "cart", 0)
    until(lambda: stands("robot", "cart", moved))
    expect(rows.first).to_contain_text("cart")
    assert followed(moved) == [0, near]
    follow.press("Enter")  # and no longer
    expect(follow).to_have_attribute("aria-pressed", "false")
    left = ask(station, "cart", 2)
    until(lambda: stands("robot", "cart", left))
    assert followed(moved) == [0, near]


@pytest.mark.thorough
def test_a_query_between_the_list_and_the_events_moves_its_robot_too(
    page, station, patrolled, settle, until
):
    held: list[Any] = []

    def hold(route: Any) -> None:
        if route.request.headers.get("accept") == "text/event-stream":
            held.append(route)
        else:
            route.continue_()

    def heard() -> bool:
        page.wait_for_timeout(20)  # requests are handled while the page is waited for
        return bool(held)

    page.route("**/v1/events*", hold)
    page.goto(f"{station.home}#/maps/patrolled/place")
    settle(page)
    until(heard)
    rows = page.locator(".place-robots > li")
    assert "late" not in rows.evaluate_all("all => all.map((one) => one.dataset.robot)")
    moved = ask(station, "late", 0)

    def listed() -> bool:
        found = station.client.get("/v1/queries", params={"map": "patrolled"}).json()["items"]
        return any(one["query_id"] == moved["query_id"] for one in found)

    until(listed)
    held.pop().continue_()
    expect(rows.first).to_contain_text("late", timeout=60_000)


@pytest.mark.thorough
def test_what_is_missing_is_told(page, open_page, station, built, settle, until):
    path = station.make_map("poseless")
    station.client.post(f"{path}/frames", **station.frames[0].form())
    until(lambda: station.client.get(path).json()["frames"].get("indexed") == 1)
    page.goto(f"{station.home}#/maps/poseless/place")
    expect(page.get_by_role("heading", name="This map has no poses")).to_be_visible()
    expect(page.get_by_role("link", name="Show its frames")).to_have_attribute(
        "href", "#/maps/poseless"
    )
    # frames with poses, and no surface yet: it is asked for here, and comes
    form = station.frames[1].form()
    form["data"]["meta"] = json.dumps({**station.frames[1].meta, "session": None})
    station.client.post(f"{path}/frames", **form)
    until(lambda: station.client.get(path).json()["frames"].get("indexed") == 2)
    page.reload()
    expect(page.locator(".place-notice")).to_contain_text("surface of 1 frame is not built")
    page.get_by_role("button", name="Build it now").click()
    expect(page.locator("#place-surface")).to_be_visible(timeout=60_000)
    expect(page.locator(".place-notice")).to_be_hidden()
    expect(page.locator("section", has=page.locator("#place-surface"))).to_contain_text("1 frame, ")

    blind = open_page()
    blind.add_init_script(
        """const get = HTMLCanvasElement.prototype.getContext;
        HTMLCanvasElement.prototype.getContext = function (kind, ...rest) {
          return kind === "webgl2" ? null : get.call(this, kind, ...rest); };"""
    )
    blind.goto(f"{station.home}#/maps/building/place?parent=room-0")
    settle(blind)
    shown = blind.get_by_role("img", name="The place in room-0, seen from above")
    assert shown.evaluate("one => one.ready") is True
    plan = built["parent"]["plan"]
    assert shown.evaluate("one => [one.width, one.height]") == [plan["width"], plan["height"]]
    expect(blind.locator(".paths-run")).to_have_count(2)


def test_detail_by_value(run):
    """Which tiles are drawn, of a pyramid by hand; and where robots are, of records by hand."""
    levels = [
        {"level": 0, "cell_m": 1, "tile_m": 64, "cells": 30_001},  # too many to do without others
        {"level": 1, "cell_m": 4, "tile_m": 256, "cells": 55},
    ]

    def tile(column: int, row: int, cells: int) -> dict[str, Any]:
        return {
            "column": column,
            "row": row,
            "floor": 0,
            "cells": cells,
            "digest": f"{column} {row}",
        }

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
    told = run("place/robots", """m.robotsOf(given[0]).map((one) => [one.name, one.last.query_id,
        one.found?.query_id ?? null, one.trail.map((each) => each.query_id),
        one.lost.map((each) => [each.record.query_id, each.near?.query_id ?? null])])""",
        records)  # fmt: skip
    assert told == [
        ["spot", 6, 1, [], [[0, None], [3, 1], [6, 1]]],
        ["cart", 5, 5, [2], []],
        ["not named", 4, None, [], []],
    ]  # fmt: skip
    # a ceiling over three of four columns; and walls, which reach up in one of four
    hall = [[0, 3], [0.2, 3], [0, 3], [0, 0]]
    assert run("place/surface", "m.ceiling(given[0], [0, 3])", hall) == [-1e9, pytest.approx(2.1)]
    walls = [[0, 3], [0, 0], [1, 1], [3, 3]]
    assert run("place/surface", "m.ceiling(given[0], [0, 3])", walls) is None
