"""Tests of the shell: size of the first page, themes, keys, focus and a restarted service."""

import re

import pytest

from tests.dashboard.conftest import expect

PROXIED = {"X-Forwarded-For": "192.0.2.7"}
BUDGET = 40_000


def test_the_first_page_is_small_and_asks_for_nothing_long(station, page, settle, axe):
    code = {}
    paths = []

    def note(answer):
        path = answer.url.removeprefix(station.url).partition("?")[0]
        if path.startswith("/dashboard"):
            assert answer.headers["content-encoding"] == "gzip"
            code[path] = int(answer.headers["content-length"])
        else:
            paths.append(answer.url.removeprefix(station.url))

    page.on("response", note)
    page.goto(station.url)  # led on to the dashboard
    settle(page)
    assert page.url == station.home
    expect(page.get_by_role("heading", level=1)).to_have_text("Maps")
    expect(page).to_have_title("Maps · sceneprint")
    code.pop("/", None)
    assert sum(code.values()) <= BUDGET, code
    assert set(code) >= {"/dashboard", "/dashboard/main.js", "/dashboard/maps/maps.js"}
    # a list of frames is none of the first page's, nor of any map that is not in view
    kinds = {re.sub("/v1/maps/[^/]+/surface(/plan.png)?", "plan", path.partition("?")[0])
             for path in paths}  # fmt: skip
    assert kinds <= {
        "/", "/v1/keys/me", "/v1/maps", "/v1/jobs", "/v1/queries", "/v1/events", "plan"
    }  # fmt: skip
    assert axe(page) == []


@pytest.mark.thorough
def test_keys(station, open_page, settle, axe):
    station.make_map("secret-place")
    reader = station.key("dashboard-reader", {"building": "read"})
    late = station.key("dashboard-late", {"*": "read"}, expires_at="2026-01-01T00:00:00Z")
    page = open_page(extra_http_headers=PROXIED)  # a key is asked for
    page.allowed += ["401", "403", "404"]
    page.goto(station.home)
    settle(page)
    expect(page.get_by_role("heading", name="This service requires a key")).to_be_visible()
    assert axe(page) == []
    field = page.get_by_label("Key", exact=True)
    for wrong, message in (
        ("", "Paste a key first"), ("sp_nonsense", "unknown, revoked or expired"),
        ("schlüssel", "contains characters that keys do not have"),
        (late, "unknown, revoked or expired"),
    ):  # fmt: skip
        field.fill(wrong)
        page.keyboard.press("Enter")
        expect(page.get_by_role("alert")).to_contain_text(message)
    field.fill(f" {reader} ")
    page.keyboard.press("Enter")
    settle(page)
    # what the key may not read is not there, and what it may not do is not offered
    expect(page.locator(".map")).to_have_count(1)
    expect(page.locator(".map")).to_contain_text("Two rooms")
    expect(page.get_by_role("button", name="New map")).to_have_count(0)
    expect(page.get_by_role("button", name="Delete building")).to_have_count(0)
    expect(page.get_by_role("banner")).to_contain_text("dashboard-reader")
    # a map that it may not read is none, and the page says what it may, and takes another
    page.goto(f"{station.home}#/maps/secret-place")
    settle(page)
    expect(page.get_by_role("main")).to_contain_text("your key may not see it")
    expect(page.get_by_role("main")).to_contain_text("building: read")
    page.goto(station.home)
    page.reload()  # the tab keeps it
    settle(page)
    expect(page.locator(".map")).to_have_count(1)
    page.get_by_role("button", name="Forget").click()
    expect(page.get_by_role("heading", name="This service requires a key")).to_be_visible()
    assert page.evaluate("() => Object.keys(sessionStorage)") == []


def test_addresses_focus_and_keyboard(station, page, settle):
    page.goto(f"{station.home}#/maps/a/b/c/d")
    settle(page)
    expect(page.get_by_role("heading", name="Page not found")).to_be_visible()
    page.get_by_role("link", name="To the maps").click()
    settle(page)
    assert page.evaluate("() => document.activeElement.id") == "title"  # told as a page of its own
    page.go_back()
    settle(page)
    expect(page.get_by_role("heading", name="Page not found")).to_be_visible()
    page.go_forward()
    settle(page)
    page.reload()
    settle(page)
    page.keyboard.press("Tab")
    expect(page.get_by_role("link", name="Skip to content")).to_be_focused()
    page.keyboard.press("Enter")
    assert page.evaluate("() => document.activeElement.id") == "main"
    assert page.url == f"{station.home}#/"
    button = page.get_by_role("button", name="New map")
    button.focus()
    page.keyboard.press("Enter")
    expect(page.get_by_role("dialog")).to_be_visible()
    expect(page.get_by_role("textbox", name="Name")).to_be_focused()
    page.keyboard.press("Escape")
    expect(page.get_by_role("dialog")).to_have_count(0)
    expect(button).to_be_focused()


@pytest.mark.thorough
def test_a_service_without_maps_goes_and_comes_back(serve, free_port, page, settle, axe, tmp_path):
    page.allowed += [
        "ERR_CONNECTION_REFUSED",
        "ERR_INCOMPLETE_CHUNKED_ENCODING",
        "ERR_CONNECTION_RESET",
    ]
    with serve(tmp_path, workers=0, port=free_port) as alone:
        page.goto(alone.home)
        settle(page)
        expect(page.get_by_role("main")).to_contain_text("No maps yet")
        assert axe(page) == []
        page.get_by_role("button", name="New map").last.click()  # the one of the empty page
        page.get_by_role("textbox", name="Name").fill("first")
        page.get_by_role("radio", name="Rooms").check()
        page.get_by_role("button", name="Create map").click()
        expect(page).to_have_url(f"{alone.home}#/maps/first")
        page.goto(alone.home + "#/")
        settle(page)
        expect(page.locator(".map")).to_have_count(1)
        page.goto(alone.home + "#/operations")
        settle(page)
        health = page.locator(".health .badge").first
        expect(health).to_have_text("ready")
        page.goto(alone.home + "#/")
        settle(page)
        expect(page.locator(".map")).to_have_count(1)
    # what is shown stays, and it is said that it may be old
    expect(page.locator("#banner")).to_contain_text("does not answer")
    expect(page.locator(".map")).to_have_count(1)
    page.evaluate("() => { location.hash = '#/nowhere'; }")
    page.evaluate("() => { location.hash = '#/'; }")
    expect(page.get_by_role("main")).to_contain_text("The service does not answer")
    with serve(tmp_path, workers=0, port=free_port):
        expect(page.locator(".map")).to_have_count(1)  # by itself
        expect(page.locator("#banner")).to_be_hidden(timeout=30_000)


def test_nothing_is_wider_than_a_small_screen(station, open_page, settle):
    page = open_page(viewport={"width": 768, "height": 900})
    page.goto(station.home)
    settle(page)
    small = """() => [...document.querySelectorAll('button, nav a, .button')]
        .filter((one) => one.offsetParent && Math.min(one.offsetWidth, one.offsetHeight) < 35.5)
        .map((one) => one.outerHTML)"""
    for width in (768, 390):
        page.set_viewport_size({"width": width, "height": 900})
        assert page.evaluate("() => document.documentElement.scrollWidth") <= width
        assert page.evaluate(small) == []


@pytest.mark.thorough
def test_the_api_s_page_draws_every_operation_with_its_own_files(page, station):
    document = station.client.get("/openapi.json").json()
    operations = sum(len(path) for path in document["paths"].values())
    page.goto(station.home.replace("/dashboard", "/docs"))
    expect(page.locator(".opblock")).to_have_count(operations)
