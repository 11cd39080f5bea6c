"""Tests of the operations page against the API, with real jobs."""

import hashlib
import io
import os
import signal

import httpx
import numpy as np
import pytest
from PIL import Image

FIGURES = """() => Object.fromEntries([
    ...[...document.querySelectorAll("[data-figure]")]
      .map((one) => [one.dataset.figure, one.textContent]),
    ["at", document.querySelector("[data-at]").dataset.at],
    ["minutes", [...document.querySelectorAll("figure:first-of-type tbody tr")].map((row) =>
      [...row.cells].map((one) => one.textContent))],
    ["indexes", [...document.querySelectorAll("[aria-labelledby=indexes] tbody tr")].map((row) =>
      [...row.cells].map((one) => one.textContent))]])"""


def damaged(station, name, places):
    """Upload frames to a new map, and damage them on the disk before a worker reads them.

    Returns what makes them sound again.
    """
    path = station.make_map(name)
    workers = [worker["name"] for worker in station.client.get("/v1/stats").json()["workers"]]
    processes = [int(worker.rpartition(":")[2]) for worker in workers]
    sound = {}
    for process in processes:
        os.kill(process, signal.SIGSTOP)
    try:
        for place in places:
            sent = station.frames[place]
            mirrored = np.asarray(Image.open(io.BytesIO(sent.png)))[:, ::-1]
            packed = io.BytesIO()
            Image.fromarray(mirrored).save(packed, "png")
            data = packed.getvalue()
            form = sent.form()
            form["files"] = {"frame": ("mirrored.png", data, "image/png")}
            assert station.client.post(f"{path}/frames", **form).status_code == 202
            digest = hashlib.sha256(data).hexdigest()
            blob = station.data / "blobs" / digest[:2] / digest
            assert blob.read_bytes() == data
            sound[blob] = data
            blob.chmod(0o644)
            blob.write_bytes(data[:-99])
    finally:
        for process in processes:
            os.kill(process, signal.SIGCONT)
    return lambda: [blob.write_bytes(data) for blob, data in sound.items()]


@pytest.fixture(scope="module", autouse=True)
def repair(station):
    """Three frames of the map `spoilt` that die in every try, until this is called."""
    return damaged(station, "spoilt", [1, 3, 5])


def test_what_is_shown_is_what_the_service_counted(station, page, settle, axe, until):
    answer = station.client.post("/v1/maps/building/queries", **station.frames[2].form())
    assert answer.json()["status"] == "found"
    refused = station.client.get("/v1/maps/nowhere")
    assert refused.status_code == 404

    def counted():
        """Each process tells what it counted every few seconds."""
        total = station.client.get("/v1/stats").json()["total"]
        return total["queries"].get("found") and total["refused"]

    until(counted)
    answers = []
    page.on("response", lambda one: "/v1/stats" in one.url and answers.append(one))
    page.goto(f"{station.home}#/operations")
    settle(page)
    until(lambda: page.evaluate(FIGURES)["live"] == "live")
    page.locator("figure", has_text="Frames per minute").get_by_text("Show as table").click()

    def shown_and_stats():
        """What is shown at one moment, and the answer that it is of: the page asks again."""
        shown = page.evaluate(FIGURES)
        of_it = [answer for answer in answers if answer.json()["at"] == shown["at"]]
        # the table fills when the browser tells that it was opened
        return (shown, of_it[0].json()) if of_it and shown["minutes"] else None

    shown, stats = until(shown_and_stats)
    total = stats["total"]
    assert shown["waiting"] == str(stats["waiting"])
    assert shown["workers"] == str(len(stats["workers"])) == "2"
    assert shown["requests"] == f"{total['requests']:,}"
    assert shown["refused"] == f"{total['refused']} refused"
    assert shown["failed"] == f"{total['broken']} failed" == "0 failed"
    assert total["refused"] >= 1
    full = 1 - stats["bytes"]["free"] / stats["bytes"]["disk"]
    assert abs(float(shown["disk"].split()[0]) - 100 * full) < 1
    for worker in stats["workers"]:
        assert page.get_by_text(worker["name"], exact=True).is_visible()
    assert shown["indexes"] == [
        [index["map"], "none", str(index["tail"]), "exact search"] for index in stats["indexes"]
    ]
    names = ("indexed", "redundant", "rejected", "failed", "received")
    assert [row[1:] for row in reversed(shown["minutes"])] == [
        [str(minute[name]) for name in names] for minute in stats["minutes"]
    ]
    assert total["received"] >= 19
    assert page.get_by_text(f"version {station.client.get('/readyz').json()['version']}").count()
    assert axe(page) == []


@pytest.mark.thorough
def test_dead_jobs_are_shown_with_their_tracebacks_and_tried_again(
    station, page, settle, axe, until, repair
):
    page.goto(f"{station.home}#/operations?map=spoilt")
    settle(page)
    failures = page.get_by_role("region", name="Failures").locator("li")
    until(lambda: failures.count() == 3)  # as they die, without a reload
    first = failures.first
    assert first.locator(".badge").inner_text() == "dead"
    assert "is damaged: its content has a different hash" in first.inner_text()
    trace = first.get_by_role("region", name="Traceback")
    assert not trace.is_visible()
    first.get_by_text("Traceback of the last attempt").click()
    assert "sceneprint_client.errors.DamagedBlob" in trace.inner_text()
    assert axe(page) == []
    place = first.get_by_role("link", name="sign").get_attribute("href")
    repair()
    first.get_by_role("button", name="Retry").click()
    until(lambda: failures.count() == 2)
    page.goto(f"{station.home}{place}")
    settle(page)
    assert page.get_by_role("button", name="Retry").count() == 0
    page.get_by_role("definition").locator("a[href*='operations/jobs']").click()
    until(lambda: page.locator("main .badge").all_inner_texts() == ["succeeded"])
    assert axe(page) == []


@pytest.mark.thorough
def test_a_key_for_one_map_is_told_of_that_and_what_it_may_not_see(station, open_page, settle, axe):
    page = open_page(extra_http_headers={"X-Forwarded-For": "192.0.2.7"})
    page.allowed.append("401")
    limits = {"quota_frames": 20, "retention_days": 400}
    assert station.client.patch("/v1/maps/building", json=limits).is_success
    secret = station.key("guest", {"building": "read"})
    page.goto(f"{station.home}#/operations")
    settle(page)
    page.locator("#key").fill(secret)
    page.get_by_role("button", name="Use this key").click()
    page.get_by_text("need a key for all maps").wait_for()
    settle(page)
    assert page.evaluate(FIGURES)["indexed"] == "16"
    assert page.get_by_role("link", name="Keys").count() == 0
    assert page.get_by_text("need a key with admin access to all maps").is_visible()
    assert page.locator("#operations-map option").all_inner_texts() == ["building"]
    assert page.get_by_role("heading", name="Workers").count() == 0
    use = page.get_by_role("region", name="Quota and retention")
    assert use.locator("dd").all_inner_texts()[::2] == ["16 of 20", "400 days"]
    assert use.locator(".gauge[data-kind]").count() == 0  # a fifth is left
    assert axe(page) == []
    page.get_by_role("link", name="Jobs").click()
    settle(page)
    assert page.locator(".job").count() > 0
    assert page.get_by_role("button", name="Retry all dead").count() == 0  # it may read


@pytest.mark.thorough
def test_keys_are_made_shown_once_and_withdrawn(station, page, settle, axe):
    page.goto(f"{station.home}#/operations?tab=keys")
    settle(page)
    is_first = not station.client.get("/v1/keys").json()["items"]
    page.get_by_role("button", name="Create a key").click()
    scope = page.get_by_role("combobox", name="Scope")
    assert scope.input_value() == ("admin" if is_first else "read")
    page.get_by_label("Name of its user").fill("robot/7")
    page.get_by_role("combobox", name="Map").fill("no such name")
    page.get_by_role("button", name="Create key").click()
    page.allowed.append("422")
    page.get_by_role("alert").filter(has_text="grants").wait_for()
    assert axe(page) == []
    page.get_by_role("combobox", name="Map").fill("building")
    scope.select_option("write")
    page.get_by_role("button", name="Create key").click()
    secret = page.get_by_label("Secret").input_value()
    shown = {"Authorization": f"Bearer {secret}", "X-Forwarded-For": "192.0.2.7"}
    me = httpx.get(f"{station.url}/v1/keys/me", headers=shown).json()
    assert (me["name"], me["grants"]) == ("robot/7", {"building": "write"})
    page.get_by_role("button", name="I have stored it").click()
    assert secret not in page.content()
    row = page.get_by_role("row", name="robot/7")
    cells = row.get_by_role("cell").all_inner_texts()  # its tenant has its name
    assert (cells[0], "building: write" in cells[1]) == ("robot/7", True)
    row.get_by_role("button", name="Revoke").click()
    page.get_by_role("dialog").get_by_role("textbox").fill("robot/7")
    page.get_by_role("dialog").get_by_role("button", name="Revoke").click()
    row.wait_for(state="detached")
    assert httpx.get(f"{station.url}/v1/keys/me", headers=shown).status_code == 401
    assert axe(page) == []
