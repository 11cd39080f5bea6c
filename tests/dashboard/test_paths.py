"""Tests of paths in the place against the API: joins, edges, a query and permissions."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qs, urlsplit

import numpy as np
import pytest

from sceneprint.formats.dataset import write_depth_png
from tests.dashboard.conftest import expect

if TYPE_CHECKING:
    from playwright.sync_api import Page

#: bob's odometry begins elsewhere, and turned.
_A = np.deg2rad(40)
B_FROM_A = np.array([
    [np.cos(_A), -np.sin(_A), 0, 4], [np.sin(_A), np.cos(_A), 0, -2], [0, 0, 1, 0.5], [0, 0, 0, 1]
])  # fmt: skip
CANVAS = ".paths-canvas"


@pytest.fixture(scope="module")
def apart(station, until):
    """A map of one room by two runs with a frame of reference each, and one run without poses."""
    path = station.make_map("apart")
    metas, files = [], []
    for i, sent in enumerate([*station.frames[:8], station.frames[8]]):
        who = "carol" if i == 8 else "bob" if i % 2 else "ann"
        meta = {**sent.meta, "session": who, "robot": None}
        if who == "carol":
            del meta["pose"]
        else:
            pose = np.array(sent.meta["pose"]["matrix"])
            moved = B_FROM_A @ pose if who == "bob" else pose
            meta["pose"] = {"parent_frame": f"{who}/odom", "matrix": moved.tolist()}
        metas.append(meta)
        files.append(("frame", (f"{i}.png", sent.png, "image/png")))
    answer = station.client.post(
        f"{path}/frames/batch", data={"metas": json.dumps(metas)}, files=files
    )
    assert answer.status_code == 200, answer.text
    until(lambda: station.client.get(path).json()["frames"].get("indexed") == 9)
    ids = [item["frame"]["frame_id"] for item in answer.json()["items"]]
    poses = [np.array(meta["pose"]["matrix"]) if "pose" in meta else None for meta in metas]
    return {"path": path, "ids": ids, "poses": poses, "url": f"{station.home}#/maps/apart/place"}


def click_at(page: Page, point: Any) -> None:
    """Click where a point of the picture's frame is drawn."""
    project = """([css, p]) => {
      const { viewer, scene } = document.querySelector(css);
      return viewer.project(scene.near(p)); }"""
    x, y, _ = page.evaluate(project, [CANVAS, [float(v) for v in point]])
    page.locator(CANVAS).click(position={"x": x, "y": y})


@pytest.mark.thorough
def test_runs_are_joined_from_here(page, apart, station, settle):
    """Before and after: what nothing joins is told, and then drawn where the join says."""
    asked = []
    page.on("request", lambda one: asked.append(urlsplit(one.url)))
    page.goto(apart["url"])
    settle(page)
    expect(page.locator(".paths-run")).to_have_text(["1ann4 poses"])
    expect(page.locator(".paths-left li")).to_have_text([
        "carol · 1 frame: no poses",
        "bob · 4 frames: poses in bob/odom, which no association joins to ann/odom",
    ])  # fmt: skip
    (thinned,) = [parse_qs(one.query) for one in asked if one.path.endswith("/trajectory")]
    assert int(thinned["most"][0]) <= 2000  # however many there are
    lists = [parse_qs(one.query) for one in asked if one.path.endswith("/frames")]
    assert [one["limit"] for one in lists] == [["1"]]

    page.get_by_role("button", name="New association…").click()
    dialog = page.get_by_role("dialog")
    expect(dialog.get_by_label("Query the frames of")).to_have_value("0")
    dialog.get_by_role("button", name="Start").click()
    expect(page.locator(".paths-run")).to_have_text(["1ann4 poses", "2bob4 poses"])
    settle(page)
    (one,) = station.client.get(f"{apart['path']}/associations").json()["items"]
    result = one["result"]
    kinds = [f"{kind}{result[kind]}" for kind in ("consistent", "unchecked", "inconsistent")]
    expect(page.locator(".paths-kinds li")).to_have_text(kinds)
    (join,) = result["joins"]
    expect(page.locator(".paths-joins li")).to_contain_text(
        f"{join['support']} of {join['votes']} edges agree"
    )
    expect(page.locator("#paths-association")).to_have_value(one["job_id"])
    assert f"association={one['job_id']}" in page.url

    # bob's third frame, by the API's own transform, about the first pose that is drawn
    b_from_a = np.array(join["transform"]["matrix"])
    assert (join["from_parent"], join["to_parent"]) == ("ann/odom", "bob/odom")
    at = (np.linalg.inv(b_from_a) @ apart["poses"][5])[:3, 3]
    assert np.linalg.norm(at - apart["poses"][5][:3, 3]) > 1  # it is moved
    click_at(page, at)
    frame = page.locator(".paths-told a.mono")
    expect(frame).to_have_attribute("href", f"#/maps/apart/frames/{apart['ids'][5]}")
    expect(page.locator("#paths-run")).to_have_value("1")
    expect(page.locator("#paths-along")).to_have_value("2")

    # with the keyboard: the next one, which is the last
    page.locator("#paths-along").press("ArrowRight")
    expect(frame).to_have_attribute("href", f"#/maps/apart/frames/{apart['ids'][7]}")
    expect(page.locator(".paths-told")).to_contain_text(
        ", ".join(f"{v:.2f}" for v in apart["poses"][7][:3, 3]) + " m in bob/odom"
    )
    page.locator("#paths-joined").uncheck()
    expect(page.locator(".paths-run")).to_have_text(["1ann4 poses"])
    page.locator("#paths-parent").select_option("bob/odom")
    expect(page.locator(".paths-run")).to_have_text(["1bob4 poses"])
    assert "parent=bob%2Fodom&joined=no" in page.url
    page.reload()
    settle(page)
    expect(page.locator(".paths-run")).to_have_text(["1bob4 poses"])


@pytest.mark.thorough
def test_a_join_is_undone_from_here(page, station, settle, until, room_views, tmp_path):
    path, metas, files = station.make_map("alike"), [], []
    for i, frame in enumerate(room_views(21, 0, 160, along_path=True, step=8).frames):
        write_depth_png(tmp_path / "frame.png", frame.depth, 1000.0)
        who = "bob" if i % 2 else "ann"
        pose = B_FROM_A @ frame.pose if i % 2 else frame.pose
        sent = {"parent_frame": f"{who}/odom", "matrix": pose.tolist()}
        camera = station.frames[0].meta["intrinsics"]
        metas.append({"intrinsics": camera, "session": who, "pose": sent})
        files.append(("frame", (f"{i}.png", (tmp_path / "frame.png").read_bytes(), "image/png")))
    answer = station.client.post(
        f"{path}/frames/batch", data={"metas": json.dumps(metas)}, files=files
    )
    assert answer.status_code == 200, answer.text
    until(lambda: station.client.get(path).json()["frames"].get("indexed") == len(files))
    begun = station.client.post(f"{path}/associations", json={"sessions": ["bob", "ann"]})
    job = begun.headers["location"]
    until(lambda: station.client.get(job).json()["state"] == "succeeded")
    assert station.client.get(path).json()["parent_frames"] == 1
    page.goto(f"{station.home}#/maps/alike/place")
    settle(page)
    name = station.client.get(job).json()["job_id"]
    page.locator("#paths-association").select_option(name)
    root = station.client.get(job).json()["result"]["joins"][0]["root"]
    expect(page.locator(".paths-joins li")).to_contain_text(f"All poses are in {root} now")
    page.get_by_role("button", name="Undo join").click()
    page.get_by_role("dialog").get_by_role("button", name="Undo join").click()
    expect(page.locator(".paths-left li")).to_have_count(1)  # bob's run, which nothing joins
    expect(page.locator(".paths-joins .badge")).to_have_text("undone")
    expect(page.get_by_role("button", name="Undo join")).to_have_count(0)
    assert station.client.get(path).json()["parent_frames"] == 2


@pytest.mark.thorough
def test_a_query_is_among_them(page, station, settle, axe, until):
    sent = station.frames[3]
    answer = station.client.post("/v1/maps/building/queries", **sent.form(k=3)).json()
    location = answer["location"]
    assert answer["status"] == "found"
    page.goto(f"{station.home}#/maps/building/place?view=3d&query={answer['query_id']}")
    settle(page)
    expect(page.locator("#paths-parent")).to_have_value("room-0")
    expect(page.locator(".paths-run")).to_have_count(2)
    card = page.locator("section", has=page.locator("#paths-asked"))
    expect(card).to_contain_text(f"{location['support']} of {location['votes']} accepted matches")
    covariance = np.array(location["uncertainty"]["covariance"]).reshape(6, 6)[:3, :3]
    axes = np.sqrt(np.linalg.eigvalsh(covariance)[::-1] * 7.8147)  # 95 % in three dimensions
    told = [
        f"{1000 * x:.1f} mm" if x < 0.01 else f"{1000 * x:.0f} mm" if x < 0.1 else f"{x:.2f} m"
        for x in axes
    ]
    expect(card).to_contain_text("± " + " × ".join(told))
    accepted = [m for m in answer["matches"] if m["validation"]["status"] == "accepted"]
    expect(card).to_contain_text(f"{len(accepted)} of {len(accepted)} accepted matches")
    # the label stands where the API says that the query is
    place = [location["pose"]["translation"][axis] for axis in "xyz"]
    where = """([css, p]) => {
      const { viewer, scene } = document.querySelector(css);
      const [x, y] = viewer.project(scene.near(p));
      const label = document.querySelector('.paths-label[data-kind=query]');
      const [left, top] = label.style.transform.match(/[-0-9.]+(?=px)/g).map(Number);
      return Math.hypot(left - x, top - y);
    }"""
    until(lambda: page.evaluate(where, [CANVAS, place]) < 1)
    # a run that is switched off is not there to be clicked
    first = np.array(station.frames[0].meta["pose"]["matrix"])[:3, 3]
    click_at(page, first)
    frame = page.locator(".paths-told a.mono")
    expect(frame).to_have_attribute("title", station.frames[0].frame_id)
    page.get_by_role("button", name="Done").click()
    page.locator(".paths-run input").first.uncheck()
    expect(page.locator(".paths-labels .paths-label").first).to_be_hidden()
    click_at(page, first)
    page.wait_for_timeout(100)
    titles = frame.evaluate_all("all => all.map((one) => one.title)")
    assert station.frames[0].frame_id not in titles
    page.locator(".paths-words summary").click()
    expect(page.locator(".paths-words tbody tr")).to_have_count(2)
    assert axe(page) == []
    # nothing moves, and nothing is drawn
    drawn = page.evaluate("css => document.querySelector(css).viewer.frames", CANVAS)
    page.wait_for_timeout(300)
    assert page.evaluate("css => document.querySelector(css).viewer.frames", CANVAS) == drawn


@pytest.mark.thorough
def test_alternatives_are_drawn_alike_and_none_as_the_answer(
    page, station, four_sides, settle, axe, until
):
    several = four_sides["alternatives"]
    page.goto(f"{station.home}#/maps/four-sides/place?query={four_sides['query_id']}")
    settle(page)
    card = page.locator("section", has=page.locator("#paths-asked"))
    expect(card.locator(".badge")).to_have_text("Ambiguous")
    expect(card.locator(".alternatives li")).to_have_count(len(several))
    expect(card).to_contain_text("Do not act on any of these poses")
    voting = [m for m in four_sides["matches"] if m["validation"]["status"] != "rejected"]
    expect(card).to_contain_text(f"{len(voting)} of {len(voting)} matches have a position here")
    layers = "css => ['query', 'ellipsoid', 'alternatives'].map("
    layers += "(id) => document.querySelector(css).viewer.has(id))"
    assert page.evaluate(layers, CANVAS) == [False, False, True]
    labels = page.locator(".paths-labels .paths-label[data-kind=alternative]")
    assert labels.all_inner_texts() == list("ABCDE"[: len(several)])
    expect(page.locator(".paths-label[data-kind=query]")).to_have_count(0)
    where = """([css, places]) => {
      const { viewer, scene } = document.querySelector(css);
      const labels = [...document.querySelectorAll('.paths-label[data-kind=alternative]')];
      return Math.max(...places.map((p, i) => {
        const [x, y] = viewer.project(scene.near(p));
        const [left, top] = labels[i].style.transform.match(/[-0-9.]+(?=px)/g).map(Number);
        return Math.hypot(left - x, top - y);
      }));
    }"""
    places = [[one["pose"]["translation"][axis] for axis in "xyz"] for one in several]
    until(lambda: page.evaluate(where, [CANVAS, places]) < 1)
    assert axe(page) == []
    page.get_by_role("button", name="Hide it").click()
    expect(labels).to_have_count(0)


@pytest.mark.thorough
def test_what_is_not_there_is_told(page, open_page, station, settle):
    station.make_map("pathless")
    page.goto(f"{station.home}#/maps/pathless/place")
    settle(page)
    expect(page.get_by_role("heading", name="This map is empty")).to_be_visible()
    page.allowed.append("404")
    page.goto(f"{station.home}#/maps/building/place?query={'0' * 32}")
    expect(page.get_by_text("Its answer has expired")).to_be_visible()
    expect(page.locator(".paths-run")).to_have_count(2)

    # as through a proxy, with a key that may not write
    reader = station.key("paths-reader", {"building": "read"})
    far = open_page(extra_http_headers={"X-Forwarded-For": "192.0.2.7"})
    far.add_init_script(f"sessionStorage.setItem('sceneprint.key', {json.dumps(reader)})")
    far.goto(f"{station.home}#/maps/building/place")
    settle(far)
    expect(far.locator(".paths-run")).to_have_count(2)
    expect(far.get_by_text("need a key with write access")).to_be_visible()
    expect(far.get_by_role("button", name="New association…")).to_have_count(0)


def test_numbers_behind_the_picture(run):
    """What is computed for the picture, against values by hand and NumPy."""
    assert run("paths/shapes", "[0.07, 0.1, 1, 1.2, 3, 6, 51].map(m.nice)") == pytest.approx(
        [0.1, 0.1, 1, 2, 5, 10, 100]
    )
    evenly = "[m.evenly(5, 9), m.evenly(11, 3), m.evenly(4, 1), m.evenly(0, 5)]"
    assert run("paths/shapes", evenly) == [
        [0, 1, 2, 3, 4], [0, 5, 10], [0], []
    ]  # fmt: skip
    way = [[x, 0, 0] for x in (0, 1, 2, 2.1, 5, 5.5)]
    assert run("paths/shapes", "[m.spaced(given[0], 2, 9), m.spaced(given[0], 2, 2)]", way) == [
        [0, 2, 4, 5], [0, 5]
    ]  # fmt: skip
    rng = np.random.default_rng(3)
    for scale in (1.0, 1e-4):
        root = rng.normal(size=(3, 3)) * scale
        covariance = root @ root.T
        found = run("paths/shapes", "m.axesOf(given[0])", covariance.tolist())
        values, vectors = np.linalg.eigh(covariance)
        for one, value, vector in zip(found, values[::-1], vectors.T[::-1], strict=True):
            assert one["deviation"] == pytest.approx(np.sqrt(value), rel=1e-6)
            assert abs(np.dot(one["axis"], vector)) == pytest.approx(1, abs=1e-6)
    # two dashes of 1 with gaps of 0.5 along 3 m; a long one has no more than `most`
    dashed = run("paths/shapes", "Array.from(m.dashes([[[0,0,0],[3,0,0]]], 1, 0.5))")
    assert dashed == [0, 0, 0, 1, 0, 0, 1.5, 0, 0, 2.5, 0, 0]
    assert run("paths/shapes", "m.dashes([[[0,0,0],[900,0,0]]], 1, 0.5, 10).length") == 60
    # each line broken, however short: dashes of 1, or of half a short line
    broken = run("paths/shapes", "Array.from(m.hollow(new Float32Array(given[0]), 1))",
                 [0, 0, 0, 3, 0, 0, 0, 0, 0, 0, 1, 0])  # fmt: skip
    assert broken == [0, 0, 0, 1, 0, 0, 2, 0, 0, 3, 0, 0, 0, 0, 0, 0, 0.5, 0]
    # cameras look level along x: their down is the map's -z; a camera's own axes: down is y
    level = [0, -1, 0, 0, 0, 0, -1, 0, 1, 0, 0, 0, 5, 5, 5, 1]
    itself = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
    for matrix, is_cloud, up in (
        (level, False, [0, 0, 1]), (itself, False, [0, -1, 0]), (itself, True, [0, 0, 1])
    ):  # fmt: skip
        runs = [{"poses": [matrix], "isCloud": is_cloud}]
        assert run("plan/axes", "m.uprightOf(given[0])", runs) == up
    level = {"right": [1, 0, 0], "ahead": [0, 1, 0], "above": [0, 0, 1]}
    grid = run("paths/shapes", "m.grid(given[0], given[1], 0, [10, 20, 1])",
               {"low": [0, 0, 0], "high": [10, 4, 1]}, level)  # fmt: skip
    lines = np.array(grid["positions"]).reshape(-1, 3) + np.array([10, 20, 1])
    assert grid["step"] == 1
    assert set(lines[:, 2]) == {0}
    assert (np.abs(lines[:, :2] - np.round(lines[:, :2])) < 1e-5).all()  # at whole metres
    assert (lines.min(0)[:2] <= [10, 20]).all()
    assert (lines.max(0)[:2] >= [20, 24]).all()
    # the same ground where z is ahead and up is -y: turned, at 2 m below the origin
    turned = {"right": [1, 0, 0], "ahead": [0, 0, 1], "above": [0, -1, 0]}
    grid = run("paths/shapes", "m.grid(given[0], given[1], -2, [10, 1, 20])",
               {"low": [0, 0, 0], "high": [10, 1, 4]}, turned)  # fmt: skip
    lines = np.array(grid["positions"]).reshape(-1, 3) + np.array([10, 1, 20])
    assert set(lines[:, 1]) == {2}
    assert (lines.max(0)[[0, 2]] >= [20, 24]).all()
    reach = run(
        "paths/shapes",
        "m.reachAlong(given[0], [0.6, 0, -0.8])",
        {"low": [0, 0, 1], "high": [10, 9, 2]},
    )
    assert reach == pytest.approx([-1.6, 6 - 0.8])
    # the nearest on the screen; of two about as near, the one in front; nothing far away
    flat = "p => [p[0], p[1], p[2]]"
    points = [[0, 0, 9], [10, 0, 9], [10, 1, 3], [300, 0, 1]]
    for x, place in ((1, 0), (10, 2), (290, 3), (100, -1)):
        assert run("paths/pick", f"m.nearest(given[0], {flat}, given[1], 0)", points, x) == place
    # a -> b -> c, of which the second is told the other way round; d is joined by nothing
    turn, shift = np.eye(4), np.eye(4)
    turn[:2, :2], shift[:3, 3] = [[0, -1], [1, 0]], (1, 2, 3)
    joins = [
        {"transform": {"matrix": turn.tolist()}, "from_parent": "a", "to_parent": "b",
         "strength": "weak", "support": 9},
        {"transform": {"matrix": shift.tolist()}, "from_parent": "c", "to_parent": "b",
         "strength": "strong", "support": 5},
        {"transform": None, "from_parent": "c", "to_parent": "d", "strength": None, "support": 0},
        {"transform": {"matrix": turn.tolist()}, "from_parent": "c", "to_parent": "d",
         "strength": "strong", "support": 9, "undone": True},
    ]  # fmt: skip
    told = [{"job_id": "x", "result": {"joins": joins}}]
    reached = run("paths/joined", """[...m.reach("a", m.bridges(given[0]))]
        .map(([name, one]) => [name, one.matrix, one.over.length])""", told)  # fmt: skip
    assert [(name, over) for name, _, over in reached] == [("a", 0), ("b", 1), ("c", 2)]
    a_from_c = np.linalg.inv(turn) @ shift
    np.testing.assert_allclose(np.array(reached[2][1]).reshape(4, 4).T, a_from_c, atol=1e-12)


def test_colours_of_runs_stay_when_sessions_come(run):
    def colours(*days: int) -> dict[str, int]:
        sessions = [
            {"session": f"run {day}", "robot": None, "tags": [], "with_pose": 3,
             "frames": {"indexed": 3}, "parent_frames": ["map"],
             "first_captured_at": f"2026-11-{day:02d}T09:00:00Z",
             "last_captured_at": f"2026-11-{day:02d}T10:00:00Z"}
            for day in sorted(days, key=str)  # as the API lists them, by name
        ]  # fmt: skip
        expression = "m.runsOf(given[0]).runs.map((one) => [one.session, one.colour])"
        return dict(run("paths/data", expression, sessions))

    before = colours(2, 3, 20)
    after = colours(2, 3, 20, 21, 22, 23, 24, 25)
    assert {name: after[name] for name in before} == before
    assert sorted(after.values()) == list(range(8))  # as many as there are colours
    assert len(colours(*range(1, 20))) == 19
