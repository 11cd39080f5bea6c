"""Rows of a map for a copy elsewhere: read as they are, and written as they were."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any

from sqlalchemy import Connection, Row, insert, select, update

from sceneprint.store.frames import write_frame
from sceneprint.store.maps import add_frame, find_map
from sceneprint.store.signatures import StoredSignature, index_frame, replace_signature
from sceneprint.store.tables import (
    FrameRow,
    MapRow,
    blocks,
    frame_row,
    frames,
    job_values,
    jobs,
    maps,
    models,
    signatures,
)
from sceneprint_client.api import FrameState, JobState

#: Columns of a frame that are copied; the rest is the store's own.
COPIED = (
    "content_id", "blob", "bytes", "intrinsics", "depth_scale", "depth_along_ray", "robot",
    "session", "captured_at", "tags", "pose_parent", "pose", "base_frame", "base", "novelty",
    "received_at", "indexed_at", "cloud", "up", "name", "sequence",
)  # fmt: skip
#: Columns of a signature that tell one from another without its bytes.
_TOLD = ("checksum", "geometry", "n_patches", "n_pairs")


def copied_values(row: Mapping[str, Any]) -> list[Any]:
    """All of a frame that is copied, with what tells its signature."""
    return [row[name] for name in (*COPIED, *_TOLD)]


def indexed_rows(connection: Connection, row: MapRow, after: int, limit: int) -> Sequence[Row[Any]]:
    """Indexed frames of a map in the order they came, without their vectors.

    Parameters
    ----------
    connection : of the database
    row : of the map
    after : number of the last frame before
    limit : at most so many
    """
    columns = [frames.c.number, frames.c.id, *(frames.c[name] for name in COPIED)]
    asked = select(*columns, *(signatures.c[name] for name in _TOLD))
    asked = _signed(asked, row).where(frames.c.number > after)
    return connection.execute(asked.order_by(frames.c.number).limit(limit)).all()


def rows_of_ids(connection: Connection, row: MapRow, ids: Sequence[str]) -> Sequence[Row[Any]]:
    """Indexed frames of a map with their signatures, in the order they came."""
    columns = [frames.c.id, *(frames.c[name] for name in COPIED), signatures.c.vector]
    asked = select(*columns, *(signatures.c[name] for name in _TOLD))
    asked = _signed(asked, row).where(frames.c.id.in_(ids))
    return connection.execute(asked.order_by(frames.c.number)).all()


def _signed(asked: Any, row: MapRow) -> Any:
    made = (signatures.c.frame_number == frames.c.number) & (signatures.c.model_id == row.model_id)
    own = frames.c.map_number == row.number
    return asked.join(signatures, made).where(own, frames.c.state == FrameState.INDEXED)


def has_artifact(connection: Connection, row: MapRow, digest: str) -> bool:
    """Whether a blob is the artifact of an indexed frame of a map."""
    asked = _signed(select(frames.c.number), row).where(signatures.c.geometry == digest)
    return connection.execute(asked.limit(1)).first() is not None


def model_of(connection: Connection, model_id: str) -> tuple[str, bytes]:
    """Name and file of a model that a map refers to."""
    asked = select(models.c.name, models.c.content).where(models.c.id == model_id)
    name, content = connection.execute(asked).one()
    return name, bytes(content)


def living_rows(connection: Connection, row: MapRow) -> dict[str, FrameRow]:
    """All frames of a map that are not deleted, by their ids."""
    own = frames.c.map_number == row.number, frames.c.state != FrameState.DELETED
    found = connection.execute(select(frames).where(*own)).mappings()
    return {one["id"]: frame_row(one) for one in found}


def date_map(connection: Connection, row: MapRow, created_at: float) -> MapRow:
    """Let a map be as old as the one that it is a copy of."""
    own = update(maps).where(maps.c.number == row.number)
    connection.execute(own.values(created_at=created_at))
    return find_map(connection, row.name)


def put_copied(
    connection: Connection, row: MapRow, there: FrameRow | None, frame_id: str,
    values: Mapping[str, Any], made: StoredSignature,
) -> None:  # fmt: skip
    """Write a frame as it is elsewhere, found by queries at once.

    Parameters
    ----------
    connection : of a writing transaction
    row : of the map
    there : the frame of that id and content, as it is here; None: it is new
    frame_id : its id
    values : by column of COPIED
    made : its signature
    """
    if there is None:
        frame = add_frame(connection, row.number, dict(values), frame_id)
        done = {
            "frame_number": frame.number, "map_number": row.number,
            "state": JobState.SUCCEEDED, "attempts": 1,
        }  # fmt: skip
        times = dict.fromkeys(("started_at", "finished_at"), time.time())
        connection.execute(
            insert(jobs).values(**(job_values(connection, "sign", 0) | done | times))
        )
        index_frame(connection, frame, made)
    else:
        frame = there
        write_frame(connection, row, there, values)
        replace_signature(connection, there, made)
    own = update(frames).where(frames.c.number == frame.number)
    connection.execute(own.values(indexed_at=values["indexed_at"]))


def numbers_in_blocks(found: Sequence[FrameRow]) -> list[list[int]]:
    """Numbers of frames, some hundred at a time."""
    return [list(some) for some in blocks([one.number for one in found])]
