"""Fixtures of the dashboard tests: a service with workers, and Chromium.

Playwright's event loop runs in this process while `browser` exists. The folder's stack ends it
before tests of other folders start their own loops.
"""

from __future__ import annotations

import base64
import io
import json
import os
import re
import shutil
import socket
import subprocess
import sys
import time
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from PIL import Image

from benchmarks.rooms import circled, send
from benchmarks.waiting import PATIENCE_S, until
from sceneprint.formats.dataset import write_depth_png

FLAGS = [
    "--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync",
]  # fmt: skip
#: Message of Chromium about drawing without a graphics card.
NOISE = "GL Driver Message"
VIEWPORT = {"width": 1280, "height": 800}
ROOMS, VIEWS = 2, 8
#: Capture time of the first frame; frames are one second apart.
TAKEN = "2026-11-20T09:{minute:02d}:{second:02d}Z"


def expect(what):
    """Return Playwright's assertions about a page or an element."""
    from playwright.sync_api import expect

    return expect(what)


def colours(png):
    """(h, w, 3) colours of a PNG."""
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB"))


def drawn(canvas):
    """(h, w, 3) colours of a canvas, as a PNG: a million numbers one by one would take seconds."""
    png = canvas.evaluate("(canvas) => canvas.toDataURL('image/png').split(',')[1]")
    return colours(base64.b64decode(png))


def click_at(page, point):
    """Click where a point of the picture's frame is drawn."""
    project = """p => { const { viewer, scene } = document.querySelector(".paths-canvas");
      return viewer.project(scene.near(p)); }"""
    x, y, _ = page.evaluate(project, [float(v) for v in point])
    page.locator(".paths-canvas").click(position={"x": x, "y": y})


@dataclass(frozen=True)
class Sent:
    """A depth image, with its metadata, that was uploaded to the map `building`."""

    frame_id: str
    png: bytes
    meta: dict[str, Any]

    def form(self, **fields):
        """Return the arguments of a request that sends the frame again, with only its camera."""
        details = {"intrinsics": self.meta["intrinsics"]}
        parts = {"frame": ("frame.png", self.png, "image/png")}
        return {"files": parts, "data": {"meta": json.dumps(details), **fields}}


@dataclass
class Station:
    """A service in separate processes, and the frames of its map `building` as captured."""

    url: str
    data: Path
    client: httpx.Client
    process: int
    frames: list[Sent] = field(default_factory=list)

    @property
    def home(self):
        """Address of the dashboard."""
        return f"{self.url}/dashboard"

    def key(self, name, grants, **more):
        """Create a key and return its secret."""
        answer = self.client.post("/v1/keys", json={"name": name, "grants": grants, **more})
        assert answer.status_code == 201, answer.text
        return str(answer.json()["secret"])

    def make_map(self, name, **more):
        """Create a map and return its path."""
        answer = self.client.post("/v1/maps", json={"name": name, "model": "depth", **more})
        assert answer.status_code == 201, answer.text
        return f"/v1/maps/{name}"


@contextmanager
def running(data, workers, port=0):
    """Run `sceneprint serve` on a loopback port until the context ends.

    Its workers build surfaces only on request, since most tests use none.
    """
    with (data / "service.log").open("ab") as log:
        process = subprocess.Popen(
            [sys.executable, "-m", "sceneprint", "serve", "--port", str(port),
             "--data", str(data), "--workers", str(workers)],
            stdout=subprocess.PIPE, stderr=log, text=True,
            env={**os.environ, "SCENEPRINT_BUILD_SURFACES": "on_request",
                 "SCENEPRINT_JOIN_SESSIONS": "on_request"},
        )  # fmt: skip
    assert process.stdout is not None
    try:
        line = process.stdout.readline()
        said = (data / "service.log").read_text()
        assert line.startswith("sceneprint: serving http://"), said
        url = line.split()[-1].rstrip("/")
        with httpx.Client(base_url=url, timeout=PATIENCE_S, trust_env=False) as client:
            yield Station(url, data, client, process.pid)
    finally:
        process.terminate()
        try:
            process.wait(PATIENCE_S)
        finally:
            process.kill()
            process.wait()
            process.stdout.close()


@pytest.fixture(scope="session")
def serve():
    """A function that runs a new service: `with serve(folder, workers=0, port=0) as station`."""
    return running


@pytest.fixture(scope="session")
def chromium():
    """Path of an installed Chromium."""
    names = ("chromium", "chromium-browser", "google-chrome")
    result = next(filter(None, map(shutil.which, names)), None)
    if result is None:
        pytest.skip(f"no Chromium is installed ({', '.join(names)})")
    return result


@pytest.fixture(scope="session")
def browser(chromium, folder_stack):
    """A browser for all tests of this folder; no other event loop may run while it exists."""
    from playwright.sync_api import expect, sync_playwright

    playwright = folder_stack.enter_context(sync_playwright())
    one = playwright.chromium.launch(executable_path=chromium, args=FLAGS)
    expect.set_options(timeout=1000 * PATIENCE_S)
    folder_stack.callback(one.close)
    return one


@pytest.fixture(scope="session")
def station(
    chromium, tmp_path_factory, folder_stack, room_views
):  # fmt: skip
    """A service with two workers, and an indexed map `building` of two rooms.

    Tests do not change `building`. The frames of a room have the parent frame ROOM and alternate
    between the runs ROOM/ann (even) and ROOM/bob (odd).
    """
    del chromium  # without a browser the test is skipped before the service starts
    server = folder_stack.enter_context(running(tmp_path_factory.mktemp("station"), 2))
    server.client.post(
        "/v1/maps", json={"name": "building", "title": "Two rooms", "model": "depth"}
    )
    metas, files = [], []
    for meta, png in _shots(tmp_path_factory.mktemp("shots"), room_views):
        metas.append(meta)
        files.append(("frame", (f"{len(files)}.png", png, "image/png")))
    sent = server.client.post(
        "/v1/maps/building/frames/batch", data={"metas": json.dumps(metas)}, files=files
    )
    assert sent.status_code == 200, sent.text
    server.frames = [
        Sent(item["frame"]["frame_id"], file[1][1], meta)
        for item, file, meta in zip(sent.json()["items"], files, metas, strict=True)
    ]
    states = {}

    def signed():
        states.update(server.client.get("/v1/maps/building").json()["frames"])
        return states.get("indexed") == len(files)

    until(signed)
    return server


@pytest.fixture(scope="session")
def four_sides(station):
    """A kept answer to a view of a cube whose four sides look the same.

    Its map `four-sides` has twelve views from all sides, of the run `round` in `hall`.
    """
    path = station.make_map("four-sides")
    ids = send(station.client, "four-sides", circled(range(30, 390, 30)))
    until(lambda: station.client.get(path).json()["frames"].get("indexed") == len(ids))
    (one,) = circled([40])
    form = {"files": {"frame": (one.name, one.data)}}
    about = {"meta": json.dumps({"intrinsics": one.meta["intrinsics"]})}
    answer = station.client.post(f"{path}/queries", data=about, **form)
    assert answer.status_code == 200, answer.text
    return answer.json()


def _shots(folder, room_views):
    """Yield views along a path through each room with their metadata, in order of capture."""
    path = folder / "frame.png"
    for room in range(ROOMS):
        for view, frame in enumerate(room_views(21, room, VIEWS, along_path=True).frames):
            write_depth_png(path, frame.depth, 1000.0)
            lens, robot = frame.intrinsics, "bob" if view % 2 else "ann"
            assert frame.pose is not None
            yield (
                {
                    "intrinsics": {
                        n: getattr(lens, n) for n in ("width", "height", "fx", "fy", "cx", "cy")
                    },
                    "robot": robot,
                    "session": f"room-{room}/{robot}",
                    "captured_at": TAKEN.format(minute=room, second=view),
                    "pose": {"parent_frame": f"room-{room}", "matrix": frame.pose.tolist()},
                    "tags": ["door"] if view == 0 else [],
                },
                path.read_bytes(),
            )


@pytest.fixture(scope="session")
def shared_context(browser):
    """A context for all pages without options of their own, with an empty page that stays open.

    Chromium creates a window for the first page of a context, which takes half a second.
    """
    context = browser.new_context(viewport=VIEWPORT)
    context.new_page()
    return context


def _forget(page):
    """Close a page of the shared context, and remove its state."""
    page.context.set_offline(False)
    page.context.clear_cookies()
    page.context.clear_permissions()
    browser = page.context.new_cdp_session(page)
    for origin in page.origins:
        browser.send("Storage.clearDataForOrigin", {"origin": origin, "storageTypes": "all"})
    page.close()


@pytest.fixture
def open_page(browser, shared_context):
    """A function that opens a page, in a new context if it has arguments for Browser.new_context.

    Without arguments the page uses a shared context, whose cookies and storage are removed.

    The test fails on warnings and errors in the console, on exceptions, and on requests to other
    hosts. A page that provokes such messages lists parts of them in `page.allowed`.
    """
    opened = []

    def open_one(**context):
        within = (
            browser.new_context(**{"viewport": VIEWPORT, **context}) if context else shared_context
        )
        page = within.new_page()
        page.set_default_timeout(1000 * PATIENCE_S)
        page.allowed, page.said, page.pending = [], [], set()
        page.origins = set()
        page.on(
            "console",
            lambda one: (
                one.type in ("error", "warning") and page.said.append(f"{one.type}: {one.text}")
            ),
        )
        page.on("pageerror", lambda one: page.said.append(f"thrown: {one}"))
        page.on("request", lambda one: _asked(page, one))
        for end in ("requestfinished", "requestfailed"):
            page.on(end, lambda one: page.pending.discard(one))
        opened.append(page)
        return page

    yield open_one
    said = [
        text for page in opened for text in page.said
        if not any(part in text for part in (NOISE, *page.allowed))
    ]  # fmt: skip
    for page in opened:
        if page.context is shared_context:
            _forget(page)
        else:
            page.context.close()
    assert said == []


@pytest.fixture
def page(open_page):
    """A new page, 1280 x 800, with the checks of `open_page`."""
    return open_page()


@pytest.fixture
def run(station, page, settle):
    """A function that evaluates JavaScript with a module of the dashboard, in a page that shows
    nothing of its own. The module is `m`, and further arguments are the array `given`.
    """
    page.goto(f"{station.home}#/nowhere")
    settle(page)

    def evaluate(module, expression, *args):
        script = f"async ([url, given]) => {{ const m = await import(url); return {expression}; }}"
        return page.evaluate(script, [f"{station.url}/dashboard/{module}.js", list(args)])

    return evaluate


def _asked(page, request):
    """Record a request of a page, except streams, which never end."""
    home = httpx.URL(page.url if page.url.startswith("http") else request.url)
    there = httpx.URL(request.url.removeprefix("blob:"))
    page.origins.add(f"{there.scheme}://{there.netloc.decode()}")
    if (there.host, there.port) != (home.host, home.port):
        page.said.append(f"elsewhere: {request.url}")
    if request.headers.get("accept") != "text/event-stream":
        page.pending.add(request)


@pytest.fixture(scope="session")
def settle():
    """A function that waits until a page has no pending requests and is not busy."""

    def wait(page):
        # The page's policy forbids wait_for_function.
        busy = "() => document.getElementById('main')?.getAttribute('aria-busy') !== 'false'"
        end, quiet = time.monotonic() + PATIENCE_S, 0
        while quiet < 3:  # an answer may cause further requests
            assert time.monotonic() < end, [request.url for request in page.pending]
            page.wait_for_timeout(20)
            quiet = 0 if page.pending or page.evaluate(busy) else quiet + 1

    return wait


@pytest.fixture(scope="session")
def axe():
    """Return axe's findings on a page; the dark theme is checked only for colours."""
    from axe_playwright_python.sync_playwright import Axe

    judge = Axe()

    def look(page):
        results = []
        for theme in ("light", "dark"):
            page.emulate_media(color_scheme=theme)
            options = {"resultTypes": ["violations"]}
            if theme == "dark":
                options["runOnly"] = ["color-contrast"]
            for violation in judge.run(page, options=options).response["violations"]:
                where = [node["html"][:200] for node in violation["nodes"][:5]]
                results.append(f"{theme}: {violation['id']}: {violation['help']}: {where}")
        return results

    return look


@pytest.fixture(scope="session")
def pixels():
    """A function that returns a screenshot of an element or a page."""
    return lambda shown: Image.open(io.BytesIO(shown.screenshot())).convert("RGB")


@pytest.fixture(scope="session")
def written():
    """A function that returns a reason of the API as pages write it: 0.23° and 7.5 mm."""

    def short(match):
        length = float(match[1])
        return f"{1000 * length:.{1 if length < 0.01 else 0}f} mm"

    return lambda text: re.sub(r"\b(0\.0\d+) m\b", short, re.sub(r"(\d) deg\b", r"\1°", text))


@pytest.fixture(scope="session")
def free_port():
    """A free port, for a service that restarts on the same port."""
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])
