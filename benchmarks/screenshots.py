"""`make screenshots`: every page of the dashboard, light and dark, over a real service.

All that is to be seen is synthetic: rooms and a hall of `sceneprint_lab.synth`, signed by two
workers.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import httpx
from tqdm import tqdm

from benchmarks.chromium import PATIENCE_S, chromium, installed, settled, watched
from benchmarks.rooms import Shot, box, circled, fuse, scans, send, shots, wait
from sceneprint_lab.cli.demo import serving

if TYPE_CHECKING:
    from playwright.sync_api import FilePayload

MAP, HALL, BOXES, SIDES = "building", "hall-3", "boxes", "four-sides"
THEMES = ("light", "dark")
#: Which rooms, views of each, and every how many-th of its path one is.
ROOMS, VIEWS, STEP = (3, 0), 12, 4
#: Width, and least and greatest height of a picture.
WIDTH, LOW, HIGH = 1280, 800, 2400
#: Width and height of a tablet held upright.
TABLET = (768, 1024)
#: Of a phone.
PHONE = (390, 844)
#: Seconds that a page may go on drawing after it is there.
LINGER_S = 2.0
#: Bytes a second at which uploads are sent, to be seen at it.
SLOWLY = 20_000
#: Whether all pictures that a page has asked for are drawn.
_PICTURES = """Promise.all([...document.querySelectorAll("canvas.picture")].map((one) =>
  one.ready)).then(() => true)"""
#: An address as a proxy would tell it, which makes the service ask for a key.
ELSEWHERE = {"X-Forwarded-For": "192.0.2.7"}


@dataclass(frozen=True)
class View:
    """A page to be taken: name of the picture, address behind the dashboard's.

    `tall`: as high as what is on it; `size`: of the window; `headers`: sent with every request;
    `key`: kept in the tab; `files`: chosen on the page, by name; `press`: the text of buttons that
    are pressed then; `gone`: whether the service is out of reach when the page is entered.
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


def take(out: Path) -> list[Path]:
    """Fill a service, and take all pages.

    Parameters
    ----------
    out : folder of the pictures; made if need be

    Raises
    ------
    FileNotFoundError : no Chromium is installed.
    """
    path = installed()
    if path is None:
        raise FileNotFoundError("no Chromium is installed (on Debian: apt install chromium)")
    out.mkdir(parents=True, exist_ok=True)
    made = shots(ROOMS, VIEWS, STEP)
    with TemporaryDirectory() as folder:
        data = Path(folder)
        with serving(data, workers=0) as url, httpx.Client(base_url=url, timeout=120) as client:
            fill(client, data, made)
        with serving(data, workers=2) as url, httpx.Client(base_url=url, timeout=120) as client:
            pages = views(client, made)
            with chromium(path) as browser:
                return [
                    picture(browser, url, view, theme, out / f"{place:02d}-{view.name}-{theme}.png")
                    for place, view in enumerate(tqdm(pages, desc="pages", disable=None), 1)
                    for theme in THEMES
                ]


def fill(client: httpx.Client, data: Path, made: list[Shot]) -> None:
    """Upload all frames while nobody signs them, and damage one of them on the disk."""
    for name, title, model in (
        (MAP, "Two rooms, two robots", "depth"), (HALL, "Hall 3", "lidar"),
        (BOXES, "Rooms without furniture", "depth"), (SIDES, "A cube in a hall", "depth"),
        ("empty", None, "depth"),
    ):  # fmt: skip
        new = {"name": name, "title": title, "model": model}
        client.post("/v1/maps", json=new).raise_for_status()
    send(client, MAP, made)
    send(client, BOXES, [box(0.0)])
    send(client, SIDES, circled(range(30, 390, 30)))
    walk = scans(4)
    send(client, HALL, walk[:-1])
    known = set((data / "blobs").rglob("*"))
    send(client, HALL, walk[-1:])
    (blob,) = (one for one in set((data / "blobs").rglob("*")) - known if one.is_file())
    blob.chmod(0o644)
    blob.write_bytes(blob.read_bytes()[:-1])


def views(client: httpx.Client, made: list[Shot]) -> list[View]:
    """Have all frames signed, ask, associate, make keys; the pages of all that."""
    wait(client, f"/v1/maps/{MAP}", {"indexed"})
    wait(client, f"/v1/maps/{BOXES}", {"indexed"})
    wait(client, f"/v1/maps/{SIDES}", {"indexed"})
    wait(client, f"/v1/maps/{HALL}", {"indexed", "failed"})
    whole = {"grants": {"*": "admin"}}
    client.post("/v1/keys", json={"name": "operator", **whole}).raise_for_status()
    few = {"name": "robot-7", "grants": {MAP: "write", HALL: "read"}}
    key = client.post("/v1/keys", json=few).raise_for_status().json()["secret"]
    both = {"sessions": ["room-0/ann", "room-0/bob"]}
    found = client.post(f"/v1/maps/{MAP}/associations", json=both).raise_for_status().json()
    _done(client, found["job_id"])
    for name in (MAP, HALL, SIDES):
        fuse(client, name)
    for name in (MAP, SIDES):
        _measure_coverage(client, name)
    ids = [str(one["frame_id"]) for one in _listed(client, MAP)]
    asked = {"frame_id": ids[3], "k": 4, "explain": True, "explain_frame": ids[-1]}
    answer = client.post(f"/v1/maps/{MAP}/queries", json=asked).raise_for_status().json()
    for one in (made[5], made[8], made[-2]):
        _ask(client, MAP, one)
    boxed = _ask(client, BOXES, box(0.3))
    sides = str(_ask(client, SIDES, circled([40])[0])["query_id"])
    absent = str(_ask(client, SIDES, made[0])["query_id"])
    dead, *_ = client.get("/v1/jobs", params={"state": "dead"}).json()["items"]
    hall = str(_listed(client, HALL, "indexed")[0]["frame_id"])
    return [
        *_views(answer, boxed, ids[3], hall, dead["job_id"], key, made),
        *_unsure(sides, absent),
    ]


def _listed(client: httpx.Client, name: str, state: str | None = None) -> list[dict[str, Any]]:
    """Frames of a map, the first taken first."""
    params = {"limit": "100"} if state is None else {"limit": "100", "state": state}
    items = client.get(f"/v1/maps/{name}/frames", params=params).raise_for_status().json()["items"]
    return sorted(items, key=lambda one: str(one["captured_at"]))


def _measure_coverage(client: httpx.Client, name: str) -> None:
    asked = {"not_within_s": 0}
    told = client.post(f"/v1/maps/{name}/coverage", json=asked).raise_for_status().json()
    _done(client, told["job_id"])


def _done(client: httpx.Client, job: str) -> None:
    while client.get(f"/v1/jobs/{job}").json()["state"] in ("queued", "running"):
        time.sleep(0.2)


def _ask(client: httpx.Client, name: str, shot: Shot) -> dict[str, Any]:
    known = ("intrinsics", "robot", "session")
    fields = {"meta": json.dumps({key: shot.meta[key] for key in known if key in shot.meta})}
    files = {"frame": (shot.name, shot.data, "image/png")}
    answer = client.post(f"/v1/maps/{name}/queries", data=fields, files=files)
    found: dict[str, Any] = answer.raise_for_status().json()
    return found


def _farthest(answer: dict[str, Any]) -> str:
    """Of the strong matches the one from whose sensor the query's is farthest."""
    found = [one for one in answer["matches"] if one["validation"]["strength"] == "strong"]

    def distance(one: dict[str, Any]) -> float:
        return sum(float(row[3]) ** 2 for row in one["transform"]["matrix"][:3])

    return str(max(found, key=distance)["frame_id"])


def _views(
    answer: dict[str, Any], boxed: dict[str, Any], frame: str, scan: str, dead: str, key: str,
    made: list[Shot],
) -> Iterator[View]:  # fmt: skip
    query = answer["query_id"]
    overlay = f"#/queries/{query}/matches/{_farthest(answer)}?map={MAP}"
    rival = f"#/queries/{boxed['query_id']}/matches/{boxed['matches'][0]['frame_id']}?map={BOXES}"
    maps, frames = View("maps", "#/"), View("frames", f"#/maps/{MAP}")
    rows = View("answer", f"#/queries/{query}", tall=True)
    aligned = View("overlay", overlay, tall=True)
    queries = View("queries", f"#/maps/{MAP}/queries")
    place = View("place", f"#/maps/{MAP}/place?parent=room-{ROOMS[0]}")
    paths = View("place-query", f"#/maps/{MAP}/place?view=3d&query={query}", tall=True)
    operations = View("operations", "#/operations", tall=True)
    yield from (maps, place, replace(place, name="place-phone", size=PHONE, tall=True))
    yield View("place-3d", f"{place.address}&view=3d&colour=session&association=none")
    yield View("place-scans", f"#/maps/{HALL}/place")
    yield View("place-none", "#/maps/empty/place")
    yield frames
    yield View("frames-normals", f"#/maps/{MAP}?view=normals")
    yield View("frames-patches", f"#/maps/{MAP}?view=patches")
    yield View("frames-scans", f"#/maps/{HALL}")
    yield View("frames-none", "#/maps/empty")
    yield View("sessions", f"#/maps/{MAP}/sessions")
    yield View("session-tags", f"#/maps/{MAP}/sessions", press=("Tag session room-0/ann",))
    yield View("frame", f"#/maps/{MAP}/frames/{frame}", tall=True)
    yield View("frame-scan", f"#/maps/{HALL}/frames/{scan}", tall=True)
    yield View("upload", f"#/maps/{MAP}/upload")
    yield View("query", f"#/maps/{MAP}/query?frame={frame}", tall=True)
    yield from (queries, replace(queries, name="queries-phone", size=PHONE))
    yield rows
    yield aligned
    yield View("overlay-before", f"{overlay}&pose=before", tall=True)
    yield View("overlay-residual", f"{overlay}&colour=residual", tall=True)
    yield View("overlay-rival", f"{rival}&pose=rival", tall=True)
    yield from (paths, operations)
    yield View("operations-map", f"#/operations?map={HALL}", tall=True)
    for tab in ("jobs", "events", "keys", "audit"):
        yield View(tab, f"#/operations?tab={tab}")
    yield View("new-map", "#/", press=("New map",))
    yield View("new-key", "#/operations?tab=keys", press=("Create a key",))
    yield View("job-dead", f"#/operations/jobs/{dead}")
    yield View("key", "#/", headers=ELSEWHERE)
    yield View("key-too-little", "#/operations?tab=keys", headers=ELSEWHERE, key=key)
    yield View("nowhere", "#/nowhere")
    yield View("gone", f"#/maps/{MAP}", gone=True)
    for one in (maps, place, frames, rows, aligned, paths, operations):
        yield replace(one, name=f"{one.name}-tablet", size=TABLET)
    # the last: the map is empty no more
    sent = [(f"frame-{i:06d}.depth.png", one.data) for i, one in enumerate(made[:6])]
    lens = json.dumps({**made[0].meta["intrinsics"], "depth_scale": 1000}).encode()
    files = (("torn.ply", b"ply\nformat ascii 1.0\n"), *sent, ("intrinsics.json", lens))
    yield View("uploading", "#/maps/empty/upload", files=files, press=("Upload 7 files",))


def _unsure(sides: str, absent: str) -> Iterator[View]:
    """Answers that are not found: one of several poses, and one of none."""
    several = View("answer-ambiguous", f"#/queries/{sides}")
    plan = View("place-ambiguous", f"#/maps/{SIDES}/place?query={sides}", tall=True)
    none = View("answer-not-found", f"#/queries/{absent}")
    lost = View("coverage", f"#/maps/{SIDES}/coverage?cell=6,-4", tall=True)
    for one in (several, plan, none, lost):
        yield one
        yield replace(one, name=f"{one.name}-phone", size=PHONE)


def picture(browser: Any, url: str, view: View, theme: str, path: Path) -> Path:
    """Take one page.

    Parameters
    ----------
    browser : see `benchmarks.chromium.chromium`
    url : of the service
    view : the page
    theme : "light" or "dark"
    path : of the picture
    """
    width, low = view.size
    context = browser.new_context(
        viewport={"width": width, "height": low}, color_scheme=theme,
        extra_http_headers=view.headers or {},
    )  # fmt: skip
    context.set_default_timeout(1000 * PATIENCE_S)
    try:
        page = watched(context.new_page())
        if view.key is not None:
            page.add_init_script(f"sessionStorage.setItem('sceneprint.key', '{view.key}')")
        page.goto(f"{url}/dashboard{'#/' if view.gone else view.address}")
        settled(page)
        if view.gone:
            context.set_offline(True)
            page.evaluate("address => { location.hash = address; }", view.address)
        if view.files:
            _throttled(context, page)
            given: list[FilePayload] = [
                {"name": n, "mimeType": "", "buffer": data} for n, data in view.files
            ]
            page.locator("input[name=files]").set_input_files(given)
        for text in view.press:
            page.get_by_role("button", name=text).click()
        page.wait_for_timeout(1000 * LINGER_S)
        if view.tall:
            height = page.evaluate("document.documentElement.scrollHeight")
            page.set_viewport_size({"width": width, "height": min(max(height, low), HIGH)})
            page.wait_for_timeout(1000 * LINGER_S)
        page.evaluate(_PICTURES)
        page.screenshot(path=path)
        return path
    finally:
        context.close()


def _throttled(context: Any, page: Any) -> None:
    network = context.new_cdp_session(page)
    network.send("Network.enable")
    slow = {"offline": False, "latency": 0, "downloadThroughput": -1, "uploadThroughput": SLOWLY}
    network.send("Network.emulateNetworkConditions", slow)


def main() -> int:
    """Take them all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/screenshots"))
    options = parser.parse_args()
    try:
        taken = take(options.out)
    except FileNotFoundError as error:
        print(f"screenshots: {error}", file=sys.stderr)
        return 2
    print(f"{len(taken)} pictures in {options.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
