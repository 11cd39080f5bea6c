"""`make screenshots`: every page of the dashboard, light and dark, over a real service.

All that is to be seen is synthetic: rooms of `sceneprint.synth`, signed by two workers.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import httpx
from tqdm import tqdm

from benchmarks.chromium import chromium, installed, settled, watched
from benchmarks.rooms import Shot, send, shots, wait
from sceneprint.cli.served import serving

MAP, HALLS = "building", "hall-3"
THEMES = ("light", "dark")
#: Width, and least and greatest height of a picture.
WIDTH, LOW, HIGH = 1280, 800, 2400
#: Seconds that a page may go on drawing after it is there.
LINGER_S = 2.0
#: Whether all pictures that a page has asked for are drawn.
_PICTURES = """Promise.all([...document.querySelectorAll("canvas.picture")].map((one) =>
  one.ready)).then(() => true)"""
#: An address as a proxy would tell it, which makes the service ask for a key.
ELSEWHERE = {"X-Forwarded-For": "192.0.2.7"}


@dataclass(frozen=True)
class View:
    """A page to be taken: name of the picture, address behind the dashboard's.

    `tall`: as high as what is on it; `headers`: sent with every request; `press`: the text of
    buttons that are pressed first.
    """

    name: str
    address: str
    tall: bool = False
    headers: dict[str, str] | None = None
    press: tuple[str, ...] = ()


def take(out: Path, rooms: int = 2, views: int = 12) -> list[Path]:
    """Fill a service, and take all pages.

    Parameters
    ----------
    out : folder of the pictures; made if need be
    rooms, views : of the map

    Raises
    ------
    FileNotFoundError : no Chromium is installed.
    """
    path = installed()
    if path is None:
        raise FileNotFoundError("no Chromium is installed (on Debian: apt install chromium)")
    out.mkdir(parents=True, exist_ok=True)
    made = shots(rooms, views)
    with TemporaryDirectory() as folder:
        data = Path(folder)
        with serving(data, workers=0) as url, httpx.Client(base_url=url, timeout=60) as client:
            ids = _sent(client, data, made)
        with serving(data, workers=2) as url, httpx.Client(base_url=url, timeout=60) as client:
            pages = _asked(client, made, ids)
            with chromium(path) as browser:
                return [
                    _picture(
                        browser, url, view, theme, out / f"{place:02d}-{view.name}-{theme}.png"
                    )
                    for place, view in enumerate(tqdm(pages, desc="pages", disable=None), 1)
                    for theme in THEMES
                ]


def _sent(client: httpx.Client, data: Path, made: list[Shot]) -> list[str]:
    """Upload all frames while nobody signs them, and damage one of them on the disk."""
    for name, title in ((MAP, "Two rooms, two robots"), (HALLS, "Hall 3"), ("empty", None)):
        new = {"name": name, "title": title, "model": "compact"}
        client.post("/v1/maps", json=new).raise_for_status()
    ids = send(client, MAP, made[:-1])
    known = set((data / "blobs").rglob("*"))
    send(client, HALLS, made[-1:])
    (blob,) = (one for one in set((data / "blobs").rglob("*")) - known if one.is_file())
    blob.chmod(0o644)
    blob.write_bytes(blob.read_bytes()[:-1])
    return ids


def _asked(client: httpx.Client, made: list[Shot], ids: list[str]) -> list[View]:
    """Have all frames signed, ask, associate, make a key and a snapshot; the pages of all that."""
    wait(client, f"/v1/maps/{MAP}", {"indexed"})
    wait(client, f"/v1/maps/{HALLS}", {"failed"})
    whole = {"grants": {"*": "admin"}}
    client.post("/v1/keys", json={"name": "operator", **whole}).raise_for_status()
    few = {"name": "robot-7", "grants": {MAP: "write", HALLS: "read"}}
    client.post("/v1/keys", json=few).raise_for_status()
    snapshot = client.post("/v1/snapshots").raise_for_status().json()["job_id"]
    both = {"sessions": ["room-0/ann", "room-0/bob"]}
    found = client.post(f"/v1/maps/{MAP}/associations", json=both).raise_for_status().json()
    for job in (snapshot, found["association_id"]):
        _done(client, job)
    answers = [_ask(client, one, k) for one in (made[2], made[5], made[-2]) for k in (1, 5)]
    answers += [_ask(client, made[7], 3) for _ in range(3)]
    best = next(one for one in reversed(answers) if one["status"] == "found")
    match = best["matches"][-1]["frame_id"]
    (dead,) = client.get("/v1/jobs", params={"state": "dead"}).json()["items"]
    return list(_views(best["query_id"], match, ids[3], dead["job_id"]))


def _done(client: httpx.Client, job: str) -> None:
    while client.get(f"/v1/jobs/{job}").json()["state"] in ("queued", "running"):
        time.sleep(0.2)


def _ask(client: httpx.Client, shot: Shot, k: int) -> dict[str, Any]:
    fields = {"meta": json.dumps({"intrinsics": shot.meta["intrinsics"]}), "k": str(k)}
    files = {"frame": ("frame.png", shot.png, "image/png")}
    answer = client.post(f"/v1/maps/{MAP}/queries", data=fields, files=files)
    found: dict[str, Any] = answer.raise_for_status().json()
    return found


def _views(query: str, match: str, frame: str, dead: str) -> Iterator[View]:
    overlay = f"#/queries/{query}/matches/{match}?map={MAP}"
    yield View("maps", "#/")
    yield View("frames", f"#/maps/{MAP}")
    yield View("frames-normals", f"#/maps/{MAP}?view=normals")
    yield View("frames-patches", f"#/maps/{MAP}?view=patches")
    yield View("frames-none", "#/maps/empty")
    yield View("frame", f"#/maps/{MAP}/frames/{frame}", tall=True)
    yield View("upload", f"#/maps/{MAP}/upload")
    yield View("query", f"#/maps/{MAP}/query?frame={frame}", tall=True)
    yield View("answer", f"#/queries/{query}", tall=True)
    yield View("overlay", overlay, tall=True)
    yield View("overlay-before", f"{overlay}&pose=before", tall=True)
    yield View("overlay-residual", f"{overlay}&colour=residual", tall=True)
    yield View("map-view", f"#/maps/{MAP}/paths?query={query}", tall=True)
    yield View("operations", "#/operations", tall=True)
    yield View("operations-map", f"#/operations?map={HALLS}", tall=True)
    for tab in ("jobs", "events", "keys", "audit", "snapshots"):
        yield View(tab, f"#/operations?tab={tab}")
    yield View("new-key", "#/operations?tab=keys", press=("Make a key",))
    yield View("job-dead", f"#/operations/jobs/{dead}")
    yield View("key", "#/", headers=ELSEWHERE)
    yield View("nowhere", "#/nowhere")


def _picture(browser: Any, url: str, view: View, theme: str, path: Path) -> Path:
    context = browser.new_context(
        viewport={"width": WIDTH, "height": LOW}, color_scheme=theme,
        extra_http_headers=view.headers or {},
    )  # fmt: skip
    try:
        page = watched(context.new_page())
        page.goto(f"{url}/dashboard{view.address}")
        settled(page)
        for text in view.press:
            page.get_by_role("button", name=text).click()
        page.evaluate(_PICTURES)
        page.wait_for_timeout(1000 * LINGER_S)
        if view.tall:
            height = page.evaluate("document.documentElement.scrollHeight")
            page.set_viewport_size({"width": WIDTH, "height": min(max(height, LOW), HIGH)})
            page.wait_for_timeout(1000 * LINGER_S)
        page.screenshot(path=path)
        return path
    finally:
        context.close()


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
