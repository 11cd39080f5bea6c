"""Fill maps with many frames by writing the rows that workers would write."""

from __future__ import annotations

import time
import zlib
from collections.abc import Mapping, Sequence
from itertools import repeat
from typing import Any

from sqlalchemy import Connection, insert, select, update

from sceneprint.models import Model, write_model
from sceneprint.store import Database
from sceneprint.store.events import record_event
from sceneprint.store.maps import store_model
from sceneprint.store.tables import frames, maps, signatures
from sceneprint.types import Bytes
from sceneprint_client.api import FrameState

#: Number of frames in one commit.
BLOCK = 2_000


def fill(
    database: Database, name: str, model: Model, vectors: Bytes, *, blob: str = "0" * 64,
    columns: Sequence[Mapping[str, Any]] | None = None, signed: Mapping[str, Any] | None = None,
) -> None:  # fmt: skip
    """Add indexed frames to a map, which is created if it does not exist.

    Parameters
    ----------
    vectors : (n, D) signatures
    blob : digest of the upload and the artifact of all frames
    columns : other column values of each frame
    signed : other column values of all signatures
    """
    for start in range(0, len(vectors), BLOCK):
        block = slice(start, start + BLOCK)
        own = repeat({}, BLOCK) if columns is None else columns[block]
        with database.write() as connection:
            number = _map_number(connection, name, model)
            n = len(vectors[block])
            last = connection.execute(
                update(maps)
                .where(maps.c.number == number)
                .values(revision=maps.c.revision + n, used_frames=maps.c.used_frames + n)
                .returning(maps.c.revision)
            ).scalar_one()
            now = time.time()
            rows = [
                {
                    "id": f"{name}-{revision}", "map_number": number, "state": FrameState.INDEXED,
                    "blob": blob, "content_id": f"{name}-{revision}", "bytes": 1,
                    "intrinsics": None, "depth_scale": 0.001, "depth_along_ray": False, "tags": [],
                    "received_at": now, "indexed_at": now, "session": None, "robot": None,
                    **more, "revision": revision,
                }
                for revision, more in zip(range(last - n + 1, last + 1), own, strict=False)
            ]  # fmt: skip
            connection.execute(insert(frames), rows)
            numbers = connection.execute(
                select(frames.c.number)
                .where(frames.c.map_number == number, frames.c.revision > last - n)
                .order_by(frames.c.revision)
            ).scalars()
            vector_rows = [
                {
                    "model_id": model.id, "geometry": blob, "n_patches": [1], "n_pairs": [1],
                    **(signed or {}), "frame_number": frame, "vector": row.tobytes(),
                    "checksum": zlib.crc32(row),
                }
                for frame, row in zip(numbers, vectors[block], strict=True)
            ]  # fmt: skip
            connection.execute(insert(signatures), vector_rows)


def _map_number(connection: Connection, name: str, model: Model) -> int:
    """Return the number of a map; create the map if it does not exist."""
    number = connection.execute(select(maps.c.number).where(maps.c.name == name)).scalar()
    if number is None:
        store_model(connection, model.id, model.name, write_model(model))
        values = {"name": name, "model_id": model.id, "revision": 0, "created_at": time.time()}
        connection.execute(insert(maps).values(values))
        record_event(connection, "map.created", name)
        number = connection.execute(select(maps.c.number).where(maps.c.name == name)).scalar_one()
    return int(number)
