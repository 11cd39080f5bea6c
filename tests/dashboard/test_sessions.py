"""Tests of the page of sessions against the API: list, renaming, tags, merging and deletion."""

import json

import pytest

from tests.dashboard.conftest import expect

#: Session and robot of each of six frames.
TAKEN = [("monday", "ann")] * 2 + [("monday", None)] + [("tuesday/2", "ann")] * 2 + [(None, None)]


@pytest.fixture(scope="module")
def runs(station):
    """Path of a map of six frames, a second apart, whether they are signed or not."""
    path = str(station.make_map("runs", title="Runs"))
    metas, files = [], []
    for i, (sent, (session, robot)) in enumerate(zip(station.frames, TAKEN, strict=False)):
        tags = ["dock"] if i < 2 else []
        metas.append({**sent.meta, "session": session, "robot": robot, "tags": tags})
        files.append(("frame", (f"{i}.png", sent.png, "image/png")))
    sent = station.client.post(
        f"{path}/frames/batch", data={"metas": json.dumps(metas)}, files=files
    )
    assert sent.status_code == 200, sent.text
    return path


def listed(station, path):
    """Frames and tags by session and robot, as the API has them."""
    body = station.client.get(f"{path}/sessions").json()["items"]
    return {
        (one["session"], one["robot"]): (sum(one["frames"].values()), one["tags"]) for one in body
    }


@pytest.mark.thorough
def test_sessions_are_listed_renamed_tagged_joined_and_deleted(station, runs, page, settle, axe):
    page.allowed.append("422")
    page.goto(f"{station.home}#/maps/runs")
    settle(page)
    page.get_by_role("link", name="Sessions", exact=True).click()
    settle(page)
    rows = page.locator("tbody tr")
    expect(rows).to_have_count(4)
    expect(page.get_by_role("main")).to_contain_text("4 sessions · 6 frames")
    ann = rows.filter(has_text="ann").filter(has_text="monday")
    for text in ("2026-11-20 09:00:00 – 09:00:01", "1.0 s", "dock"):
        expect(ann).to_contain_text(text)
    expect(ann.get_by_role("link", name="monday", exact=True)).to_have_attribute(
        "href", "#/maps/runs?session=monday&robot=ann"
    )
    expect(rows.first).to_contain_text("none")  # frames without a session cannot be named
    expect(rows.first.get_by_role("button")).to_have_count(0)
    assert axe(page) == []
    dialog = page.get_by_role("dialog")
    page.get_by_role("button", name="Tag session tuesday/2").click()
    field = dialog.get_by_role("textbox", name="Tags")
    expect(field).to_be_focused()
    field.fill(f"wet, {'x' * 129}")
    page.keyboard.press("Enter")
    expect(field).to_have_attribute("aria-invalid", "true")
    assert axe(page) == []
    field.fill("wet, dock")
    page.keyboard.press("Enter")
    expect(dialog).to_have_count(0)
    assert listed(station, runs)["tuesday/2", "ann"] == (2, ["dock", "wet"])
    page.get_by_role("button", name="Rename session tuesday/2").click()
    dialog.get_by_role("textbox", name="Name").fill("tuesday")
    page.get_by_role("button", name="Rename", exact=True).click()
    expect(rows.filter(has_text="tuesday")).to_have_count(1)
    expect(page.get_by_role("link", name="tuesday", exact=True)).to_be_visible()
    # the name of another joins the two, which is said before
    page.get_by_role("button", name="Rename session tuesday").click()
    dialog.get_by_role("textbox", name="Name").fill("monday")
    page.keyboard.press("Enter")
    expect(dialog).to_contain_text("There is a session monday. Rename again to join the two")
    page.keyboard.press("Enter")
    expect(rows).to_have_count(3)
    assert listed(station, runs)["monday", "ann"] == (4, ["dock", "wet"])
    rows.filter(has_text="ann").get_by_role("button", name="Delete").click()
    expect(dialog).to_contain_text("its 4 frames")
    expect(dialog).not_to_contain_text("cannot be chosen alone")
    delete = page.get_by_role("button", name="Delete session", exact=True)
    expect(delete).to_be_disabled()
    dialog.get_by_role("textbox").fill("monday")
    delete.click()
    expect(rows).to_have_count(2)
    expect(page.get_by_role("status").filter(has_text="Deleted 4 frames.")).to_be_visible()
    assert set(listed(station, runs)) == {(None, None), ("monday", None)}
    assert axe(page) == []
    expect(page.get_by_role("button", name="Undo the deletion of 4 frames")).to_be_visible()
    page.get_by_role("button", name="Undo the deletion of 4 frames").click()
    expect(rows).to_have_count(3)
    assert listed(station, runs)["monday", "ann"] == (4, ["dock", "wet"])
