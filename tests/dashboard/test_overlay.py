"""Tests of the overlay page against the API, and of the drawn points."""

from decimal import ROUND_HALF_UP, Decimal

import numpy as np
import pytest

from sceneprint_client.surface_encoding import HEADER, POINT


def ask(station, frame, **more):
    body = {"frame_id": station.frames[frame].frame_id, "seed": 1, **more}
    reply = station.client.post("/v1/maps/building/queries", json=body)
    assert reply.status_code == 200, reply.text
    return reply.json()


def address(station, answer, match, **search):
    query = "&".join(f"{k}={v}" for k, v in {"map": match["map"], **search}.items())
    return f"{station.home}#/queries/{answer['query_id']}/matches/{match['frame_id']}?{query}"


def residuals(station, answer, match, by):
    """Of all points of both sides, as the API tells them."""
    parts = []
    for side in ("query", "match"):
        path = f"/v1/queries/{answer['query_id']}/matches/{match['frame_id']}/points"
        data = station.client.get(path, params={"side": side, "transform": by}).content
        parts.append(np.frombuffer(data, POINT, offset=HEADER.size)["residual"])
    return np.concatenate(parts)


def text(page, what):
    return page.locator(what).inner_text()


def figures(page):
    """The evidence as it is shown."""
    rows = page.locator(".overlay-numbers > div").all()
    return {row.locator("dt").inner_text(): row.locator(".number").inner_text() for row in rows}


def percent(x):
    share = 100 * x
    step = Decimal(1).scaleb(-(2 if 0 < share < 1 else 1 if share < 10 else 0))
    return f"{Decimal(share).quantize(step, ROUND_HALF_UP)} %"  # as toFixed, not to even


def matrix(page):
    """By which the query is drawn."""
    values = page.evaluate("document.querySelector('.overlay-canvas').scene.matrix")
    return np.array(values).reshape(4, 4).T


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
    rows = figures(page)
    assert rows["Overlap"] == percent(v["overlap"])
    assert rows["Plane overlap"] == percent(v["plane_overlap"])
    assert rows["Inliers"].startswith(f"{v['inliers']:,} of ")
    assert rows["Violations"] == percent(v["free_space_violations"])
    assert rows["Ambiguity"] == percent(v["ambiguity"])
    assert text(page, ".overlay-verdict") == f"accepted, {v['strength']}"
    assert text(page, ".overlay-reason").lower() == f"{v['reason']}.".lower()
    path = f"/v1/queries/{answer['query_id']}/matches/{best['frame_id']}"
    details = station.client.get(path).json()
    assert rows["Patches"] == f"{len(details['patches']['query']):,}"
    assert "All six directions are constrained" in text(page, ".overlay-side")
    T = np.array(details["transform"]["matrix"])
    assert matrix(page) == pytest.approx(T)
    shift = np.linalg.norm(T[:3, 3])
    moves = page.locator(".overlay-card", has_text="The query moves").locator("strong").first
    assert moves.inner_text() in (f"{1000 * shift:.0f} mm", f"{shift:.2f} m")
    page.get_by_role("button", name="Residual").click()
    settle(page)
    result = residuals(station, answer, best, "aligned")
    legend = text(page, ".overlay-legend")
    for words, share in (
        ("within 10 mm", (result <= 50).mean()),
        ("within 20 mm", ((result > 50) & (result <= 100)).mean()),
        ("the other sensor saw through", (result == 254).mean()),
        ("farther, hidden, or outside the view of the other", (result == 253).mean()),
    ):  # fmt: skip
        assert f"{words} {percent(share)}" in legend
    assert axe(page) == []


@pytest.mark.thorough
def test_before_after_and_what_is_drawn(page, station, answer, settle, pixels, until):
    def details_of(match):
        path = f"/v1/queries/{answer['query_id']}/matches/{match['frame_id']}"
        return station.client.get(path, params={"map": "building"}).json()

    def refuted(details):
        return all(len(details[side]["violations"]) > 5 for side in ("query", "match"))

    details = next(one for one in map(details_of, reversed(answer["matches"])) if refuted(one))
    assert details["validation"]["status"] == "rejected"
    page.goto(address(station, answer, details))
    settle(page)
    canvas = page.locator(".overlay-canvas")
    T = np.array(details["transform"]["matrix"])

    def shown():
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
