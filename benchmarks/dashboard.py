"""How soon a person sees something: the dashboard in a real browser, with nothing in its cache.

`python -m benchmarks.dashboard` measures this row alone.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import httpx

from benchmarks.chromium import chromium, installed, settled, until, watched
from benchmarks.rooms import Shot, fuse, multiply, send, shots, wait
from sceneprint_lab.cli.demo import serving

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

MAP, LARGE = "building", "large"
RUNS, FRAMES = 5, 100_000
#: The slow network: bytes a second either way, and milliseconds until an answer begins.
SLOW = {"downloadThroughput": 1.25e6, "uploadThroughput": 1.25e6, "latency": 40}
#: The canvas whose drawing is timed, CSS pixels, and how often it is drawn.
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


@dataclass(frozen=True)
class DashboardFigures:
    """Medians of as many loads as `runs`, each with an empty cache.

    `first`, `slow`: seconds until the first page is usable, on loopback and on the slow network;
    `code`: bytes of its HTML, CSS and JavaScript as they are sent; `overlay`: seconds until two
    clouds are drawn; `overlay_bytes`: of all that came for it; `points`: of both clouds;
    `drawing`: milliseconds to draw them once, antialiased; `idle`: how often that was done in a
    second in which nothing moved; `place`: seconds until the surface of a map is drawn as fine as
    its first view needs; `place_bytes`: of all that came for it; `cells`: that are drawn;
    `place_drawing`, `place_idle`: as `drawing` and `idle`; `gallery`: seconds until the newest
    frames of a map of `frames` frames are there with their pictures; `gallery_bytes`: of all that
    came for it; `faults`: what pages said in the console, and requests to other places.
    """

    runs: int
    first: float
    slow: float
    code: int
    overlay: float
    overlay_bytes: int
    points: int
    drawing: float
    idle: int
    place: float
    place_bytes: int
    cells: int
    place_drawing: float
    place_idle: int
    frames: int
    gallery: float
    gallery_bytes: int
    faults: int


@dataclass(frozen=True)
class Load:
    """One load of a page: seconds, bytes as sent of its code and of all, and faults."""

    seconds: float
    code: int
    bytes: int
    faults: list[str]


def measure(frames: int = FRAMES, runs: int = RUNS) -> DashboardFigures | None:
    """Fill a service, and look at it; None where no Chromium is installed.

    Parameters
    ----------
    frames : of the large map
    runs : loads of each page
    """
    path = installed()
    if path is None:
        return None
    made = shots((0, 1), 8)
    with TemporaryDirectory() as folder, chromium(path) as browser:
        data = Path(folder)
        with serving(data, workers=2) as url, httpx.Client(base_url=url, timeout=60) as client:
            _make(client, MAP)
            send(client, MAP, made)
            wait(client, f"/v1/maps/{MAP}", {"indexed"})
            fuse(client, MAP)
            pages = look(browser, url, _match(client, MAP, made), runs)
            place = visit(browser, url, MAP, runs)
        multiply(data, MAP, LARGE, frames)
        with serving(data, workers=0) as url:
            gallery, shown = browse(browser, url, LARGE, runs)
    return _figures(runs, *pages, place, frames, gallery, shown)


def _make(client: httpx.Client, name: str) -> None:
    client.post("/v1/maps", json={"name": name, "model": "depth"}).raise_for_status()


def _match(client: httpx.Client, name: str, made: list[Shot]) -> str:
    """Ask for a frame with one that is near it; the address of their overlay."""
    camera = {"intrinsics": made[3].meta["intrinsics"]}
    files = {"frame": (made[3].name, made[3].data, "image/png")}
    answer = client.post(
        f"/v1/maps/{name}/queries", data={"meta": json.dumps(camera), "k": "2"}, files=files
    )
    found = answer.raise_for_status().json()
    match = found["matches"][-1]["frame_id"]
    return f"#/queries/{found['query_id']}/matches/{match}?map={name}"


def look(
    browser: Browser, url: str, overlay: str, runs: int
) -> tuple[list[Load], list[Load], list[Load], dict[str, Any]]:
    """Load the first page on both networks, and an overlay; and draw that again and again.

    Parameters
    ----------
    browser : see `chromium`
    url : of the service
    overlay : its address behind the dashboard's
    runs : loads of each
    """
    home = f"{url}/dashboard"
    first = [_load(browser, home, _is_there) for _ in range(runs)]
    slow = [_load(browser, home, _is_there, slow=True) for _ in range(runs)]
    drawn: dict[str, Any] = {}

    def overlaid(page: Page) -> float:
        when = 'performance.getEntriesByName("overlay")[0]?.startTime ?? null'
        return float(until(page, when))

    def draw(page: Page) -> None:
        drawn.update(page.evaluate(_DRAW, [*CANVAS, DRAWN, "canvas.overlay-canvas"]))
        drawn["points"] = _points(page)

    both = [
        _load(browser, home + overlay, overlaid, then=draw if i == runs - 1 else None)
        for i in range(runs)
    ]
    return first, slow, both, drawn


def visit(
    browser: Browser, url: str, name: str, runs: int
) -> tuple[list[Load], dict[str, Any]]:  # fmt: skip
    """Load the place of a map whose surface is built; and draw it again and again."""
    drawn: dict[str, Any] = {}

    def placed(page: Page) -> float:
        when = 'performance.getEntriesByName("place")[0]?.startTime ?? null'
        return float(until(page, when))

    def draw(page: Page) -> None:
        settled(page)
        drawn.update(page.evaluate(_DRAW, [*CANVAS, DRAWN, "canvas.paths-canvas"]))
        drawn["cells"] = page.evaluate(_CELLS)

    address = f"{url}/dashboard#/maps/{name}/place"
    loads = [
        _load(browser, address, placed, then=draw if i == runs - 1 else None) for i in range(runs)
    ]
    return loads, drawn


def browse(browser: Browser, url: str, name: str, runs: int) -> tuple[list[Load], int]:
    """Load the gallery of a map; also how many pictures the first page of it shows."""
    shown: list[int] = []

    def pictured(page: Page) -> float:
        settled(page)
        ready = """Promise.all([...document.querySelectorAll("canvas.picture")].map((one) =>
          one.ready)).then((all) => [all.filter(Boolean).length, performance.now()])"""
        until(page, "document.querySelectorAll('canvas.picture').length > 0")
        drawn, when = page.evaluate(ready)
        shown.append(drawn)
        return float(when)

    address = f"{url}/dashboard#/maps/{name}"
    return [_load(browser, address, pictured) for _ in range(runs)], min(shown)


def _is_there(page: Page) -> float:
    """The first page is usable when its maps are there."""
    when = settled(page)
    until(page, f"document.getElementById('main').textContent.includes('{MAP}')")
    return when


def _points(page: Page) -> int:
    """Points of both clouds, by what was said of them in the header of each."""
    sizes = """(async () => { const {parsePoints} = await import("/dashboard/viewer/points.js");
      const all = performance.getEntriesByType("resource").map((one) => one.name)
        .filter((name) => new URL(name).pathname.endsWith("/points"));
      const found = await Promise.all(all.slice(0, 2).map((name) => fetch(name, {headers:
        {Accept: "application/vnd.sceneprint.points"}}).then((one) => one.arrayBuffer())));
      return found.reduce((sum, one) => sum + parsePoints(one).count, 0); })()"""
    return int(page.evaluate(sizes))


def _load(
    browser: Browser, address: str, ready: Callable[[Page], float], *, slow: bool = False,
    then: Callable[[Page], None] | None = None,
) -> Load:  # fmt: skip
    """Load a page in a context of its own, whose cache is empty."""
    context = browser.new_context(viewport={"width": 1280, "height": 800})
    try:
        page = watched(context.new_page())
        faults: list[str] = []
        came: list[Any] = []
        page.on("console", lambda one: _heard(faults, one))
        page.on("pageerror", lambda one: faults.append(str(one)))
        page.on("requestfinished", lambda one: came.append(one))
        if slow:
            network = context.new_cdp_session(page)
            network.send("Network.enable")
            network.send("Network.emulateNetworkConditions", {"offline": False, **SLOW})
        page.goto(address)
        seconds = ready(page) / 1000
        home = urlsplit(address)
        faults += [one.url for one in came if urlsplit(one.url).netloc != home.netloc]
        sizes = [(one, one.sizes()["responseBodySize"]) for one in list(came)]
        paths = [(urlsplit(one.url).path, n) for one, n in sizes]
        # not the picture in the tab, which the browser fetches when it likes
        code = sum(n for p, n in paths if p.startswith(home.path) and not p.endswith(".svg"))
        load = Load(seconds, code, sum(n for _, n in sizes), list(faults))
        if then is not None:
            then(page)
        return load
    finally:
        context.close()


def _heard(faults: list[str], message: Any) -> None:
    # without a graphics card Chromium says of itself that reading what was drawn is slow
    if message.type in ("error", "warning") and "GL Driver Message" not in message.text:
        faults.append(message.text)


def _figures(
    runs: int, first: list[Load], slow: list[Load], both: list[Load], drawn: dict[str, Any],
    place: tuple[list[Load], dict[str, Any]], frames: int, gallery: list[Load], shown: int,
) -> DashboardFigures:  # fmt: skip
    places, surface = place
    if drawn["size"] != list(CANVAS) or not drawn["smooth"]:
        raise AssertionError(f"another canvas was drawn than the one that is asked for: {drawn}")
    if shown == 0:
        raise AssertionError("the gallery shows no picture")
    return DashboardFigures(
        runs=runs,
        first=_seconds(first),
        slow=_seconds(slow),
        code=max(one.code for one in first),
        overlay=_seconds(both),
        overlay_bytes=_size(both),
        points=drawn["points"],
        drawing=statistics.median(drawn["taken"]),
        idle=drawn["idle"],
        place=_seconds(places),
        place_bytes=_size(places),
        cells=surface["cells"],
        place_drawing=statistics.median(surface["taken"]),
        place_idle=surface["idle"],
        frames=frames,
        gallery=_seconds(gallery),
        gallery_bytes=_size(gallery),
        faults=sum(len(one.faults) for one in (*first, *slow, *both, *places, *gallery)),
    )


def _seconds(loads: list[Load]) -> float:
    return statistics.median(one.seconds for one in loads)


def _size(loads: list[Load]) -> int:
    return round(statistics.median(one.bytes for one in loads))


def table(f: DashboardFigures | None) -> list[str]:
    """The figures as lines of Markdown, beside what is asked for."""
    lines = ["### The dashboard in Chromium", ""]
    if f is None:
        return [*lines, "Not measured: no Chromium is installed.", ""]
    width, height = CANVAS
    return [
        *lines,
        f"Without a window or a graphics card (SwiftShader), cache empty, median of {f.runs}; "
        "service and browser share the processors.",
        "",
        "| | measured | asked |",
        "|---|--:|--:|",
        f"| first page usable, loopback | {f.first:.2f} s | 1.0 s |",
        f"| first page usable, 10 Mbit/s and 40 ms | {f.slow:.2f} s | 2.0 s |",
        f"| code of the first page, compressed | {f.code / 1000:.1f} kB | 35 kB |",
        f"| overlay of {f.points:,} points ready | {f.overlay:.2f} s | 1.2 s |",
        f"| all that came for it | {f.overlay_bytes / 1000:.0f} kB | 700 kB |",
        f"| drawing it, {width} x {height}, antialiased | {f.drawing:.0f} ms | 150 ms |",
        f"| drawn again in a second without a change | {f.idle} | 0 |",
        f"| the place, {f.cells:,} cells, drawn | {f.place:.2f} s | 1.5 s |",
        f"| all that came for it | {f.place_bytes / 1000:.0f} kB | |",
        f"| drawing it, {width} x {height} | {f.place_drawing:.0f} ms | 50 ms |",
        f"| drawn again in a second without a change | {f.place_idle} | 0 |",
        f"| first page of {f.frames:,} frames, with its pictures | {f.gallery:.2f} s | |",
        f"| all that came for it | {f.gallery_bytes / 1000:.0f} kB | |",
        f"| requests elsewhere, violations, errors in the console | {f.faults} | 0 |",
        "",
    ]


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=FRAMES)
    parser.add_argument("--runs", type=int, default=RUNS)
    options = parser.parse_args()
    found = measure(options.frames, options.runs)
    print("\n".join(table(found)))
    print(json.dumps(None if found is None else asdict(found)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
