"""Measure page loads and drawings of the dashboard in a browser with an empty cache."""

from __future__ import annotations

import json
import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import httpx

from benchmarks.chromium import chromium, installed, settled, until, watch_page
from benchmarks.rooms import Shot, fuse, multiply, send, shots, wait
from sceneprint_lab.cli.demo import serving

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

MAP, LARGE = "building", "large"
RUNS, FRAMES = 5, 100_000
#: Slow network: bytes per second in either direction, and latency in milliseconds.
SLOW = {"downloadThroughput": 1.25e6, "uploadThroughput": 1.25e6, "latency": 40}
#: Size of the measured canvas, CSS pixels, and number of measured drawings.
CANVAS, DRAWN = (900, 600), 20
_DRAW = """async ([width, height, times, of]) => {
  const canvas = document.querySelector(of), viewer = canvas.viewer;
  for (const [name, size] of [["width", width], ["height", height]])
    canvas.style.setProperty(name, `${size}px`, "important");
  const frame = () => new Promise((done) => requestAnimationFrame(done));
  for (let i = 0; i < 5; i += 1) await frame();
  const taken = [];
  for (let i = 0; i < times; i += 1) {
    viewer.orbit.azimuth += 0.1;
    taken.push(viewer.timing());
    await frame();
  }
  for (let i = 0; i < 5; i += 1) await frame();
  const before = viewer.frames;
  await new Promise((done) => setTimeout(done, 1000));
  return {taken, idle: viewer.frames - before, size: [canvas.clientWidth, canvas.clientHeight],
    smooth: canvas.getContext("webgl2").getContextAttributes().antialias};
}"""
_CELLS = """document.querySelector("canvas.paths-canvas").viewer.layer("surface")
  .tiles.reduce((sum, one) => sum + one.data.byteLength / 8, 0)"""


#: Time at which the page set a mark, milliseconds after navigation.
_MARKED = 'performance.getEntriesByName("{}")[0]?.startTime ?? null'
_PICTURES = """Promise.all([...document.querySelectorAll("canvas.picture")].map((one) =>
  one.ready)).then((all) => [all.filter(Boolean).length, performance.now()])"""
#: Number of points of both clouds of an overlay, from their headers.
_POINTS = """(async () => { const {parsePoints} = await import("/dashboard/viewer/points.js");
  const all = performance.getEntriesByType("resource").map((one) => one.name)
    .filter((name) => new URL(name).pathname.endsWith("/points"));
  const found = await Promise.all(all.slice(0, 2).map((name) => fetch(name, {headers:
    {Accept: "application/vnd.sceneprint.points"}}).then((one) => one.arrayBuffer())));
  return found.reduce((sum, one) => sum + parsePoints(one).count, 0); })()"""


@dataclass(frozen=True)
class Load:
    """A page load: seconds until it was ready, bytes of code and in total, console messages, and
    requests to other hosts.
    """

    seconds: float
    code: int
    bytes: int
    faults: list[str]


def measure(frames: int = FRAMES, runs: int = RUNS) -> list[str]:
    """Fill a service, load its dashboard, and return the table.

    Parameters
    ----------
    frames : number of frames of the large map
    runs : number of loads of each page; the table has their medians
    """
    path, lines = installed(), ["### The dashboard in Chromium", ""]
    if path is None:
        return [*lines, "Not measured: no Chromium is installed.", ""]
    views = shots((0, 1), 8)
    with TemporaryDirectory() as folder, chromium(path) as browser:
        data = Path(folder)
        with serving(data, workers=2) as url, httpx.Client(base_url=url, timeout=60) as client:
            client.post("/v1/maps", json={"name": MAP, "model": "depth"}).raise_for_status()
            send(client, MAP, views)
            wait(client, f"/v1/maps/{MAP}", {"indexed"})
            fuse(client, MAP)
            home = f"{url}/dashboard"
            first = [_load(browser, home, _is_usable) for _ in range(runs)]
            slow = [_load(browser, home, _is_usable, slow=True) for _ in range(runs)]
            overlay = home + _overlay(client, views)
            both = [_load(browser, overlay, _until_mark("overlay")) for _ in range(runs)]
            clouds = _draw(browser, overlay, "overlay", "canvas.overlay-canvas", _POINTS)
            place = f"{home}#/maps/{MAP}/place"
            places = [_load(browser, place, _until_mark("place")) for _ in range(runs)]
            surface = _draw(browser, place, "place", "canvas.paths-canvas", _CELLS)
        multiply(data, MAP, LARGE, frames)
        with serving(data, workers=0) as url:
            address = f"{url}/dashboard#/maps/{LARGE}"
            gallery = [_load(browser, address, _has_pictures) for _ in range(runs)]
    faults = sum(len(load.faults) for load in (*first, *slow, *both, *places, *gallery))
    rows = {
        "first page usable, loopback": (_seconds(first), "1.0 s"),
        "first page usable, 10 Mbit/s and 40 ms": (_seconds(slow), "2.0 s"),
        "code of the first page, compressed": (
            f"{max(load.code for load in first) / 1000:.1f} kB", "35 kB"
        ),
        f"overlay of {clouds['size']:,} points ready": (_seconds(both), "1.2 s"),
        "total transfer for the overlay": (_size(both), "700 kB"),
        "drawing the overlay, {} x {}, antialiased".format(*CANVAS): (_draw_time(clouds), "150 ms"),
        "drawings per second without a change": (clouds["idle"], "0"),
        f"the place, {surface['size']:,} cells, drawn": (_seconds(places), "1.5 s"),
        "total transfer for the place": (_size(places), ""),
        "drawing the place, {} x {}".format(*CANVAS): (_draw_time(surface), "50 ms"),
        "drawings of the place per second without a change": (surface["idle"], "0"),
        f"first page of {frames:,} frames, with pictures": (_seconds(gallery), ""),
        "total transfer for the first page": (_size(gallery), ""),
        "requests to other hosts, policy violations, console errors": (faults, "0"),
    }  # fmt: skip
    return [
        *lines,
        f"Headless, without a graphics card (SwiftShader), cache empty, median of {runs}; "
        "service and browser share the processors.",
        "", "| | measured | bound |", "|---|--:|--:|",
        *(f"| {what} | {value} | {aim} |" for what, (value, aim) in rows.items()), "",
    ]  # fmt: skip


def _overlay(client: httpx.Client, views: list[Shot]) -> str:
    """Query a frame near a stored frame; return the address of the overlay of both."""
    camera = {"intrinsics": views[3].meta["intrinsics"]}
    files = {"frame": (views[3].name, views[3].data, "image/png")}
    answer = client.post(
        f"/v1/maps/{MAP}/queries", data={"meta": json.dumps(camera), "k": "2"}, files=files
    )
    answered = answer.raise_for_status().json()
    match = answered["matches"][-1]["frame_id"]
    return f"#/queries/{answered['query_id']}/matches/{match}?map={MAP}"


# Waits for pages, which return the time since navigation, milliseconds.


def _is_usable(page: Page) -> float:
    """Wait until the first page lists its maps."""
    when = settled(page)
    until(page, f"document.getElementById('main').textContent.includes('{MAP}')")
    return when


def _until_mark(name: str) -> Callable[[Page], float]:
    return lambda page: float(until(page, _MARKED.format(name)))


def _has_pictures(page: Page) -> float:
    settled(page)
    until(page, "document.querySelectorAll('canvas.picture').length > 0")
    drawn, when = page.evaluate(_PICTURES)
    if not drawn:
        raise AssertionError("the gallery shows no picture")
    return float(when)


def _load(
    browser: Browser, address: str, ready: Callable[[Page], float], *, slow: bool = False
) -> Load:
    """Load a page in a new context, whose cache is empty."""
    context = browser.new_context(viewport={"width": 1280, "height": 800})
    try:
        page = watch_page(context.new_page())
        faults: list[str] = []
        came: list[Any] = []
        page.on("console", lambda message: _record_message(faults, message))
        page.on("pageerror", lambda error: faults.append(str(error)))
        page.on("requestfinished", lambda request: came.append(request))
        if slow:
            network = context.new_cdp_session(page)
            network.send("Network.enable")
            network.send("Network.emulateNetworkConditions", {"offline": False, **SLOW})
        page.goto(address)
        seconds = ready(page) / 1000
        home = urlsplit(address)
        faults += [request.url for request in came if urlsplit(request.url).netloc != home.netloc]
        sizes = [(urlsplit(r.url).path, r.sizes()["responseBodySize"]) for r in list(came)]
        # Exclude the icon, which the browser fetches at a random time.
        code = sum(n for p, n in sizes if p.startswith(home.path) and not p.endswith(".svg"))
        return Load(seconds, code, sum(n for _, n in sizes), list(faults))
    finally:
        context.close()


def _draw(browser: Browser, address: str, mark: str, canvas: str, size: str) -> dict[str, Any]:
    """Measure drawings of a canvas; `size` is an expression for the number of points or cells."""
    context = browser.new_context(viewport={"width": 1280, "height": 800})
    try:
        page = watch_page(context.new_page())
        page.goto(address)
        until(page, _MARKED.format(mark))
        settled(page)
        drawn: dict[str, Any] = page.evaluate(_DRAW, [*CANVAS, DRAWN, canvas])
        # Only clouds are antialiased.
        if drawn["size"] != list(CANVAS) or drawn["smooth"] != (mark == "overlay"):
            raise AssertionError(f"the wrong canvas was drawn: {drawn}")
        return drawn | {"size": int(page.evaluate(size))}
    finally:
        context.close()


def _record_message(faults: list[str], message: Any) -> None:
    # Without a graphics card, Chromium warns that reading pixels is slow.
    if message.type in ("error", "warning") and "GL Driver Message" not in message.text:
        faults.append(message.text)


def _seconds(loads: Sequence[Load]) -> str:
    return f"{statistics.median(load.seconds for load in loads):.2f} s"


def _size(loads: Sequence[Load]) -> str:
    return f"{statistics.median(load.bytes for load in loads) / 1000:.0f} kB"


def _draw_time(drawn: dict[str, Any]) -> str:
    return f"{statistics.median(drawn['taken']):.0f} ms"
