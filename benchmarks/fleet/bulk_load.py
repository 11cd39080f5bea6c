"""Maps of many frames at once: rows as workers leave them, of signatures made elsewhere.

signatures  --fill-->  a map whose frames are indexed
"""

from __future__ import annotations

import time
import zlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from sqlalchemy import insert, select, update

from sceneprint.models import Model, write_model
from sceneprint.store import Database
from sceneprint.store.events import record_event
from sceneprint.store.maps import keep_model
from sceneprint.store.tables import frames, maps, signatures
from sceneprint.types import Bytes
from sceneprint_client.api import FrameState

#: Frames of one commit.
BLOCK = 500


def walk(n: int, length: int, seed: int = 0, walks: int = 1) -> Bytes:
    """Signatures (n, length) of a camera on smooth walks: near frames alike, none a cluster.

    Sixteen slow sinusoids of random period are where the camera is; a fixed nonlinear map of low
    rank, the same for every walk, makes them bytes; and every byte has noise of its own.
    """
    place = np.random.default_rng(99)
    mix, fold = place.normal(size=(16, 48)), place.normal(size=(48, length))
    rng = np.random.default_rng(seed)
    found: Bytes = np.empty((n, length), np.uint8)
    for steps in np.array_split(np.arange(n), walks):
        periods, begin = rng.uniform(150, 900, 16), rng.random(16)
        for some in np.array_split(steps, len(steps) // 256 + 1):
            angles = 2 * np.pi * ((some - steps[0])[:, None] / periods + begin)
            smooth = np.abs(np.tanh(np.sin(angles) @ mix / 2) @ fold) * 9
            noisy = smooth + rng.normal(size=smooth.shape) * 4 + 12
            found[some] = np.clip(noisy, 0, 255).astype(np.uint8)
    return found


def fill(
    database: Database, name: str, model: Model, made: Bytes,
    known: Sequence[Mapping[str, Any]] | None = None, blob: str = "0" * 64,
) -> list[str]:  # fmt: skip
    """Put indexed frames into a map, which is made if it is not there; their ids.

    Parameters
    ----------
    database : of the store
    name : of the map
    model : of its signatures
    made : (n, D) their signatures
    known : columns of each frame that differ from those of any other
    blob : digest of the upload and the artifact of each frame
    """
    names = []
    for start in range(0, len(made), BLOCK):
        some = made[start : start + BLOCK]
        more = known[start : start + BLOCK] if known is not None else [{}] * len(some)
        names += _block(database, name, model, some, more, blob)
    return names


def _block(
    database: Database, name: str, model: Model, made: Bytes, known: Sequence[Mapping[str, Any]],
    blob: str,
) -> list[str]:  # fmt: skip
    now = time.time()
    with database.write() as connection:
        number = connection.execute(select(maps.c.number).where(maps.c.name == name)).scalar()
        if number is None:
            keep_model(connection, model.id, model.name, write_model(model))
            values = {"name": name, "model_id": model.id, "revision": 0, "created_at": now}
            connection.execute(insert(maps).values(values))
            record_event(connection, "map.created", name)
            number = connection.execute(select(maps.c.number).where(maps.c.name == name)).scalar()
        asked = update(maps).where(maps.c.number == number)
        last = connection.execute(
            asked.values(revision=maps.c.revision + len(made)).returning(maps.c.revision)
        ).scalar_one()
        names = [f"{name}-{last - len(made) + i}" for i in range(1, len(made) + 1)]
        connection.execute(
            insert(frames),
            [
                {
                    "id": one, "map_number": number, "state": FrameState.INDEXED, "blob": blob,
                    "content_id": one, "bytes": 1, "intrinsics": None, "depth_scale": 0.001,
                    "depth_along_ray": False, "tags": [], "received_at": now, "indexed_at": now,
                    "revision": last - len(made) + i, "session": None, "robot": None, **more,
                }
                for i, (one, more) in enumerate(zip(names, known, strict=True), 1)
            ],
        )  # fmt: skip
        found = connection.execute(
            select(frames.c.number)
            .where(frames.c.map_number == number, frames.c.revision > last - len(made))
            .order_by(frames.c.revision)
        ).scalars()
        connection.execute(
            insert(signatures),
            [
                {
                    "frame_number": frame, "model_id": model.id, "vector": row.tobytes(),
                    "checksum": zlib.crc32(row), "geometry": blob, "n_patches": [1],
                    "n_pairs": [1],
                }
                for frame, row in zip(found, made, strict=True)
            ],
        )  # fmt: skip
    return names
