"""Tests of paths in the place against the API: joins, edges, a query and permissions."""

import json
from urllib.parse import parse_qs, urlsplit

import numpy as np
import pytest

from tests.dashboard.conftest import click_at, expect

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
        robot = "carol" if i == 8 else "bob" if i % 2 else "ann"
        meta = {**sent.meta, "session": robot, "robot": None}
        if robot == "carol":
            del meta["pose"]
        else:
            pose = np.array(sent.meta["pose"]["matrix"])
            moved = B_FROM_A @ pose if robot == "bob" else pose
            meta["pose"] = {"parent_frame": f"{robot}/odom", "matrix": moved.tolist()}
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


@pytest.mark.thorough
def test_runs_are_joined_from_here(page, apart, station, settle):
    """The page reports runs without a join, and draws them in place once a join exists."""
    urls = []
    page.on("request", lambda one: urls.append(urlsplit(one.url)))
    page.goto(apart["url"])
    settle(page)
    expect(page.locator(".paths-run")).to_have_text(["1ann4 poses"])
    expect(page.locator(".paths-left li")).to_have_text([
        "carol · 1 frame: no poses",
        "bob · 4 frames: poses in bob/odom, which no association joins to ann/odom",
    ])  # fmt: skip
    (thinned,) = [parse_qs(url.query) for url in urls if url.path.endswith("/trajectory")]
    assert int(thinned["most"][0]) <= 2000  # however many there are
    lists = [parse_qs(url.query) for url in urls if url.path.endswith("/frames")]
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


def test_numbers_behind_the_picture(run):
    """What is computed for the picture, against values by hand and NumPy."""
    way = [[x, 0, 0] for x in (0, 1, 2, 2.1, 5, 5.5)]
    assert run("paths/shapes", "[m.spaced(given[0], 2, 9), m.spaced(given[0], 2, 2)]", way) == [
        [0, 2, 4, 5], [0, 5]
    ]  # fmt: skip
    rng = np.random.default_rng(3)
    for scale in (1.0, 1e-4):
        root = rng.normal(size=(3, 3)) * scale
        covariance = root @ root.T
        result = run("paths/shapes", "m.axesOf(given[0])", covariance.tolist())
        values, vectors = np.linalg.eigh(covariance)
        for one, value, vector in zip(result, values[::-1], vectors.T[::-1], strict=True):
            assert one["deviation"] == pytest.approx(np.sqrt(value), rel=1e-6)
            assert abs(np.dot(one["axis"], vector)) == pytest.approx(1, abs=1e-6)
    # cameras look level along x: their down is the map's -z; a camera's own axes: down is y
    level = [0, -1, 0, 0, 0, 0, -1, 0, 1, 0, 0, 0, 5, 5, 5, 1]
    itself = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
    for matrix, is_cloud, up in (
        (level, False, [0, 0, 1]), (itself, False, [0, -1, 0]), (itself, True, [0, 0, 1])
    ):  # fmt: skip
        runs = [{"poses": [matrix], "isCloud": is_cloud}]
        assert run("plan/axes", "m.uprightOf(given[0])", runs) == up
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
    jobs = [{"job_id": "x", "result": {"joins": joins}}]
    reached = run("paths/joined", """[...m.reach("a", m.bridges(given[0]))]
        .map(([name, one]) => [name, one.matrix, one.over.length])""", jobs)  # fmt: skip
    assert [(name, over) for name, _, over in reached] == [("a", 0), ("b", 1), ("c", 2)]
    a_from_c = np.linalg.inv(turn) @ shift
    np.testing.assert_allclose(np.array(reached[2][1]).reshape(4, 4).T, a_from_c, atol=1e-12)
