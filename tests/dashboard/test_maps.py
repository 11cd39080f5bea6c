"""Tests of the page of maps against the API: cards, creation, edits, deletion and live updates."""

import json
import re

import pytest

from benchmarks.rooms import send, shots
from tests.dashboard.conftest import expect

MARKUP = "<img src=x onerror=alert(1)> & co"


def card(page, name):
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
    record = station.client.get("/v1/maps/made-here").json()
    assert (record["title"], record["model"].partition("-")[0]) == ("Made by hand", "depth")


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


def ask(station, robot, shot):
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
    outside = []

    def stands(answer):
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
    requested = []
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


def test_the_health_is_one_sentence(run):
    def health(maps, jobs):
        one = run("maps/condition", "m.conditionOf(...given)", maps, jobs)
        return [one["kind"], one["text"], one.get("href")]

    def of(name, **frames):
        return {"name": name, "frames": frames, "reencoding": None}

    fine = "Everything is signed; no job failed."
    assert health([], []) == health([of("hall", indexed=3, rejected=1)], []) == ["good", fine, None]
    job = {"kind": "associate", "map": "hall", "job_id": "7"}
    assert health([of("a", received=2, signing=1)], [job]) == [
        "bad", "The `associate` job of `hall` failed; 3 frames wait.", "#/operations/jobs/7"
    ]  # fmt: skip
