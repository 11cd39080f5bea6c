"""How many uploads a second are acknowledged, and whether one of them is lost.

`python -m benchmarks.uploads [--frames N] [--clients N] [--batch N] [--workers N]` starts a service
on a folder of its own, and lets clients send distinct frames of 640 x 480 as 16-bit PNG.
"""

from __future__ import annotations

import argparse
import http.client
import io
import json
import sys
import time
import uuid
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.queues import SimpleQueue
from multiprocessing.synchronize import Barrier
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeAlias
from urllib.parse import urlsplit

import numpy as np
from PIL import Image

from sceneprint.cli.served import serving
from sceneprint.client import Client

#: What each client tells: frames that were acknowledged, and how many were not.
Answers: TypeAlias = "SimpleQueue[tuple[list[str], int]]"
#: The camera of the frames.
CAMERA = {"width": 640, "height": 480, "fx": 585.0, "fy": 585.0, "cx": 319.5, "cy": 239.5}
#: Seconds to wait for the workers after the last upload.
PATIENCE_S = 600.0


@dataclass(frozen=True)
class UploadFigures:
    """What came of the uploads; `seconds`: from the first to the last answer."""

    sent: int
    acknowledged: int
    refused: int
    indexed: int
    lost: int
    seconds: float
    per_second: float


def noisy_pngs(count: int, seed: int = 0) -> list[bytes]:
    """Distinct depth images of a slanted wall, as PNG, in the steps and with the noise of a Kinect:
    about as large as those of 7-Scenes.
    """
    rng = np.random.default_rng(seed)
    slope = np.linspace(1500, 3500, 640)[None, :] + np.linspace(0, 400, 480)[:, None]
    found = []
    for _ in range(count):
        disparity = 585 * 75 / slope + 0.06 * rng.normal(size=slope.shape)
        depth = 585 * 75 * 8 / np.round(8 * disparity)
        depth[rng.random((15, 20)).repeat(32, 0).repeat(32, 1) < 0.1] = 0
        made = io.BytesIO()
        Image.fromarray(depth.astype(np.uint16)).save(made, "PNG")
        found.append(made.getvalue())
    return found


def measure(frames: int = 400, clients: int = 8, batch: int = 0, workers: int = 1) -> UploadFigures:
    """Start a service and upload to it.

    Parameters
    ----------
    frames : in all
    clients : that send at once, each over one connection
    batch : frames of one request; 0 to send each alone
    workers : that sign meanwhile
    """
    pngs = noisy_pngs(frames)
    with (
        TemporaryDirectory() as folder,
        serving(Path(folder), workers) as url,
        Client(url) as asked,
    ):
        asked.create_map("hall", model="depth")
        place = urlsplit(url)
        context = get_context("spawn")  # what the clients take is theirs, as of robots elsewhere
        barrier, told = context.Barrier(clients + 1), context.SimpleQueue()
        processes = [
            context.Process(
                target=_send, daemon=True,
                args=(str(place.hostname), int(place.port or 80), pngs[i::clients], batch, barrier,
                      told),
            )
            for i in range(clients)
        ]  # fmt: skip
        for one in processes:
            one.start()
        barrier.wait()
        start = time.perf_counter()
        answers = [told.get() for _ in processes]
        seconds = time.perf_counter() - start
        ids = [frame_id for one, _ in answers for frame_id in one]
        until = time.monotonic() + PATIENCE_S
        while time.monotonic() < until:
            states = asked.map("hall").frames
            if states.get("received", 0) + states.get("signing", 0) == 0:
                break
            time.sleep(1)
        there = {one.frame_id: one.state for one in asked.frames("hall")}
    return UploadFigures(
        sent=frames,
        acknowledged=len(ids),
        refused=sum(refused for _, refused in answers),
        indexed=sum(state == "indexed" for state in there.values()),
        lost=sum(one not in there for one in ids),
        seconds=seconds,
        per_second=len(ids) / seconds,
    )


def _send(
    host: str, port: int, pngs: list[bytes], batch: int, barrier: Barrier, told: Answers
) -> None:
    """One client: frame ids that were acknowledged, and how many frames were not."""
    connection = http.client.HTTPConnection(host, port, timeout=120)
    found: list[str] = []
    refused = 0
    barrier.wait()
    for i in range(0, len(pngs), max(batch, 1)):
        some = pngs[i : i + max(batch, 1)]
        body, kind, path = _batch(some) if batch else _single(some[0])
        status, content = _answer(connection, path, body, kind)
        if status not in (200, 202):
            refused += len(some)
        elif batch:
            found += [one["frame"]["frame_id"] for one in content["items"]]
        else:
            found.append(content["frame_id"])
    told.put((found, refused))


def _answer(
    connection: http.client.HTTPConnection, path: str, body: bytes, kind: str
) -> tuple[int, dict[str, Any]]:
    """Status and content; 0 where no answer came: that upload was not acknowledged."""
    try:
        connection.request("POST", path, body, {"Content-Type": kind})
        answer = connection.getresponse()
        return answer.status, json.loads(answer.read())
    except (OSError, http.client.HTTPException):
        connection.close()
        return 0, {}


def _single(png: bytes) -> tuple[bytes, str, str]:
    said = "&".join(f"{name}={value}" for name, value in CAMERA.items())
    return png, "image/png", f"/v1/maps/hall/frames?{said}"


def _batch(pngs: list[bytes]) -> tuple[bytes, str, str]:
    mark = uuid.uuid4().hex
    head = f"--{mark}\r\nContent-Disposition: form-data; name="
    parts = [f'{head}"metas"\r\n\r\n{json.dumps({"intrinsics": CAMERA})}\r\n'.encode()]
    for png in pngs:
        parts += [f'{head}"frame"; filename="f"\r\n\r\n'.encode(), png, b"\r\n"]
    body = b"".join([*parts, f"--{mark}--\r\n".encode()])
    return body, f"multipart/form-data; boundary={mark}", "/v1/maps/hall/frames/batch"


def main(arguments: list[str] | None = None) -> int:
    """Print the figures on one line; 1 where something was lost."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=400)
    parser.add_argument("--clients", type=int, default=8)
    parser.add_argument("--batch", type=int, default=0)
    parser.add_argument("--workers", type=int, default=1)
    options = parser.parse_args(arguments)
    found = measure(options.frames, options.clients, options.batch, options.workers)
    print(
        f"{found.per_second:.1f} frames/s acknowledged ({found.seconds:.1f} s): {found.sent} sent, "
        f"{found.acknowledged} acknowledged, {found.refused} refused, {found.indexed} indexed, "
        f"{found.lost} lost"
    )
    return 1 if found.lost or found.acknowledged + found.refused != found.sent else 0


if __name__ == "__main__":
    sys.exit(main())
