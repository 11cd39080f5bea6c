"""Synthetic frames for a running service, for measurements and screenshots of the dashboard."""

from __future__ import annotations

import io
import json
import math
import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import httpx
import numpy as np
from PIL import Image
from sqlalchemy import insert, select

from benchmarks.indexed_frames import fill
from benchmarks.waiting import until
from sceneprint.engine.maps.map_lifecycle import create_map
from sceneprint.formats.dataset import write_depth_png
from sceneprint.formats.export import write_ply
from sceneprint.models import read_model
from sceneprint.settings import Settings
from sceneprint.store import open_store
from sceneprint.store.maps import find_map
from sceneprint.store.tables import frames, jobs, signatures
from sceneprint.types import Floats, Intrinsics
from sceneprint_client.api import NewMap
from sceneprint_lab.synth import KINECT, symmetric_box, synthesise_room, synthesise_survey, take
from sceneprint_lab.synth.trajectories import pose

SEED = 21


@dataclass(frozen=True)
class Shot:
    """A depth image or a scan, and the fields of its upload."""

    data: bytes
    meta: dict[str, Any]
    name: str = "frame.png"


def camera_of(k: Intrinsics) -> dict[str, float]:
    """Return the intrinsics for an upload."""
    return {name: getattr(k, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}


def pose_in(parent: str, T: Floats | None) -> dict[str, Any]:
    """Return the pose for an upload."""
    assert T is not None  # synthetic frames have poses
    return {"parent_frame": parent, "matrix": T.tolist()}


def shots(rooms: Sequence[int], views: int, step: int = 1) -> list[Shot]:
    """Return views along a path through each room, one per second, alternately of two robots.

    Parameters
    ----------
    rooms : numbers of the rooms
    views : number of views of each room
    step : distance between views along the path, in steps of about 5 cm or 2 degrees
    """
    uploads = []
    with TemporaryDirectory() as folder:
        path = Path(folder) / "frame.png"
        for room, number in enumerate(rooms):
            walk = synthesise_room(SEED, number, views * step, along_path=True, step=step).frames
            for view, frame in enumerate(walk):
                write_depth_png(path, frame.depth, 1000.0)
                robot = "bob" if view % 2 else "ann"
                meta = {
                    "intrinsics": camera_of(frame.intrinsics), "robot": robot,
                    "session": f"room-{room}/{robot}",
                    "captured_at": f"2026-11-20T09:{room:02d}:{view:02d}Z",
                    "pose": pose_in(f"room-{room}", frame.pose),
                    "tags": ["door"] if view == 0 else [],
                }  # fmt: skip
                uploads.append(Shot(path.read_bytes(), meta))
    return uploads


def scans(views: int) -> list[Shot]:
    """Return scans of a spinning LiDAR on a walk through a hall."""
    clouds = synthesise_survey(SEED, 0, views, along_path=True, kind="hall").clouds
    uploads = []
    for view, cloud in enumerate(clouds):
        meta = {
            "robot": "cart", "session": "hall-3/cart", "pose": pose_in("hall-3", cloud.pose),
            "captured_at": f"2026-11-20T10:00:{view:02d}Z",
        }  # fmt: skip
        uploads.append(Shot(write_ply(cloud.points), meta, f"scan-{view:06d}.ply"))
    return uploads


def box(ahead: float) -> Shot:
    """Return a view of an empty room, `ahead` metres further; it looks the same upside down."""
    v, u = np.mgrid[:240, :320].astype(float)
    x, y = abs(u - 159.5) / 292.5, abs(v - 119.5) / 292.5
    depth = np.minimum.reduce([1.5 / np.maximum(x, 1e-6), 1.1 / y, np.full(x.shape, 3.2 - ahead)])
    file = io.BytesIO()
    Image.fromarray((depth * 1000).round().astype(np.uint16)).save(file, "PNG")
    lens = camera_of(Intrinsics(320, 240, 292.5, 292.5, 159.5, 119.5))
    return Shot(file.getvalue(), {"intrinsics": lens})


def circled(azimuths: Sequence[float]) -> list[Shot]:
    """Return views of a cube with four equal sides in an empty hall, from 1.8 m.

    `azimuths`: azimuths of the camera around the cube, degrees.
    """
    room, rng, uploads = symmetric_box(), np.random.default_rng(SEED), []
    for view, azimuth in enumerate(azimuths):
        a = math.radians(azimuth)
        eye = (1.8 * math.cos(a), 1.8 * math.sin(a), 1.2)
        T = pose(np.array([*eye, a + math.pi, math.atan2(-0.9, 1.8), 0.0]))
        file = io.BytesIO()
        np.save(file, take(room, T, KINECT, rng))
        meta = {
            "intrinsics": camera_of(KINECT), "session": "round", "pose": pose_in("hall", T),
            "captured_at": f"2026-11-20T11:00:{view:02d}Z",
        }  # fmt: skip
        uploads.append(Shot(file.getvalue(), meta, "frame.npy"))
    return uploads


def send(client: httpx.Client, name: str, of: list[Shot]) -> list[str]:
    """Send frames to a map, and return their ids."""
    ids = []
    for shot in of:
        files = {"frame": (shot.name, shot.data, "application/octet-stream")}
        answer = client.post(
            f"/v1/maps/{name}/frames", data={"meta": json.dumps(shot.meta)}, files=files
        )
        ids.append(str(answer.raise_for_status().json()["frame_id"]))
    return ids


def wait(client: httpx.Client, path: str, states: set[str]) -> None:
    """Wait until all frames of a map are in one of the given states."""
    until(lambda: not set(client.get(path).raise_for_status().json()["frames"]) - states)


def fuse(client: httpx.Client, name: str) -> None:
    """Build the surface of a map, and wait for it."""
    path = f"/v1/maps/{name}/surface"
    client.post(path).raise_for_status()
    until(lambda: client.get(path).raise_for_status().json()["state"] == "ready")


def multiply(data: Path, source: str, name: str, count: int) -> None:
    """Create a map with many copies of a frame of another map, as content for lists.

    The copies share its blobs. Their signatures have one byte, because no query searches this map.

    Parameters
    ----------
    source : name of a map with an indexed frame
    count : number of frames
    """
    rng = np.random.default_rng(SEED)
    settings = Settings(data_dir=data)
    with closing(open_store(settings.database, settings.blobs)) as store:
        database = store.database
        create_map(store, NewMap(name=name, title=f"{count:,} frames", model="depth"))
        with database.read() as connection:
            row, other = find_map(connection, name), find_map(connection, source)
            first = select(frames).where(frames.c.map_number == other.number)
            first = first.where(frames.c.revision > 0).order_by(frames.c.number).limit(1)
            frame = dict(connection.execute(first).mappings().one())
            number = frame.pop("number")
            signed, job = (
                dict(connection.execute(select(table).where(table.c.frame_number == number))
                     .mappings().one())
                for table in (signatures, jobs)
            )  # fmt: skip
            del job["number"]
        names = rng.bytes(16 * count).hex()
        own = {"map_number": row.number, "received_at": time.time(), "indexed_at": time.time()}
        columns = [
            {**frame, **own, "id": names[32 * i : 32 * i + 32], "content_id": f"{i:064x}",
             "session": f"run-{i // 1000:03d}", "captured_at": 1.7e9 + i}
            for i in range(count)
        ]  # fmt: skip
        vectors = np.zeros((count, 1), np.uint8)
        fill(database, name, read_model("depth"), vectors, columns=columns, signed=signed)
        with database.write() as connection:
            added = select(frames.c.number).where(frames.c.map_number == row.number)
            rows = [
                {**job, "map_number": row.number, "id": f"{n:032x}", "frame_number": n}
                for n in connection.execute(added).scalars().all()
            ]
            connection.execute(insert(jobs), rows)
