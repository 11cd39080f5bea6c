"""Tests of the page of maps against the API: cards, creation, edits, deletion and live updates."""

from __future__ import annotations

import json
import re
from typing import TYPE_CHECKING, Any

import pytest

from benchmarks.rooms import Shot, send, shots
from tests.dashboard.conftest import expect

if TYPE_CHECKING:
    from playwright.sync_api import Page

MARKUP = "<img src=x onerror=alert(1)> & co"


def card(page: Page, name: str) -> Any:
    return page.locator(f"[data-map='{name}']")


def test_a_card_tells_what_the_api_does(station, page, settle, axe):
    station.make_map("marked-up", title=MARKUP)
    page.goto(station.home)
    settle(page)
    one, record = card(page, "building"), station.client.get("/v1/maps/building").json()
    assert record["frames"] == {"indexed": 16}
    expect(one.get_by_role("heading")).to_have_text("Two rooms")
    expect(one.locator(".map-count")).to_have_text("16 indexed frames")
    expect(one).to_contain_text(record["model"])
    expect(one.get_by_role("link", name="Upload frames")).to_have_count(0)
    empty = card(page, "marked-up")
    expect(empty.get_by_role("heading")).to_have_text(MARKUP)  # letter by letter
    expect(empty).to_contain_text("This map is empty")
    counts = [
        {},
        {"unvalidated": 1},
        {"unvalidated": 3},
        {"found": 2, "failed": 1, "unvalidated": 1},
    ]
    shares = page.evaluate(
        """async ([url, map, counts]) => {
          const { mapCard } = await import(url), { signal } = new AbortController();
          return counts.map((recent_queries) => {
            const { element } = mapCard({ ...map, recent_queries }, { signal });
            return element.querySelector(".map-share").textContent; }); }""",
        [f"{station.url}/dashboard/maps/card.js", record, counts],
    )  # fmt: skip
    assert shares == [
        "No queries in the last hour", "1 query without validation in the last hour",
        "3 queries without validation in the last hour", "66 % of 3 queries found in the last hour",
    ]  # fmt: skip
    expect(empty.get_by_role("link", name="Upload frames")).to_have_attribute(
        "href", "#/maps/marked-up/upload"
    )
    one.get_by_role("button", name="Back up or copy building").click()
    commands = page.get_by_role("dialog").locator("pre")
    expect(commands).to_have_text([
        "sceneprint snapshot --to backup",
        f"sceneprint pull --map building --url {station.url}/ --data copy",
    ])  # fmt: skip
    assert axe(page) == []


def test_a_map_is_made(station, page, settle, axe):
    page.allowed += ["422", "409"]
    page.goto(station.home)
    settle(page)
    page.get_by_role("button", name="New map").click()
    name, dialog = page.get_by_role("textbox", name="Name"), page.get_by_role("dialog")
    assert axe(page) == []
    presets = [m for m in station.client.get("/v1/models").json()["items"] if m["preset"]]
    expect(dialog.get_by_role("radio")).to_have_count(len(presets))
    for wrong, why in (("Upper Case", "1 to 63 lower-case letters"), ("building", "building")):
        name.fill(wrong)
        page.keyboard.press("Enter")
        place = dialog.locator("#new-name-error")
        expect(place).to_contain_text(why)
        expect(name).to_have_attribute("aria-invalid", "true")
        expect(name).to_be_focused()
    name.fill("made-here")
    page.get_by_role("textbox", name="Title").fill("Made by hand")
    page.get_by_role("radio", name="Rooms").check()
    page.keyboard.press("Enter")
    expect(page).to_have_url(f"{station.home}#/maps/made-here")
    expect(page.get_by_role("status").filter(has_text="made-here was created")).to_be_visible()
    made = station.client.get("/v1/maps/made-here").json()
    assert (made["title"], made["model"].partition("-")[0]) == ("Made by hand", "depth")


@pytest.mark.thorough
def test_a_map_is_retitled_and_an_edit_of_another_not_overwritten_unseen(station, page, settle):
    page.allowed.append("412")
    path = station.make_map("retitled", title="Before")
    page.goto(station.home)
    settle(page)
    page.get_by_role("button", name="Rename retitled").click()
    station.client.patch(path, json={"title": "Theirs"})
    field, save = (
        page.get_by_role("textbox", name="Title"),
        page.get_by_role("button", name="Save title"),
    )
    expect(field).to_have_value("Before")
    field.fill("Mine")
    save.click()
    expect(page.get_by_role("alert").first).to_contain_text("“Theirs”")
    assert station.client.get(path).json()["title"] == "Theirs"
    expect(field).to_have_value("Mine")
    save.click()
    expect(card(page, "retitled").get_by_role("heading")).to_have_text("Mine")
    assert station.client.get(path).json()["title"] == "Mine"


def test_a_map_is_removed_when_its_name_was_typed(station, page, settle):
    path = station.make_map("condemned", title="To go")
    page.goto(station.home)
    settle(page)
    page.get_by_role("button", name="Delete condemned").click()
    delete, word = (
        page.get_by_role("button", name="Delete map"),
        page.get_by_label(re.compile("Type")),
    )
    word.fill("condemne")
    expect(delete).to_be_disabled()
    page.keyboard.press("Enter")
    expect(page.get_by_role("dialog")).to_be_visible()
    assert station.client.get(path).status_code == 200
    word.fill("condemned")
    delete.click()
    expect(card(page, "condemned")).to_have_count(0)
    assert station.client.get(path).status_code == 404


@pytest.mark.thorough
def test_counts_move_while_workers_sign(station, page, settle):
    page.goto(station.home)
    settle(page)
    path = station.make_map("growing")  # by another: the card comes by itself
    one = card(page, "growing")
    expect(one.locator(".map-number")).to_have_text("0")
    for frame in station.frames[:2]:
        station.client.post(f"{path}/frames", **frame.form())
    expect(one.locator(".map-number")).to_have_text("2")
    expect(one).to_contain_text("no poses")
    expect(page.locator("#summary")).to_contain_text("frames indexed")


@pytest.mark.thorough
def test_a_map_keeps_the_focus_while_its_counts_move(station, page, settle):
    path = station.make_map("focused")
    page.goto(station.home)
    settle(page)
    one = card(page, "focused")
    title = one.get_by_role("heading").get_by_role("link")
    title.focus()
    station.client.post(f"{path}/frames", **station.frames[0].form())
    expect(one.locator(".map-number")).to_have_text("1")
    expect(title).to_be_focused()
    page.keyboard.press("Enter")
    expect(page).to_have_url(f"{station.home}#/maps/focused/place")


@pytest.mark.thorough
def test_many_maps_are_few_requests(station, page, settle):
    for number in range(40):
        station.make_map(f"many-{number:02d}")
    names, at_once, most = [], set(), 0

    def begun(request: Any) -> None:
        nonlocal most
        if request.url.endswith("/surface"):
            names.append(request.url.split("/")[-2])
            at_once.add(request)
            most = max(most, len(at_once))

    page.on("request", begun)
    page.on("requestfinished", lambda one: at_once.discard(one))
    page.goto(station.home)
    settle(page)
    assert 0 < len(names) <= 24
    assert most <= 3
    assert "many-39" not in names
    page.get_by_label("Find a map").fill("many-39")
    expect(page.locator(".map:visible")).to_have_count(1)
    settle(page)
    assert "many-39" in names  # now it is in view
    assert len(names) == len(set(names))
    page.get_by_label("Find a map").fill("nothing like it")
    expect(page.get_by_role("main")).to_contain_text("No map matches")


@pytest.fixture(scope="module")
def walk():
    """A recorded walk through a room, with up to 40 cm between two views."""
    return shots((0,), 5, 8)


@pytest.fixture(scope="module")
def walked(station, walk, until):
    """The surface of a map `walked`, which has the frames of the walk."""
    path = station.make_map("walked")
    send(station.client, "walked", walk)
    until(lambda: station.client.get(path).json()["frames"].get("indexed") == len(walk))
    station.client.post(f"{path}/surface")
    until(lambda: station.client.get(f"{path}/surface").json()["state"] == "ready")
    (parent,) = station.client.get(f"{path}/surface").json()["parents"]
    return dict(parent)


def ask(station: Any, robot: str, shot: Shot) -> dict[str, Any]:
    """Query the map `walked` with a frame."""
    meta = {"intrinsics": shot.meta["intrinsics"], "robot": robot}
    form = {"data": {"meta": json.dumps(meta)}, "files": {"frame": (shot.name, shot.data)}}
    answer = station.client.post("/v1/maps/walked/queries", **form)
    assert answer.status_code == 200, answer.text
    return dict(answer.json())


@pytest.mark.thorough
def test_robots_are_seen_moving_on_the_plan(station, page, settle, axe, walk, walked):
    first = ask(station, "walker", walk[0])
    ask(station, "idler", walk[0])
    page.goto(f"{station.home}#/")
    one = card(page, "walked")
    one.scroll_into_view_if_needed()
    robot = one.locator("[data-robot=walker]")
    plan = walked["plan"]
    outside: list[bool] = []

    def stands(answer: dict[str, Any]) -> None:
        p = [answer["location"]["pose"]["translation"][axis] for axis in "xyz"]
        u, v = (sum(a * b for a, b in zip(walked[name], p, strict=True)) for name in
                ("x_axis", "y_axis"))  # fmt: skip
        left = (u - plan["left"]) / (plan["width"] * plan["m_per_pixel"])
        top = (plan["top"] - v) / (plan["height"] * plan["m_per_pixel"])
        outside.append(not (0 <= left <= 1 and 0 <= top <= 1))
        left, top = (min(max(share, 0), 1) for share in (left, top))  # at the edge
        style = f"left: {round(100 * left, 2):g}%; top: {round(100 * top, 2):g}%"
        expect(robot).to_have_attribute("style", re.compile(f"^{re.escape(style)};"))

    stands(first)
    settle(page)
    assert axe(page) == []
    page.mouse.move(0, 0)
    requested: list[str] = []
    page.on("request", lambda sent: requested.append(sent.url))
    places = {tuple(first["location"]["pose"]["translation"].values())}
    for shot in walk[1:]:
        last = ask(station, "walker", shot)
        stands(last)  # each answer is an event, which moves the robot
        places.add(tuple(last["location"]["pose"]["translation"].values()))
    assert len(places) == len(walk)
    assert any(outside)
    assert not [url for url in requested if "/queries" in url or "/surface" in url]
    expect(one.locator(".map-answers li").first).to_contain_text("walker")
    expect(one.locator(".map-answers a").first).to_have_attribute(
        "href", f"#/queries/{last['query_id']}"
    )
    expect(one.locator(".map-share")).to_have_text("100 % of 6 queries found in the last hour")
    # two robots at one place: each has its own colour, and no label covers another
    ask(station, "idler", walk[-1])
    boxes = """all => all.map((one) => {
      const { left, top, right, bottom } = one.getBoundingClientRect();
      const { backgroundColor: colour, visibility: shown } = getComputedStyle(one);
      return { left, top, right, bottom, colour, shown }; })"""
    names = one.locator(".map-robot-name")
    expect(one.locator(".map-answers li").first).to_contain_text("idler")
    one.evaluate(
        "one => Promise.all(one.getAnimations({subtree: true}).map((each) => each.finished))"
    )
    a, b = names.evaluate_all(boxes)
    assert a["colour"] != b["colour"]
    assert a["shown"] == b["shown"] == "visible"
    apart = (a["right"] <= b["left"], b["right"] <= a["left"],
             a["bottom"] <= b["top"], b["bottom"] <= a["top"])  # fmt: skip
    assert any(apart)
    # what a person asks with the dashboard is no query of a robot
    before = station.client.get("/v1/maps/walked").json()["recent_queries"]
    page.goto(f"{station.home}#/maps/walked/query")
    page.locator(".query-gallery .query-pick").first.click()
    expect(page.locator(".query-verdict")).to_be_visible()
    listed = ask(station, "walker", walk[1])["query_id"]
    page.goto(f"{station.home}#/maps/walked/queries")
    expect(page.locator(f"[data-query='{listed}']")).to_be_visible()
    after = station.client.get("/v1/maps/walked").json()["recent_queries"]
    assert after == {"found": before["found"] + 1}


def test_the_health_is_one_sentence(run):
    def told(maps: list[dict[str, Any]], jobs: list[dict[str, Any]]) -> list[Any]:
        one = run("maps/condition", "m.conditionOf(...given)", maps, jobs)
        return [one["kind"], one["text"], one.get("href")]

    def of(name: str, **frames: int) -> dict[str, Any]:
        return {"name": name, "frames": frames, "reencoding": None}

    # the fleet page does not tell of a recording whose topic a person has to choose
    import_job = {"frame_id": None, "followed_by": None, "finished_at": "2101-01-01T00:00:00Z"}
    recordings = [None, {"recording": None}, {"recording": {"problem": "2 topics have frames."}}]
    jobs = [{**import_job, "progress": one} for one in recordings]
    news = run("maps/condition", "given[0].map(m.isNews)", jobs)
    assert news == [True, True, False]
    fine = "Everything is signed; no job failed."
    assert told([], []) == told([of("hall", indexed=3, rejected=1)], []) == ["good", fine, None]
    assert told([of("hall", failed=1), of("b", indexed=2)], []) == [
        "bad", "One frame of `hall` failed permanently; nothing waits.", "#/maps/hall?state=failed"
    ]  # fmt: skip
    assert told([of("a", failed=2, received=1), of("b", failed=1)], []) == [
        "bad", "3 frames of 2 maps failed permanently; one frame waits.",
        "#/operations?tab=jobs&state=dead",
    ]  # fmt: skip
    job = {"kind": "associate", "map": "hall", "job_id": "7"}
    assert told([of("a", received=2, signing=1)], [job]) == [
        "bad", "The `associate` job of `hall` failed; 3 frames wait.", "#/operations/jobs/7"
    ]  # fmt: skip
    assert told([], [{"kind": "associate", "map": None, "job_id": "7"}])[1] == (
        "The `associate` job failed; nothing waits."
    )
    assert told([of("a", signing=1)], []) == [
        "neutral", "One frame waits for a signature; no job failed.", None
    ]  # fmt: skip


@pytest.mark.thorough
def test_the_first_page_of_a_hundred_maps_is_small_and_fast(station, page, settle, walked):
    del walked
    for number in range(100):
        station.make_map(f"hundred-{number:03d}")
    sizes: list[int] = []
    page.on("requestfinished", lambda one: sizes.append(one.sizes()["responseBodySize"]))
    page.goto(station.home)
    expect(page.locator(".map")).not_to_have_count(0)
    settle(page)
    assert sum(sizes) <= 400_000


def test_labels_and_colours_by_value(run):
    label = {"x": 50, "y": 50, "width": 30, "height": 20}
    spots = [[8, -26], [8, 6], [-38, -26], [-38, 6], [8, -48]]
    assert run("lib/labels", "m.spread(given[0])", [label] * 5) == spots
    far = {**label, "x": 90}  # its first spot is free again, unless the picture ends before
    assert run("lib/labels", "m.spread(given[0])", [label, far]) == [[8, -26], [8, -26]]
    room = {"width": 100, "height": 60}
    within = run("lib/labels", "m.spread(...given)", [label, far, far], room)
    assert within == [[8, -26], [-38, -48], None]
    # a hash modulo six, and the next that is free; the seventh name begins anew
    names = ["a", "g", "b"]
    assert run("lib/palette", "[...m.paletteOf(given[0], 6)]", names) == [
        ["a", 1],
        ["g", 2],
        ["b", 3],
    ]
    shown = run("lib/palette", "[...m.robotTokens(given[0])]", ["b", "a", "b"])
    assert shown == [["a", "--robot-1"], ["b", "--robot-2"]]
