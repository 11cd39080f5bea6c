"""Take screenshots of every page of the dashboard, light and dark: `make screenshots`.

The service shows synthetic rooms and a hall of `sceneprint_lab.synth`.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import httpx
from tqdm import tqdm

from benchmarks.chromium import chromium, installed, settled, watch_page
from benchmarks.rooms import Shot, box, circled, fuse, scans, send, shots, wait
from benchmarks.waiting import PATIENCE_S, until
from sceneprint_lab.cli.demo import serving

if TYPE_CHECKING:
    from playwright.sync_api import FilePayload

MAP, HALL, BOXES, SIDES = "building", "hall-3", "boxes", "four-sides"
#: Rooms, number of views of each room, and number of path steps between two views.
ROOMS, VIEWS, STEP = (3, 0), 12, 4
#: Width, and minimum and maximum height of a screenshot, pixels.
WIDTH, LOW, HIGH = 1280, 800, 2400
#: Width and height of a tablet in portrait orientation, and of a phone.
TABLET, PHONE = (768, 1024), (390, 844)
#: Time for drawing after the main part of a page is ready, seconds.
LINGER_S = 2.0
#: Upload speed that is low enough for a screenshot of the progress, bytes per second.
SLOW_UPLOADS = 20_000
#: Expression that waits until all pictures of a page are drawn.
_PICTURES = """Promise.all([...document.querySelectorAll("canvas.picture")].map((one) =>
  one.ready)).then(() => true)"""
#: Header that makes the request look remote, so that the service requires a key.
ELSEWHERE = {"X-Forwarded-For": "192.0.2.7"}


@dataclass(frozen=True)
class View:
    """A page of the dashboard.

    Parameters
    ----------
    name, address : name of the screenshot, and address within the dashboard
    tall : whether the screenshot shows the whole height of the page
    headers, key : headers of every request, and key in the tab's storage
    files, press : files to select, and labels of buttons to press afterwards
    gone : whether the service is unreachable when the page opens
    """

    name: str
    address: str
    tall: bool = False
    size: tuple[int, int] = (WIDTH, LOW)
    headers: dict[str, str] | None = None
    key: str | None = None
    files: tuple[tuple[str, bytes], ...] = ()
    press: tuple[str, ...] = ()
    gone: bool = False


def take_all(path: str, out: Path) -> int:
    """Fill a service, take screenshots of all pages, and return their number."""
    out.mkdir(parents=True, exist_ok=True)
    frames, number = shots(ROOMS, VIEWS, STEP), 0
    with TemporaryDirectory() as folder:
        data = Path(folder)
        with serving(data, workers=0) as url, httpx.Client(base_url=url, timeout=120) as client:
            fill(client, data, frames)
        with serving(data, workers=2) as url, httpx.Client(base_url=url, timeout=120) as client:
            pages = list(views(client, frames))
            with chromium(path) as browser:
                for place, view in enumerate(tqdm(pages, desc="pages", disable=None), 1):
                    for theme in ("light", "dark"):
                        file = out / f"{place:02d}-{view.name}-{theme}.png"
                        take_picture(browser, url, view, theme, file)
                        number += 1
    return number


def fill(client: httpx.Client, data: Path, frames: list[Shot]) -> None:
    """Create maps, upload all frames without a worker, and damage one upload on disk."""
    for name, title, model in (
        (MAP, "Two rooms, two robots", "depth"), (HALL, "Hall 3", "lidar"),
        (BOXES, "Rooms without furniture", "depth"), (SIDES, "A cube in a hall", "depth"),
        ("empty", None, "depth"),
    ):  # fmt: skip
        _post(client, "maps", {"name": name, "title": title, "model": model})
    send(client, MAP, frames)
    send(client, BOXES, [box(0.0)])
    send(client, SIDES, circled(range(30, 390, 30)))
    walk = scans(4)
    send(client, HALL, walk[:-1])
    before = set((data / "blobs").rglob("*"))
    send(client, HALL, walk[-1:])
    (blob,) = (path for path in set((data / "blobs").rglob("*")) - before if path.is_file())
    blob.chmod(0o644)
    blob.write_bytes(blob.read_bytes()[:-1])


def views(client: httpx.Client, frames: list[Shot]) -> Iterator[View]:
    """Wait for the workers, query and associate frames, create keys, and yield all pages."""
    for name in (MAP, BOXES, SIDES, HALL):
        wait(client, f"/v1/maps/{name}", {"indexed", "failed"} if name == HALL else {"indexed"})
    _post(client, "keys", {"name": "operator", "grants": {"*": "admin"}})
    key = _post(client, "keys", {"name": "robot-7", "grants": {MAP: "write", HALL: "read"}})
    both = {"sessions": ["room-0/ann", "room-0/bob"]}
    _await_job(client, _post(client, f"maps/{MAP}/associations", both)["job_id"])
    for name in (MAP, HALL, SIDES):
        fuse(client, name)
    for name in (MAP, SIDES):
        _await_job(client, _post(client, f"maps/{name}/coverage", {"not_within_s": 0})["job_id"])
    ids = _frame_ids(client, MAP)
    query = {"frame_id": ids[3], "k": 4, "explain": True, "explain_frame": ids[-1]}
    answer = _post(client, f"maps/{MAP}/queries", query)
    for frame in (frames[5], frames[8], frames[-2]):
        _query(client, MAP, frame)
    boxed = _query(client, BOXES, box(0.3))
    sides = str(_query(client, SIDES, circled([40])[0])["query_id"])
    absent = str(_query(client, SIDES, frames[0])["query_id"])
    dead, *_ = client.get("/v1/jobs", params={"state": "dead"}).json()["items"]
    scan = _frame_ids(client, HALL, state="indexed")[0]
    yield from _pages(answer, boxed, ids[3], scan)
    yield View("job-dead", f"#/operations/jobs/{dead['job_id']}")
    yield View("key", "#/", headers=ELSEWHERE)
    yield View("key-too-little", "#/operations?tab=keys", headers=ELSEWHERE, key=key["secret"])
    yield View("nowhere", "#/nowhere")
    yield View("gone", f"#/maps/{MAP}", gone=True)
    # Answers with several poses, and without a pose.
    for view in (
        View("answer-ambiguous", f"#/queries/{sides}"),
        View("place-ambiguous", f"#/maps/{SIDES}/place?query={sides}", tall=True),
        View("answer-not-found", f"#/queries/{absent}"),
        View("coverage", f"#/maps/{SIDES}/coverage?cell=6,-4", tall=True),
    ):
        yield from (view, replace(view, name=f"{view.name}-phone", size=PHONE))
    # This page is the last one, because it fills the empty map.
    sent = [(f"frame-{i:06d}.depth.png", frame.data) for i, frame in enumerate(frames[:6])]
    lens = json.dumps({**frames[0].meta["intrinsics"], "depth_scale": 1000}).encode()
    files = (("torn.ply", b"ply\nformat ascii 1.0\n"), *sent, ("intrinsics.json", lens))
    yield View("uploading", "#/maps/empty/upload", files=files, press=("Upload 7 files",))


def _pages(answer: dict[str, Any], boxed: dict[str, Any], frame: str, scan: str) -> Iterator[View]:
    query = answer["query_id"]
    overlay = f"#/queries/{query}/matches/{_farthest(answer)}?map={MAP}"
    rival = f"#/queries/{boxed['query_id']}/matches/{boxed['matches'][0]['frame_id']}?map={BOXES}"
    place = View("place", f"#/maps/{MAP}/place?parent=room-{ROOMS[0]}")
    queries = View("queries", f"#/maps/{MAP}/queries")
    on_tablets = (
        View("maps", "#/"), place, View("frames", f"#/maps/{MAP}"),
        View("answer", f"#/queries/{query}", tall=True), View("overlay", overlay, tall=True),
        View("place-query", f"#/maps/{MAP}/place?view=3d&query={query}", tall=True),
        View("operations", "#/operations", tall=True),
    )  # fmt: skip
    for view in on_tablets:
        yield from (view, replace(view, name=f"{view.name}-tablet", size=TABLET))
    yield replace(place, name="place-phone", size=PHONE, tall=True)
    yield from (queries, replace(queries, name="queries-phone", size=PHONE))
    for name, address in {
        "place-3d": f"{place.address}&view=3d&colour=session&association=none",
        "place-scans": f"#/maps/{HALL}/place", "place-none": "#/maps/empty/place",
        "frames-normals": f"#/maps/{MAP}?view=normals",
        "frames-patches": f"#/maps/{MAP}?view=patches", "frames-scans": f"#/maps/{HALL}",
        "frames-none": "#/maps/empty", "sessions": f"#/maps/{MAP}/sessions",
        "upload": f"#/maps/{MAP}/upload",
        **{tab: f"#/operations?tab={tab}" for tab in ("jobs", "events", "keys", "audit")},
    }.items():  # fmt: skip
        yield View(name, address)
    for name, address in {
        "frame": f"#/maps/{MAP}/frames/{frame}", "frame-scan": f"#/maps/{HALL}/frames/{scan}",
        "query": f"#/maps/{MAP}/query?frame={frame}", "overlay-before": f"{overlay}&pose=before",
        "overlay-residual": f"{overlay}&colour=residual", "overlay-rival": f"{rival}&pose=rival",
        "operations-map": f"#/operations?map={HALL}",
    }.items():  # fmt: skip
        yield View(name, address, tall=True)
    yield View("session-tags", f"#/maps/{MAP}/sessions", press=("Tag session room-0/ann",))
    yield View("new-map", "#/", press=("New map",))
    yield View("new-key", "#/operations?tab=keys", press=("Create a key",))


def _post(client: httpx.Client, path: str, body: dict[str, Any]) -> dict[str, Any]:
    record: dict[str, Any] = client.post(f"/v1/{path}", json=body).raise_for_status().json()
    return record


def _frame_ids(client: httpx.Client, name: str, **params: str) -> list[str]:
    """Return the ids of the frames of a map in order of capture."""
    answer = client.get(f"/v1/maps/{name}/frames", params={"limit": "100", **params})
    items = answer.raise_for_status().json()["items"]
    return [f["frame_id"] for f in sorted(items, key=lambda f: str(f["captured_at"]))]


def _await_job(client: httpx.Client, job: str) -> None:
    running = ("queued", "running")
    until(lambda: client.get(f"/v1/jobs/{job}").json()["state"] not in running, pause_s=0.2)


def _query(client: httpx.Client, name: str, shot: Shot) -> dict[str, Any]:
    names = ("intrinsics", "robot", "session")
    fields = {"meta": json.dumps({key: shot.meta[key] for key in names if key in shot.meta})}
    files = {"frame": (shot.name, shot.data, "image/png")}
    answer = client.post(f"/v1/maps/{name}/queries", data=fields, files=files)
    record: dict[str, Any] = answer.raise_for_status().json()
    return record


def _farthest(answer: dict[str, Any]) -> str:
    """Return the id of the strong match with the greatest distance from the query."""
    strong = [match for match in answer["matches"] if match["validation"]["strength"] == "strong"]

    def distance(match: dict[str, Any]) -> float:
        return sum(float(row[3]) ** 2 for row in match["transform"]["matrix"][:3])

    return str(max(strong, key=distance)["frame_id"])


def take_picture(browser: Any, url: str, view: View, theme: str, path: Path) -> None:
    """Take a screenshot of a page.

    Parameters
    ----------
    url : address of the service
    view : page
    theme : "light" or "dark"
    """
    width, low = view.size
    context = browser.new_context(
        viewport={"width": width, "height": low}, color_scheme=theme,
        extra_http_headers=view.headers or {},
    )  # fmt: skip
    context.set_default_timeout(1000 * PATIENCE_S)
    try:
        page = watch_page(context.new_page())
        if view.key is not None:
            page.add_init_script(f"sessionStorage.setItem('sceneprint.key', '{view.key}')")
        page.goto(f"{url}/dashboard{'#/' if view.gone else view.address}")
        settled(page)
        if view.gone:
            context.set_offline(True)
            page.evaluate("address => { location.hash = address; }", view.address)
        if view.files:
            network = context.new_cdp_session(page)
            network.send("Network.enable")
            slow = {"offline": False, "latency": 0, "downloadThroughput": -1}
            slow["uploadThroughput"] = SLOW_UPLOADS
            network.send("Network.emulateNetworkConditions", slow)
            chosen: list[FilePayload] = [
                {"name": name, "mimeType": "", "buffer": data} for name, data in view.files
            ]
            page.locator("input[name=files]").set_input_files(chosen)
        for text in view.press:
            page.get_by_role("button", name=text).click()
        page.wait_for_timeout(1000 * LINGER_S)
        if view.tall:
            height = page.evaluate("document.documentElement.scrollHeight")
            page.set_viewport_size({"width": width, "height": min(max(height, low), HIGH)})
            page.wait_for_timeout(1000 * LINGER_S)
        page.evaluate(_PICTURES)
        page.screenshot(path=path)
    finally:
        context.close()


def main() -> int:
    """Take all screenshots."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/screenshots"))
    options = parser.parse_args()
    if (path := installed()) is None:
        print("screenshots: install Chromium (on Debian: apt install chromium)", file=sys.stderr)
        return 2
    print(f"{take_all(path, options.out)} pictures in {options.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
