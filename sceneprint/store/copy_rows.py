"""Rows of a map for a copy elsewhere: read as they are, and written as they were."""

from __future__ import annotations

import time
import uuid
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Column, Connection, Row, insert, select, update

from sceneprint.store.frames import write_frame
from sceneprint.store.maps import add_usage, find_map, free_id, next_revision, position
from sceneprint.store.signatures import StoredSignature, put_signatures, replace_signature
from sceneprint.store.tables import (
    FrameRow,
    MapRow,
    blocks,
    frame_row,
    frame_tags,
    frames,
    job_values,
    jobs,
    maps,
    models,
    signatures,
)
from sceneprint_client.api import FrameState, JobState

#: Rows that are held at once.
_BLOCK = 200
#: Columns of a frame that are copied; the rest is the store's own.
COPIED = (
    "content_id", "blob", "bytes", "intrinsics", "depth_scale", "depth_along_ray", "robot",
    "session", "captured_at", "tags", "pose_parent", "pose", "sent_parent", "sent_pose",
    "base_frame", "base", "novelty", "received_at", "indexed_at", "cloud", "up", "name", "sequence",
    "samples",
)  # fmt: skip
#: Columns of a copied frame: its id, those, and its signature.
COLUMNS: tuple[Column[Any], ...] = (
    frames.c.id, *(frames.c[name] for name in COPIED), signatures.c.vector, signatures.c.geometry,
    signatures.c.n_patches, signatures.c.n_pairs,
)  # fmt: skip


def copied_rows(connection: Connection, row: MapRow) -> Iterator[Row[Any]]:
    """Yield `COLUMNS` of the indexed frames of a map, in the order they came."""
    statement = _signed(select(*COLUMNS), row).order_by(frames.c.received_at, frames.c.number)
    options = {"stream_results": True}
    with closing(connection.execute(statement, execution_options=options)) as found:
        while block := found.fetchmany(_BLOCK):
            yield from block


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


@dataclass(frozen=True, eq=False)
class CopiedFrame:
    """A frame as it is elsewhere.

    Parameters
    ----------
    id : of the frame
    values : by column of COPIED
    made : its signature
    """

    id: str
    values: Mapping[str, Any]
    made: StoredSignature


def add_copied(connection: Connection, row: MapRow, found: Sequence[CopiedFrame]) -> None:
    """Add frames, found by queries at once: a few statements for some hundred of them.

    Parameters
    ----------
    connection : of a writing transaction
    found : of which the map has none that is not deleted
    """
    gone = select(frames.c.id).where(
        frames.c.map_number == row.number, frames.c.id.in_([one.id for one in found])
    )
    for frame_id in connection.execute(gone).scalars().all():
        free_id(connection, row.number, frame_id)
    last = next_revision(connection, row.number, len(found))
    rows = [
        {
            **one.values, **position(one.values["pose"]), "id": one.id, "map_number": row.number,
            "state": FrameState.INDEXED, "revision": last - len(found) + i,
        }
        for i, one in enumerate(found, 1)
    ]  # fmt: skip
    added = insert(frames).returning(frames.c.number, sort_by_parameter_order=True)
    numbers = connection.execute(added, rows).scalars().all()
    add_usage(connection, row.number, len(found), sum(one.values["bytes"] for one in found))
    tags = [
        {"frame_number": number, "tag": tag}
        for number, one in zip(numbers, found, strict=True)
        for tag in sorted(set(one.values["tags"]))
    ]
    if tags:
        connection.execute(insert(frame_tags), tags)
    put_signatures(connection, list(zip(numbers, [one.made for one in found], strict=True)))
    job, at = job_values(connection, "sign", 0), time.time()
    job |= {"map_number": row.number, "state": JobState.SUCCEEDED, "attempts": 1}
    job |= dict.fromkeys(("created_at", "run_after", "started_at", "finished_at"), at)
    ids = [uuid.uuid4().hex for _ in numbers]
    done = [
        job | {"id": one, "frame_number": number} for one, number in zip(ids, numbers, strict=True)
    ]
    connection.execute(insert(jobs), done)


def edit_copied(connection: Connection, row: MapRow, there: FrameRow, now: CopiedFrame) -> None:
    """Bring a frame to what it is elsewhere, where its content is the same."""
    write_frame(connection, row, there, now.values)
    replace_signature(connection, there, now.made)


def numbers_in_blocks(found: Sequence[FrameRow]) -> list[list[int]]:
    """Numbers of frames, some hundred at a time."""
    return [list(some) for some in blocks([one.number for one in found])]
