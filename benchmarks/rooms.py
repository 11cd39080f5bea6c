"""Synthetic rooms in a running service, as what looks at the dashboard needs them."""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import httpx
import numpy as np
from sqlalchemy import insert, select

from sceneprint.datasets import write_depth_png
from sceneprint.engine import Engine
from sceneprint.schemas import NewMap
from sceneprint.settings import Settings
from sceneprint.store.maps import find_map
from sceneprint.store.tables import frames as frame_table
from sceneprint.store.tables import jobs, signatures
from sceneprint.synth import synthesise_room

SEED = 21
#: Frames that are written in one commit.
_BLOCK = 5_000


@dataclass(frozen=True)
class Shot:
    """A depth image of a room, and what is sent with it."""

    png: bytes
    meta: dict[str, Any]


def shots(rooms: int, views: int) -> list[Shot]:
    """Views along a path through each room, by two robots in turn, a second apart."""
    found = []
    with TemporaryDirectory() as folder:
        path = Path(folder) / "frame.png"
        for room in range(rooms):
            made = synthesise_room(SEED, room, views, along_path=True).frames
            for view, frame in enumerate(made):
                write_depth_png(path, frame.depth, 1000.0)
                lens, who = frame.intrinsics, "bob" if view % 2 else "ann"
                if frame.pose is None:
                    raise ValueError(f"view {view} of room {room} has no pose")
                meta = {
                    "intrinsics": {
                        n: getattr(lens, n) for n in ("width", "height", "fx", "fy", "cx", "cy")
                    },
                    "robot": who,
                    "session": f"room-{room}/{who}",
                    "captured_at": f"2026-11-20T09:{room:02d}:{view:02d}Z",
                    "pose": {"parent_frame": f"room-{room}", "matrix": frame.pose.tolist()},
                    "tags": ["door"] if view == 0 else [],
                }
                found.append(Shot(path.read_bytes(), meta))
    return found


def send(client: httpx.Client, name: str, of: list[Shot]) -> list[str]:
    """Send frames to a map; their ids."""
    ids = []
    for shot in of:
        files = {"frame": ("frame.png", shot.png, "image/png")}
        answer = client.post(
            f"/v1/maps/{name}/frames", data={"meta": json.dumps(shot.meta)}, files=files
        )
        ids.append(str(answer.raise_for_status().json()["frame_id"]))
    return ids


def wait(client: httpx.Client, path: str, states: set[str]) -> None:
    """Wait until all frames of a map are in one of these states."""
    while set(client.get(path).raise_for_status().json()["frames"]) - states:
        time.sleep(0.1)


def multiply(data: Path, source: str, name: str, count: int) -> None:
    """Make a map of many frames that are all like the first of another map, for lists to show.

    They share its blobs; their signatures are a byte long, since nobody asks this map anything.

    Parameters
    ----------
    data : folder of the store
    source : name of a map with an indexed frame
    name : of the new map
    count : of its frames
    """
    rng = np.random.default_rng(SEED)
    with Engine(Settings(data_dir=data)) as engine:
        engine.create_map(NewMap(name=name, title=f"{count:,} frames", model="compact"))
        with engine.store.database.read() as connection:
            row, other = find_map(connection, name), find_map(connection, source)
            of_other = frame_table.c.map_number == other.number
            asked = select(frame_table).where(of_other, frame_table.c.revision > 0)
            asked = asked.order_by(frame_table.c.number).limit(1)
            frame = dict(connection.execute(asked).mappings().one())
            of_it = signatures.c.frame_number == frame.pop("number")
            signed = dict(connection.execute(select(signatures).where(of_it)).mappings().one())
            by = select(jobs).where(jobs.c.frame_number == signed["frame_number"])
            job = dict(connection.execute(by).mappings().one())
            del job["number"]
        for start in range(0, count, _BLOCK):
            block = range(start, min(start + _BLOCK, count))
            names = rng.bytes(16 * len(block)).hex()
            own = {"map_number": row.number, "received_at": time.time(), "indexed_at": time.time()}
            made = [
                {**frame, **own, "id": names[32 * i : 32 * i + 32], "content_id": f"{place:064x}",
                 "session": f"run-{place // 1000:03d}", "captured_at": 1.7e9 + place,
                 "revision": place + 1}
                for i, place in enumerate(block)
            ]  # fmt: skip
            with engine.store.database.write() as connection:
                connection.execute(insert(frame_table), made)
                where = frame_table.c.map_number == row.number
                added = select(frame_table.c.number).where(
                    where, frame_table.c.revision > start, frame_table.c.revision <= block.stop
                )
                numbers = connection.execute(added).scalars().all()
                vectors = [{**signed, "frame_number": n, "vector": b"\0"} for n in numbers]
                connection.execute(insert(signatures), vectors)
                about = {"map_number": row.number}
                done = [{**job, **about, "id": f"{n:032x}", "frame_number": n} for n in numbers]
                connection.execute(insert(jobs), done)
