"""Tests of the page of maps against the API: cards, creation, edits, deletion and live updates."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import pytest
from playwright.sync_api import Page, expect

Settle = Callable[[Page], None]
MARKUP = "<img src=x onerror=alert(1)> & co"


def card(page: Page, name: str) -> Any:
    return page.locator(f"[data-map='{name}']")


def test_a_card_tells_what_the_api_does(station: Any, page: Page, settle: Settle) -> None:
    station.make_map("marked-up", title=MARKUP)
    page.goto(station.home)
    settle(page)
    one, told = card(page, "building"), station.client.get("/v1/maps/building").json()
    assert told["frames"] == {"indexed": 16}
    expect(one.get_by_role("heading")).to_have_text("Two rooms")
    expect(one.locator(".map-number")).to_have_text("16")
    expect(one).to_contain_text("Up to date")
    expect(one).to_contain_text(told["model"])
    sizes = station.client.get("/v1/stats", params={"map": "building"}).json()["bytes"]
    used = sum(sizes[part] for part in ("database", "blobs", "index"))
    expect(one.locator("dd").last).to_have_text(f"{used / 1e6:.1f} MB")
    expect(one).to_contain_text("none needed")  # a query compares all 16 frames
    expect(one.get_by_role("link", name="Upload frames")).to_have_count(0)
    empty = card(page, "marked-up")
    expect(empty.get_by_role("heading")).to_have_text(MARKUP)  # letter by letter
    expect(empty).to_contain_text("empty")
    expect(empty.get_by_role("link", name="Upload frames")).to_have_attribute(
        "href", "#/maps/marked-up/upload"
    )


def test_a_map_is_made(
    station: Any, page: Page, settle: Settle, axe: Callable[[Page], list[str]]
) -> None:
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
def test_a_map_is_retitled_and_an_edit_of_another_not_overwritten_unseen(
    station: Any, page: Page, settle: Settle
) -> None:
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


def test_a_map_is_removed_when_its_name_was_typed(station: Any, page: Page, settle: Settle) -> None:
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


def test_counts_move_while_workers_sign(station: Any, page: Page, settle: Settle) -> None:
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


def test_a_map_keeps_the_focus_while_its_counts_move(
    station: Any, page: Page, settle: Settle
) -> None:
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
def test_many_maps_are_few_requests(station: Any, page: Page, settle: Settle) -> None:
    for number in range(40):
        station.make_map(f"many-{number:02d}")
    names, at_once, most = [], set(), 0

    def begun(request: Any) -> None:
        nonlocal most
        if "/v1/stats" in request.url:
            names.append(request.url.partition("map=")[2].partition("&")[0])
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
