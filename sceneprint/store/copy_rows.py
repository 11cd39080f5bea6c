"""Reading of the rows of a map, and writing of these rows to a copy in another store."""

from __future__ import annotations

import time
import uuid
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Column, Connection, Row, insert, select, update

from sceneprint.store.maps import add_usage, find_map, next_revision, position, replace_id
from sceneprint.store.signatures import StoredSignature, put_signatures
from sceneprint.store.tables import (
    FrameRow,
    MapRow,
    frame_row,
    frame_tags,
    frames,
    job_values,
    jobs,
    maps,
    signatures,
)
from sceneprint_client.api import FrameState, JobState

#: Number of rows to read at once.
_BLOCK = 200
#: Columns of a frame to copy. The other columns are specific to a store.
COPIED_COLUMNS = (
    "content_id", "blob", "bytes", "intrinsics", "depth_scale", "depth_along_ray", "robot",
    "session", "captured_at", "tags", "pose_parent", "pose", "sent_parent", "sent_pose",
    "base_frame", "base", "novelty", "received_at", "indexed_at", "cloud", "up", "name", "sequence",
    "samples",
)  # fmt: skip
#: Columns of a copied frame: its id, the copied columns, and its signature.
COLUMNS: tuple[Column[Any], ...] = (
    frames.c.id, *(frames.c[name] for name in COPIED_COLUMNS), signatures.c.vector,
    signatures.c.geometry, signatures.c.n_patches, signatures.c.n_pairs,
)  # fmt: skip


def copied_rows(connection: Connection, row: MapRow) -> Iterator[Row[Any]]:
    """Yield `COLUMNS` of the indexed frames of a map, in upload order."""
    statement = _signed(select(*COLUMNS), row).order_by(frames.c.received_at, frames.c.number)
    options = {"stream_results": True}
    with closing(connection.execute(statement, execution_options=options)) as rows:
        while block := rows.fetchmany(_BLOCK):
            yield from block


def _signed(statement: Any, row: MapRow) -> Any:
    c = signatures.c
    has_model = (c.frame_number == frames.c.number) & (c.model_id == row.model_id)
    own = frames.c.map_number == row.number
    return statement.join(signatures, has_model).where(own, frames.c.state == FrameState.INDEXED)


def has_artifact(connection: Connection, row: MapRow, digest: str) -> bool:
    """Return whether a blob is the artifact of an indexed frame of a map."""
    statement = _signed(select(frames.c.number), row).where(signatures.c.geometry == digest)
    return connection.execute(statement.limit(1)).first() is not None


def living_rows(connection: Connection, row: MapRow) -> dict[str, FrameRow]:
    """Return all frames of a map, except deleted frames, by id."""
    own = frames.c.map_number == row.number, frames.c.state != FrameState.DELETED
    rows = connection.execute(select(frames).where(*own)).mappings()
    return {frame["id"]: frame_row(frame) for frame in rows}


def set_creation_time(connection: Connection, row: MapRow, created_at: float) -> MapRow:
    """Set the creation time of a map to `created_at`, and return the map."""
    own = update(maps).where(maps.c.number == row.number)
    connection.execute(own.values(created_at=created_at))
    return find_map(connection, row.name)


@dataclass(frozen=True, eq=False)
class CopiedFrame:
    """A frame of the original map.

    Parameters
    ----------
    values : values of COPIED_COLUMNS by name
    """

    id: str
    values: Mapping[str, Any]
    signature: StoredSignature


def add_copied(connection: Connection, row: MapRow, copies: Sequence[CopiedFrame]) -> None:
    """Add up to a few hundred indexed frames, each with a succeeded job, to a copy.

    Parameters
    ----------
    connection : writing transaction
    copies : frames whose ids are unused in the map, or used only by deleted frames
    """
    deleted = select(frames.c.id).where(
        frames.c.map_number == row.number, frames.c.id.in_([copy.id for copy in copies])
    )
    for frame_id in connection.execute(deleted).scalars().all():
        replace_id(connection, row.number, frame_id)
    last = next_revision(connection, row.number, len(copies))
    rows = [
        {
            **copy.values, **position(copy.values["pose"]), "id": copy.id, "map_number": row.number,
            "state": FrameState.INDEXED, "revision": last - len(copies) + i,
        }
        for i, copy in enumerate(copies, 1)
    ]  # fmt: skip
    added = insert(frames).returning(frames.c.number, sort_by_parameter_order=True)
    numbers = connection.execute(added, rows).scalars().all()
    add_usage(connection, row.number, len(copies), sum(copy.values["bytes"] for copy in copies))
    tags = [
        {"frame_number": number, "tag": tag}
        for number, copy in zip(numbers, copies, strict=True)
        for tag in sorted(set(copy.values["tags"]))
    ]
    if tags:
        connection.execute(insert(frame_tags), tags)
    put_signatures(connection, list(zip(numbers, [copy.signature for copy in copies], strict=True)))
    job, at = job_values(connection, "sign", 0), time.time()
    job |= {"map_number": row.number, "state": JobState.SUCCEEDED, "attempts": 1}
    job |= dict.fromkeys(("created_at", "run_after", "started_at", "finished_at"), at)
    ids = [uuid.uuid4().hex for _ in numbers]
    done = [job | {"id": job_id, "frame_number": n} for job_id, n in zip(ids, numbers, strict=True)]
    connection.execute(insert(jobs), done)
