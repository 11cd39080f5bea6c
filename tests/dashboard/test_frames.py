"""Tests of the gallery and of a frame's page against the API."""

from __future__ import annotations

import base64
import io
import json
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from PIL import Image

from tests.dashboard.conftest import expect

if TYPE_CHECKING:
    from playwright.sync_api import Locator, Page

Sent = dict[str, Any]
#: What is on a canvas as a PNG: a million numbers one by one would take seconds.
PNG = "(canvas) => canvas.toDataURL('image/png').split(',')[1]"


def ids(page: Page) -> list[str]:
    """Frames of the tiles of the gallery, in their order."""
    found: list[str] = page.locator("#frames > .tile").evaluate_all(
        "(tiles) => tiles.map((one) => one.dataset.frame)"
    )
    return found


def listed(station: Any, name: str, **wanted: Any) -> list[str]:
    """Frames of a page of 24 of the API."""
    found = station.client.get(f"/v1/maps/{name}/frames", params={"limit": 24, **wanted}).json()
    return [one["frame_id"] for one in found["items"]]


def drawn(canvas: Locator) -> np.ndarray[Any, Any]:
    """(h, w, 3) colours of a canvas."""
    png = base64.b64decode(canvas.evaluate(PNG))
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB"))


def told(station: Any, path: str, **params: Any) -> np.ndarray[Any, Any]:
    """(h, w, 3) colours of a preview as the API sends it."""
    answer = station.client.get(path, params=params)
    return np.asarray(Image.open(io.BytesIO(answer.content)).convert("RGB"))


def wall(columns: int, rows: int, metres: float, seed: int) -> bytes:
    """A depth image of a wall; 32 x 24 samples are too few to be signed, 64 x 48 are not."""
    rng = np.random.default_rng(seed)
    depth = np.full((rows, columns), 1000 * metres) + rng.integers(0, 3, (rows, columns))
    buffer = io.BytesIO()
    Image.fromarray(depth.astype(np.uint16)).save(buffer, "PNG")
    return buffer.getvalue()


def add(station: Any, name: str, seeds: range, columns: int = 32) -> list[str]:
    """Send walls to a map; their ids, in the order in which they came."""
    rows = columns * 3 // 4
    lens = {"width": columns, "height": rows, "fx": columns, "fy": columns,
            "cx": columns / 2, "cy": rows / 2}  # fmt: skip
    files = [("frame", (f"{i}.png", wall(columns, rows, 2.0, i), "image/png")) for i in seeds]
    answer = station.client.post(
        f"/v1/maps/{name}/frames/batch", data={"metas": json.dumps({"intrinsics": lens})},
        files=files,
    )  # fmt: skip
    assert answer.status_code == 200, answer.text
    return [one["frame"]["frame_id"] for one in answer.json()["items"]]


def test_gallery_shows_and_filters_what_the_api_lists(page, station, settle, axe):
    page.goto(f"{station.home}#/maps/building")
    settle(page)
    assert ids(page) == listed(station, "building", order="desc")
    assert len(ids(page)) == 16
    assert page.locator(".pager-count").inner_text() == "1–16 of 16"
    first = page.locator(".tile").first
    expect(first.locator(".badge")).to_have_text("indexed")
    expect(first.locator(".tile-who")).to_have_text("bob · room-1/bob")
    assert axe(page) == []

    page.get_by_text("Filters", exact=True).click()
    page.get_by_label("Session").select_option("room-0/ann")
    settle(page)
    ann = listed(station, "building", order="desc", session="room-0/ann")
    assert ids(page) == ann
    assert page.locator(".pager-count").inner_text() == "1–4 of 4"
    page.get_by_role("button", name="Normals").click()
    settle(page)
    path = f"/v1/maps/building/frames/{ann[0]}/preview.png"
    want = told(station, path, view="normals", width=240)
    assert np.array_equal(drawn(page.locator(".tile canvas").first), want)
    assert "view=normals" in page.url

    page.reload()  # the address has it all
    settle(page)
    assert ids(page) == ann
    expect(page.get_by_label("Session")).to_have_value("room-0/ann")
    expect(page.get_by_role("button", name="Normals")).to_have_attribute("aria-pressed", "true")
    page.go_back()
    page.go_back()
    settle(page)
    assert len(ids(page)) == 16

    page.get_by_text("Filters", exact=True).click()
    page.get_by_label("Tag").fill("door")
    page.get_by_label("Tag").blur()
    page.get_by_label("Taken from").fill("2026-11-20T09:01")
    page.get_by_label("Taken from").blur()
    settle(page)
    later = "2026-11-20T09:01:00Z"
    assert ids(page) == listed(station, "building", tag="door", captured_after=later)
    assert ids(page) == [station.frames[8].frame_id]
    page.get_by_label("State").select_option("rejected")
    expect(page.get_by_role("heading", name="No frame matches")).to_be_visible()
    page.get_by_role("button", name="Clear filters").last.click()
    settle(page)
    assert len(ids(page)) == 16


@pytest.mark.thorough
@pytest.mark.parametrize("moved", [False, True])
def test_a_click_counts_although_what_was_pressed_is_drawn_anew(page, station, settle, moved):
    name = f"pressed-{moved}".lower()
    station.make_map(name)
    (first,) = add(station, name, range(1))
    page.goto(f"{station.home}#/maps/{name}")
    settle(page)
    link = page.locator(".tile-name a")
    link.hover()
    pressed = link.element_handle()
    page.mouse.down()
    add(station, name, range(1, 2))
    expect(page.locator("#frames .tile")).to_have_count(2)
    assert not pressed.evaluate("(link) => link.isConnected")
    if moved:
        page.mouse.move(2, 2)  # taken back, as anywhere
    page.mouse.up()
    settle(page)
    there = f"#/maps/{name}" if moved else f"#/maps/{name}/frames/{first}"
    expect(page).to_have_url(f"{station.home}{there}")


@pytest.mark.thorough
def test_gallery_pages_by_cursor_and_says_why_frames_were_rejected(page, station, settle, until):
    path = station.make_map("walls")
    came = add(station, "walls", range(50))
    until(lambda: station.client.get(path).json()["frames"] == {"rejected": 50})
    newest = came[::-1]
    page.goto(f"{station.home}#/maps/walls")
    settle(page)
    assert ids(page) == newest[:24]
    reason = station.client.get(f"{path}/frames/{newest[0]}").json()["reason"]
    expect(page.locator(".tile").first.locator(".frame-why p")).to_have_text(reason)

    pages = page.get_by_role("navigation", name="Pages")
    pages.get_by_role("button", name="Next").click()
    settle(page)
    assert ids(page) == newest[24:48]
    assert page.locator(".pager-count").inner_text() == "25–48 of 50"
    second = page.url
    pages.get_by_role("button", name="Next").click()
    settle(page)
    assert ids(page) == newest[48:]
    expect(pages.get_by_role("button", name="Next")).to_be_disabled()
    page.reload()
    settle(page)
    pages.get_by_role("button", name="Previous").click()
    settle(page)
    assert page.url == second
    assert ids(page) == newest[24:48]
    page.go_back()
    settle(page)
    assert ids(page) == newest[48:]

    # who was sent the address has not been on the page before
    page.evaluate("sessionStorage.clear()")
    page.goto("about:blank")
    page.goto(second)
    settle(page)
    assert ids(page) == newest[24:48]
    pages.get_by_role("button", name="First page").click()
    settle(page)
    assert ids(page) == newest[:24]
    # an address that was cut off is refused each time: there is a way on
    page.allowed.append("422")
    page.goto(f"{station.home}#/maps/walls?cursor=abc&page=2")
    expect(page.get_by_role("main")).to_contain_text("The cursor 'abc' is not valid")
    page.get_by_role("button", name="First page").click()
    settle(page)
    assert ids(page) == newest[:24]
    new = add(station, "walls", range(60, 61))
    page.get_by_role("button", name="1 new frame: show").click()
    expect(page.locator(".tile").first).to_have_attribute("data-frame", new[0])


@pytest.mark.thorough
def test_states_change_as_they_happen(page, station, settle, until):
    path = station.make_map("coming")
    with page.expect_request(lambda one: "/v1/events" in one.url):
        page.goto(f"{station.home}#/maps/coming")
    settle(page)
    expect(page.get_by_role("heading", name="No frames yet")).to_be_visible()
    [one] = add(station, "coming", range(1), columns=64)
    expect(page.locator(f"[data-frame='{one}'] .badge")).to_have_text("indexed")
    settle(page)
    want = told(station, f"{path}/frames/{one}/preview.png", width=240)
    assert np.array_equal(drawn(page.locator(".tile canvas")), want)
    station.client.delete(f"{path}/frames/{one}")
    expect(page.locator(f"[data-frame='{one}'] .badge")).to_have_text("deleted")
    page.allowed.append("404")
    station.client.delete(path)
    expect(page.get_by_role("main")).to_contain_text("There is no map 'coming'")


@pytest.fixture
def shown(page, station, settle):
    """The page of a frame of `building`; what the API says of that frame."""
    path = f"/v1/maps/building/frames/{station.frames[4].frame_id}"
    page.goto(f"{station.home}#{path.removeprefix('/v1')}")
    settle(page)
    found: Sent = station.client.get(path).json()
    return found


@pytest.mark.thorough
def test_frame_page_tells_what_the_api_tells(page, station, shown, settle, axe, pixels):
    path = f"/v1/maps/building/frames/{shown['frame_id']}"
    facts = dict(
        zip(
            page.locator(".facts dt").all_inner_texts(),
            page.locator(".facts dd").all_inner_texts(),
            strict=True,
        )
    )
    lens = shown["intrinsics"]
    assert facts["Frame"] == shown["frame_id"]
    assert facts["Content"] == shown["content_id"]
    assert facts["Session"] == "room-0/ann"
    assert facts["Focal length"] == f"{lens['fx']:g}, {lens['fy']:g} px"
    at = shown["pose"]["translation"]
    assert facts["Translation"] == f"{at['x']:.3f}, {at['y']:.3f}, {at['z']:.3f} m"
    assert shown["job_id"][:8] in facts["Job"]
    assert "succeeded" in facts["Job"]

    patches = station.client.get(f"{path}/patches").json()
    sizes = [len(level["size"]) for level in (*patches["levels"], patches["validation"])]
    names = [*(f"Level {i + 1}" for i in range(len(patches["levels"]))), "Validation"]
    levels = page.get_by_role("group", name="Level").locator("button")
    assert levels.all_inner_texts() == [
        f"{name} · {size}" for name, size in zip(names, sizes, strict=True)
    ]
    area = np.array(patches["levels"][1]["area_m2"])
    levels.nth(1).click()
    row = page.locator(".patches-table tbody tr").first.locator("td").all_inner_texts()
    assert row[0].strip() == str(area.argmax())
    assert row[2] == str(patches["levels"][1]["size"][int(area.argmax())])

    answer = station.client.post(
        "/v1/maps/building/queries",
        json={"frame_id": shown["frame_id"], "k": 8, "stages": "retrieve"},
    ).json()
    near = page.locator(".neighbours .tile")
    assert near.evaluate_all("(tiles) => tiles.map((one) => one.dataset.frame)") == [
        match["frame_id"] for match in answer["matches"]
    ]
    assert near.first.locator(".tile-when").inner_text() == (
        f"distance {answer['matches'][0]['distance']:,}"
    )
    assert page.get_by_role("link", name="Locate this frame").get_attribute("href") == (
        f"#/maps/building/query?frame={shown['frame_id']}"
    )
    points = station.client.get(f"{path}/points").content
    count = int.from_bytes(points[8:12], "little")
    expect(page.locator(".scene-told")).to_contain_text(f"{count:,}")
    colours = pixels(page.locator(".scene-canvas")).getcolors(1 << 20)
    assert colours is not None
    assert len(colours) > 50, "nothing was drawn in 3-D"

    page.locator(".card", has_text="Sensor view").get_by_role(
        "button", name="Patches"
    ).first.click()
    settle(page)
    want = told(station, f"{path}/preview.png", view="patches", width=640)
    assert np.array_equal(drawn(page.locator(".frame-look canvas")), want)
    assert f"{sizes[0]} patches" in page.locator(".frame-meaning").inner_text()
    assert axe(page) == []

    with page.expect_download() as download:
        page.get_by_role("button", name="Upload", exact=True).click()
    assert download.value.path().read_bytes() == station.frames[4].png


@pytest.mark.thorough
def test_an_edit_of_somebody_else_is_not_overwritten_unseen(page, station, settle, until):
    page.allowed += ["412"]
    path = station.make_map("edited")
    [one] = add(station, "edited", range(1), columns=64)
    mine = f"{path}/frames/{one}"
    until(lambda: station.client.get(mine).json()["state"] == "indexed")
    station.client.patch(mine, json={"tags": ["a, b"]})
    page.goto(f"{station.home}#/maps/edited/frames/{one}")
    settle(page)
    page.get_by_role("button", name="Edit").click()
    dialog = page.get_by_role("dialog")
    dialog.get_by_label("Session").fill("mine")
    expect(dialog.get_by_label("Tags")).to_have_value("a, b")
    dialog.get_by_label("Tags").fill("door,a,b , north")  # one that was there stays one
    station.client.patch(mine, json={"session": "theirs", "robot": "r9"})
    dialog.get_by_role("button", name="Save").click()
    expect(dialog.get_by_role("alert")).to_contain_text("Session is now theirs")
    assert station.client.get(mine).json()["tags"] == ["a, b"]
    dialog.get_by_role("button", name="Overwrite with mine").click()
    expect(dialog).not_to_be_visible()
    now = station.client.get(mine).json()
    assert (now["session"], now["robot"], now["tags"]) == ("mine", "r9", ["a, b", "door", "north"])
    expect(page.get_by_role("button", name="Edit")).to_be_focused()
    expect(page.locator(".facts dd", has_text="mine")).to_be_visible()
    # what others change from now on is seen without asking
    station.client.patch(mine, json={"robot": "r10"})
    expect(page.locator(".facts dd", has_text="r10")).to_be_visible(timeout=30_000)

    page.get_by_role("button", name="Delete").click()
    page.get_by_role("dialog").get_by_role("button", name="Delete").click()
    expect(page.get_by_role("heading", name="No frames yet")).to_be_visible()
    assert station.client.get(mine).json()["state"] == "deleted"
    toast = page.locator(".toast", has_text="Deleted 1 frame").bounding_box()
    assert toast["x"] + toast["width"] <= 200  # in the rail, where it covers no control
    page.get_by_role("button", name="Undo", exact=True).click()
    expect(page.locator(".toast", has_text="Restored 1 frame.")).to_be_visible()
    restored = station.client.get(mine).json()
    assert (restored["session"], restored["tags"]) == ("mine", ["a, b", "door", "north"])
    until(lambda: station.client.get(mine).json()["state"] == "indexed")


@pytest.mark.thorough
def test_frames_are_found_selected_changed_and_restored(page, station, settle, until, axe):
    path = station.make_map("picked")
    came = add(station, "picked", range(6))
    until(lambda: station.client.get(path).json()["frames"] == {"rejected": 6})
    for i, one in enumerate(came):
        session = "monday" if i < 4 else "tuesday"
        station.client.patch(f"{path}/frames/{one}", json={"session": session, "name": f"n{i}"})

    def sessions() -> dict[str, int]:
        found = station.client.get(f"{path}/sessions").json()["items"]
        return {one["session"]: sum(one["frames"].values()) for one in found}

    # by name, by id, by session: one field
    page.goto(f"{station.home}#/maps/picked")
    settle(page)
    page.get_by_text("Filters", exact=True).click()
    for text, found in (("n3", [came[3]]), (came[1], [came[1]]), ("mon", came[3::-1])):
        page.get_by_label("Find").fill(text)
        page.keyboard.press("Enter")
        settle(page)
        assert ids(page) == found
    assert "find=mon" in page.url

    # two of those that match are moved, and that is undone
    for one in ("n0", "n2"):
        page.get_by_role("checkbox", name=f"Select frame {one}").check()
    bar = page.get_by_role("group", name="Selected frames")
    expect(bar).to_contain_text("2 selected")
    assert axe(page) == []
    bar.get_by_role("button", name="Move to session").click()
    page.get_by_role("dialog").get_by_label("Session").fill("wednesday")
    page.get_by_role("button", name="Save").click()
    expect(page.locator(".toast", has_text="Changed 2 frames.")).to_be_visible()
    assert sessions() == {"monday": 2, "tuesday": 2, "wednesday": 2}
    expect(bar).to_be_hidden()
    page.get_by_role("button", name="Undo", exact=True).click()
    expect(page.locator(".toast", has_text="2 frames are as before.")).to_be_visible()
    assert sessions() == {"monday": 4, "tuesday": 2}
    settle(page)

    # all that match are tagged, and then deleted; the rest stays
    page.get_by_role("checkbox", name="Select frame n1").check()
    bar.get_by_role("button", name="Select all that match the filters").click()
    expect(bar).to_contain_text("All frames that match")
    expect(page.locator(".tile-tick input:checked")).to_have_count(4)
    bar.get_by_role("button", name="Tag").click()
    page.get_by_label("Add tags").fill("wet, dock")
    page.keyboard.press("Enter")
    expect(page.locator(".toast", has_text="Changed 4 frames.")).to_be_visible()
    assert listed(station, "picked", tag=["wet", "dock"]) == came[:4]
    settle(page)
    page.get_by_role("checkbox", name="Select frame n1").check()
    bar.get_by_role("button", name="Select all that match the filters").click()
    bar.get_by_role("button", name="Delete").click()
    page.get_by_role("dialog").get_by_role("button", name="Delete").click()
    expect(page.locator(".toast", has_text="Deleted 4 frames. You can undo it")).to_be_visible()
    assert listed(station, "picked") == came[4:]
    # also by who comes later
    page.goto(f"{station.home}#/maps/picked/sessions")
    settle(page)
    page.get_by_role("button", name="Undo the deletion of 4 frames").click()
    expect(page.locator(".sessions-scroll tbody tr")).to_have_count(2)
    assert listed(station, "picked") == came
    assert listed(station, "picked", tag=["wet", "dock"]) == came[:4]
    expect(page.get_by_role("heading", name="Recently deleted")).to_be_hidden()
