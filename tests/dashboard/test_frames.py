"""Tests of the gallery and of a frame's page against the API."""

import io
import json

import numpy as np
import pytest
from PIL import Image

from tests.dashboard.conftest import colours, drawn, expect


def ids(page):
    """Frames of the tiles of the gallery, in their order."""
    return page.locator("#frames > .tile").evaluate_all(
        "(tiles) => tiles.map((one) => one.dataset.frame)"
    )


def listed(station, name, **wanted):
    """Frames of a page of 24 of the API."""
    body = station.client.get(f"/v1/maps/{name}/frames", params={"limit": 24, **wanted}).json()
    return [item["frame_id"] for item in body["items"]]


def preview(station, path, **params):
    """(h, w, 3) colours of a preview as the API sends it."""
    answer = station.client.get(path, params=params)
    return colours(answer.content)


def wall(columns, rows, metres, seed):
    """A depth image of a wall; 32 x 24 samples are too few to be signed, 64 x 48 are not."""
    rng = np.random.default_rng(seed)
    depth = np.full((rows, columns), 1000 * metres) + rng.integers(0, 3, (rows, columns))
    buffer = io.BytesIO()
    Image.fromarray(depth.astype(np.uint16)).save(buffer, "PNG")
    return buffer.getvalue()


def add(station, name, seeds, columns=32):
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
    return [item["frame"]["frame_id"] for item in answer.json()["items"]]


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
    want = preview(station, path, view="normals", width=240)
    assert np.array_equal(drawn(page.locator(".tile canvas").first), want)
    assert "view=normals" in page.url
    page.reload()  # the address has it all
    settle(page)
    assert ids(page) == ann
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


@pytest.fixture
def shown(page, station, settle):
    """The page of a frame of `building`; what the API says of that frame."""
    path = f"/v1/maps/building/frames/{station.frames[4].frame_id}"
    page.goto(f"{station.home}#{path.removeprefix('/v1')}")
    settle(page)
    return station.client.get(path).json()


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
    want = preview(station, f"{path}/preview.png", view="patches", width=640)
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
    until(lambda: station.client.get(mine).json()["state"] == "indexed")


@pytest.mark.thorough
def test_frames_are_found_selected_changed_and_restored(page, station, settle, until, axe):
    path = station.make_map("picked")
    came = add(station, "picked", range(6))
    until(lambda: station.client.get(path).json()["frames"] == {"rejected": 6})
    for i, one in enumerate(came):
        session = "monday" if i < 4 else "tuesday"
        station.client.patch(f"{path}/frames/{one}", json={"session": session, "name": f"n{i}"})

    def sessions():
        body = station.client.get(f"{path}/sessions").json()["items"]
        return {item["session"]: sum(item["frames"].values()) for item in body}

    page.goto(f"{station.home}#/maps/picked")
    settle(page)
    page.get_by_text("Filters", exact=True).click()
    page.get_by_label("Find").fill("mon")
    page.keyboard.press("Enter")
    settle(page)
    assert ids(page) == came[3::-1]
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
    # all that match are deleted; the rest stays
    settle(page)
    page.get_by_role("checkbox", name="Select frame n1").check()
    bar.get_by_role("button", name="Select all that match the filters").click()
    bar.get_by_role("button", name="Delete").click()
    page.get_by_role("dialog").get_by_role("button", name="Delete").click()
    expect(page.locator(".toast", has_text="Deleted 4 frames. You can undo it")).to_be_visible()
    assert listed(station, "picked") == came[4:]
