"""Tests of the overlay page against the API, and of the drawn points."""

from __future__ import annotations

import io
import json
from decimal import ROUND_HALF_UP, Decimal
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from PIL import Image

from sceneprint_client.surface_encoding import HEADER, POINT

if TYPE_CHECKING:
    from playwright.sync_api import Page


def ask(station: Any, frame: int, **more: object) -> dict[str, Any]:
    body = {"frame_id": station.frames[frame].frame_id, "seed": 1, **more}
    reply = station.client.post("/v1/maps/building/queries", json=body)
    assert reply.status_code == 200, reply.text
    answer: dict[str, Any] = reply.json()
    return answer


def address(station: Any, answer: dict[str, Any], match: dict[str, Any], **search: str) -> str:
    query = "&".join(f"{k}={v}" for k, v in {"map": match["map"], **search}.items())
    return f"{station.home}#/queries/{answer['query_id']}/matches/{match['frame_id']}?{query}"


def residuals(station: Any, answer: dict[str, Any], match: dict[str, Any], by: str) -> Any:
    """Of all points of both sides, as the API tells them."""
    told = []
    for side in ("query", "match"):
        path = f"/v1/queries/{answer['query_id']}/matches/{match['frame_id']}/points"
        data = station.client.get(path, params={"side": side, "transform": by}).content
        told.append(np.frombuffer(data, POINT, offset=HEADER.size)["residual"])
    return np.concatenate(told)


def text(page: Page, what: str) -> str:
    return page.locator(what).inner_text()


def figures(page: Page) -> dict[str, str]:
    """The evidence as it is shown."""
    rows = page.locator(".overlay-numbers > div").all()
    return {row.locator("dt").inner_text(): row.locator(".number").inner_text() for row in rows}


def percent(x: float) -> str:
    share = 100 * x
    step = Decimal(1).scaleb(-(2 if 0 < share < 1 else 1 if share < 10 else 0))
    return f"{Decimal(share).quantize(step, ROUND_HALF_UP)} %"  # as toFixed, not to even


def matrix(page: Page) -> Any:
    """By which the query is drawn."""
    told = page.evaluate("document.querySelector('.overlay-canvas').scene.matrix")
    return np.array(told).reshape(4, 4).T


@pytest.fixture(scope="module")
def answer(station):
    """Of a frame in the middle of the first room; the first match is accepted, others are not."""
    return ask(station, 3, k=3)


@pytest.mark.thorough
def test_what_is_shown_is_what_the_api_says(page, station, answer, settle, axe):
    best = answer["matches"][0]
    page.goto(address(station, answer, best))
    settle(page)
    v = best["validation"]
    told = figures(page)
    assert told["Overlap"] == percent(v["overlap"])
    assert told["Plane overlap"] == percent(v["plane_overlap"])
    assert told["Inliers"].startswith(f"{v['inliers']:,} of ")
    assert told["Violations"] == percent(v["free_space_violations"])
    assert told["Ambiguity"] == percent(v["ambiguity"])
    assert text(page, ".overlay-verdict") == f"accepted, {v['strength']}"
    assert text(page, ".overlay-reason").lower() == f"{v['reason']}.".lower()
    path = f"/v1/queries/{answer['query_id']}/matches/{best['frame_id']}"
    details = station.client.get(path).json()
    assert told["Patches"] == f"{len(details['patches']['query']):,}"
    assert "All six directions are constrained" in text(page, ".overlay-side")
    T = np.array(details["transform"]["matrix"])
    assert matrix(page) == pytest.approx(T)
    shift = np.linalg.norm(T[:3, 3])
    moves = page.locator(".overlay-card", has_text="The query moves").locator("strong").first
    assert moves.inner_text() in (f"{1000 * shift:.0f} mm", f"{shift:.2f} m")
    page.get_by_role("button", name="Residual").click()
    settle(page)
    found = residuals(station, answer, best, "aligned")
    legend = text(page, ".overlay-legend")
    for words, share in (
        ("within 10 mm", (found <= 50).mean()),
        ("within 20 mm", ((found > 50) & (found <= 100)).mean()),
        ("the other sensor saw through", (found == 254).mean()),
        ("farther, hidden, or outside the view of the other", (found == 253).mean()),
    ):  # fmt: skip
        assert f"{words} {percent(share)}" in legend
    assert axe(page) == []


@pytest.mark.thorough
def test_before_after_and_what_is_drawn(page, station, answer, settle, pixels, until):
    def told(match: dict[str, Any]) -> dict[str, Any]:
        path = f"/v1/queries/{answer['query_id']}/matches/{match['frame_id']}"
        reply: dict[str, Any] = station.client.get(path, params={"map": "building"}).json()
        return reply

    def refuted(details: dict[str, Any]) -> bool:
        return all(len(details[side]["violations"]) > 5 for side in ("query", "match"))

    details = next(one for one in map(told, reversed(answer["matches"])) if refuted(one))
    assert details["validation"]["status"] == "rejected"
    page.goto(address(station, answer, details))
    settle(page)
    canvas = page.locator(".overlay-canvas")
    T = np.array(details["transform"]["matrix"])

    def shown() -> bytes:
        page.wait_for_timeout(120)
        return bytes(pixels(canvas).tobytes())

    aligned = shown()
    page.emulate_media(reduced_motion="reduce")
    canvas.focus()
    page.keyboard.press("b")
    until(lambda: np.allclose(matrix(page), np.eye(4)))
    before = shown()
    assert before != aligned
    assert "pose=before" in page.url
    page.locator(".overlay-slide").fill("50")
    half = matrix(page)
    assert half[:3, 3] == pytest.approx(T[:3, 3] / 2)
    assert half[:3, :3] @ half[:3, :3] == pytest.approx(T[:3, :3], abs=1e-6)
    page.get_by_role("button", name="Aligned").click()
    until(lambda: np.allclose(matrix(page), T))
    assert shown() == aligned
    for name in ("Query", "Match", "Patches", "Violations", "Sensors"):
        button = page.get_by_role("group", name="Layers").get_by_role("button", name=name)
        button.click()
        assert shown() != aligned, name
        button.click()
        assert shown() == aligned, name
    # the colours of the two clouds, and red where the other saw through
    picture = np.asarray(pixels(canvas)).astype(int)
    tokens = page.evaluate(
        "['query', 'match', 'violation'].map((one) => getComputedStyle(document.documentElement)"
        ".getPropertyValue(`--${one}`).trim())"
    )
    violations = sum(len(details[side]["violations"]) for side in ("query", "match"))
    assert violations > 0
    assert f"{violations:,} of " in text(page, ".overlay-legend")
    for token in tokens:
        colour = np.array([int(token[i : i + 2], 16) for i in (1, 3, 5)])
        shares = picture / np.maximum(colour, 1)  # a shade of it
        near = (shares.max(axis=2) - shares.min(axis=2) < 0.12) & (shares.mean(axis=2) < 1.05)
        assert (near & (shares.mean(axis=2) > 0.5)).sum() > 30, token
    page.reload()
    settle(page)
    assert shown() == aligned


@pytest.mark.thorough
def test_the_file_is_what_is_shown(page, station, answer, settle):
    best = answer["matches"][0]
    page.goto(address(station, answer, best, pose="before", colour="normal"))
    settle(page)
    with page.expect_download() as waited:
        page.get_by_role("button", name="Download PLY").click()
    path = f"/v1/queries/{answer['query_id']}/matches/{best['frame_id']}/overlay.ply"
    sent = station.client.get(path, params={"color": "normal", "transform": "none"})
    assert Path(waited.value.path()).read_bytes() == sent.content
    assert waited.value.suggested_filename.endswith("before-normal.ply")


def box(ahead: float) -> dict[str, Any]:
    """An empty room seen along its middle: upside down it looks the same."""
    v, u = np.mgrid[:240, :320]
    x, y = abs(u - 159.5) / 292.5, abs(v - 119.5) / 292.5
    depth = np.minimum.reduce([1.5 / np.maximum(x, 1e-6), 1.1 / y, np.full(x.shape, 3.2 - ahead)])
    file = io.BytesIO()
    Image.fromarray((depth * 1000).round().astype(np.uint16)).save(file, "PNG")
    lens = {"width": 320, "height": 240, "fx": 292.5, "fy": 292.5, "cx": 159.5, "cy": 119.5}
    parts = {"frame": ("box.png", file.getvalue(), "image/png")}
    return {"files": parts, "data": {"meta": json.dumps({"intrinsics": lens})}}


@pytest.mark.thorough
def test_an_ambiguous_match_has_its_rival(page, station, settle, axe, until, pixels):
    path = station.make_map("boxes")
    added = station.client.post(f"{path}/frames", **box(0), headers={"Prefer": "wait=200"})
    assert added.json()["state"] == "indexed", added.text
    answer = station.client.post(f"{path}/queries", **box(0.3)).json()
    assert answer["status"] == "ambiguous"
    match = answer["matches"][0]
    page.goto(address(station, answer, match))
    settle(page)
    assert text(page, ".overlay-verdict") == "ambiguous"
    card = page.locator(".overlay-card", has_text="Rival pose")
    assert f"Another pose explains {percent(match['validation']['ambiguity'])}" in card.inner_text()
    for column, by in ((0, "aligned"), (1, "rival")):
        found = residuals(station, answer, match, by)
        row = card.locator("tbody tr").first.locator("td").nth(column)
        assert row.inner_text() == percent((found <= 250).mean())
    page.emulate_media(reduced_motion="reduce")
    # residuals are of the pose that is shown: while its own have not come, none are
    waiting: list[Any] = []
    page.route("**/points*transform=rival*", lambda route: waiting.append(route))
    page.reload()
    until(lambda: page.evaluate("true") and len(waiting) == 2)  # routes are heard of in a call
    page.get_by_role("button", name="Rival").click()
    page.get_by_role("button", name="Residual").click()

    def green() -> int:
        page.wait_for_timeout(120)
        picture = np.asarray(pixels(page.locator(".overlay-canvas"))).astype(int)
        return int((abs(picture - (38, 130, 60)).max(axis=2) <= 2).sum())

    assert "Comparing points" in text(page, ".overlay-legend")
    assert green() == 0
    for route in waiting:
        route.continue_()
    page.unroute("**/points*transform=rival*")
    until(lambda: "Comparing" not in text(page, ".overlay-legend"))
    assert green() > 30
    page.get_by_role("button", name="Source").click()
    page.get_by_role("button", name="Aligned").click()
    page.get_by_role("button", name="Rival").click()
    details = f"/v1/queries/{answer['query_id']}/matches/{match['frame_id']}"
    rival = np.array(station.client.get(details).json()["rival"]["matrix"])
    until(lambda: np.allclose(matrix(page), rival))
    assert axe(page) == []
    # of a scrap of wall there is no hypothesis at all
    v, u = np.mgrid[:240, :320]
    scrap = np.where((abs(u - 160) < 16) & (abs(v - 120) < 16), 1500, 0).astype(np.uint16)
    file, form = io.BytesIO(), box(0)
    Image.fromarray(scrap).save(file, "PNG")
    form["files"] = {"frame": ("scrap.png", file.getvalue(), "image/png")}
    lost = station.client.post(f"{path}/queries", **form).json()
    assert lost["matches"][0]["transform"] is None
    page.goto(address(station, lost, lost["matches"][0]))
    settle(page)
    assert "No transform was found" in text(page, ".overlay-side")
    assert "No transform." in text(page, ".overlay-none")
    assert page.get_by_role("button", name="Aligned").is_disabled()
    assert matrix(page).tolist() == np.eye(4).tolist()


@pytest.mark.thorough
def test_without_webgl_the_numbers_are_still_there(open_page, station, answer, settle):
    page = open_page(viewport={"width": 768, "height": 1024})
    page.add_init_script(
        "const get = HTMLCanvasElement.prototype.getContext;"
        "HTMLCanvasElement.prototype.getContext = function (kind, ...more) {"
        " return kind === 'webgl2' ? null : get.call(this, kind, ...more); };"
    )
    page.goto(address(station, answer, answer["matches"][0]))
    settle(page)
    assert "does not support WebGL 2" in text(page, ".viewer-none")
    assert figures(page)["Overlap"] == percent(answer["matches"][0]["validation"]["overlap"])
    for canvas in page.locator(".overlay-flat canvas").all():
        colours = canvas.evaluate(
            "(c) => new Set(c.getContext('2d').getImageData(0, 0, c.width, c.height).data).size"
        )
        assert colours > 20
    assert page.evaluate("document.documentElement.scrollWidth") <= 768
