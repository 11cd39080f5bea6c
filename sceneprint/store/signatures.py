"""Signatures of frames, and changes to the searched frames since a revision of the map."""

from __future__ import annotations

import json
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from zlib import crc32

from sqlalchemy import (
    ColumnElement,
    Connection,
    TextClause,
    delete,
    insert,
    select,
    text,
    update,
)

from sceneprint.errors import DamagedSignature
from sceneprint.store import reencoding_rows
from sceneprint.store.events import events_table
from sceneprint.store.maps import next_revision, position
from sceneprint.store.parent_joins import root_columns
from sceneprint.store.queue import PENDING
from sceneprint.store.surface_rows import mark_edited, note_edit
from sceneprint.store.tables import (
    FrameRow,
    JobRow,
    MapRow,
    count_rows,
    event_values,
    frames,
    jobs,
    maps,
    rows_among,
    signatures,
)
from sceneprint_client.api import FrameState, JobState


@dataclass(frozen=True)
class StoredSignature:
    """The result of signing a frame.

    Parameters
    ----------
    vector : bytes of the signature
    geometry : blob of the artifact
    n_patches, n_pairs : number of patches, and of ordered pairs, per level
    """

    model_id: str
    vector: bytes
    geometry: str
    n_patches: Sequence[int]
    n_pairs: Sequence[int]


@dataclass(frozen=True)
class SignatureChange:
    """A change of a frame: it was indexed, or is no longer searched.

    `vector` is None if the frame is not searched, or its signature is damaged. `deleted` is True
    for deleted frames, and for frames that a new model of the map has rejected.
    """

    number: int
    frame_id: str
    revision: int
    vector: bytes | None
    deleted: bool = False


def index_frame(connection: Connection, frame: FrameRow, signature: StoredSignature) -> int:
    """Store a signature, index its frame, and return the new revision of the map."""
    # a signature may exist after a return to a former model
    _write_signature(connection, frame, signature)
    mark_edited(connection, [frame.number])  # a surface may contain the frame
    revision = next_revision(connection, frame.map_number)
    moved = root_columns(connection, frame)
    if moved:
        moved |= position(moved["pose"])
    connection.execute(
        update(frames)
        .where(frames.c.number == frame.number)
        .values(
            state=FrameState.INDEXED, reason=None, indexed_at=time.time(), revision=revision,
            **moved,
        )
    )  # fmt: skip
    return revision


def index_claimed_frame(
    connection: Connection, job: JobRow, frame: FrameRow, map_name: str, signature: StoredSignature
) -> bool:
    """End a job, index its frame and record an event with a single statement of PostgreSQL.

    Parameters
    ----------
    connection : writing transaction of the frame's map

    Returns
    -------
    done : False if nothing was written: on SQLite, or if the worker no longer holds the job, the
        map has or is getting another model, or the parent frame is joined. The caller determines
        the reason
    """
    if connection.dialect.name == "sqlite":
        return False
    event = event_values("frame.indexed", map_name, frame.id, job.id, {})
    values = {
        "job": job.number, "token": job.token, "worker": job.worker, "map_number": frame.map_number,
        "frame": frame.number, "model": signature.model_id, "vector": signature.vector,
        "checksum": crc32(signature.vector), "geometry": signature.geometry,
        "n_patches": json.dumps(list(signature.n_patches)),
        "n_pairs": json.dumps(list(signature.n_pairs)),
        "indexed_at": time.time(), "parent": frame.pose_parent, **event,
        "data": json.dumps(event["data"]),
    }  # fmt: skip
    statement = _index_claimed(events_table(connection).name)
    return connection.execute(statement, values).first() is not None


@cache
def _index_claimed(events_name: str) -> TextClause:
    return text(
        f"""
        WITH ended AS (
            UPDATE jobs SET state = '{JobState.SUCCEEDED}', error = NULL, traceback = NULL,
                leased_until = NULL, finished_at = extract(epoch FROM statement_timestamp())
            WHERE number = :job AND token = :token AND worker = :worker
                AND state = '{JobState.RUNNING}'
                AND EXISTS (
                    SELECT FROM maps WHERE number = :map_number AND model_id = :model
                        AND next_model_id IS NULL)
                AND NOT EXISTS (
                    SELECT FROM parent_joins WHERE map_number = :map_number
                        AND parent = cast(:parent AS text) AND undone_at IS NULL)
            RETURNING number
        ), revised AS (
            UPDATE maps SET revision = revision + 1
            WHERE number = :map_number AND EXISTS (SELECT FROM ended) RETURNING revision
        ), signed AS (
            INSERT INTO signatures (frame_number, model_id, vector, checksum, geometry, n_patches,
                n_pairs)
            SELECT :frame, :model, :vector, :checksum, :geometry, cast(:n_patches AS json),
                cast(:n_pairs AS json) FROM revised
            ON CONFLICT (frame_number, model_id) DO UPDATE SET vector = EXCLUDED.vector,
                checksum = EXCLUDED.checksum, geometry = EXCLUDED.geometry,
                n_patches = EXCLUDED.n_patches, n_pairs = EXCLUDED.n_pairs
        ), edited AS (
            UPDATE surface_frames SET changed = true FROM revised WHERE frame_number = :frame
        ), indexed AS (
            UPDATE frames SET state = '{FrameState.INDEXED}', reason = NULL,
                indexed_at = :indexed_at, revision = revised.revision
            FROM revised WHERE number = :frame
        ), reported AS (
            INSERT INTO {events_name} (at, kind, map, frame_id, job_id, data)
            SELECT :at, :kind, :map, :frame_id, :job_id, cast(:data AS json) FROM revised
        )
        SELECT revision FROM revised
        """
    )


def replace_signature(connection: Connection, frame: FrameRow, signature: StoredSignature) -> bool:
    """Replace a damaged or missing signature of an indexed frame.

    If the signature belongs to the current model and changes, the frame gets the next revision of
    the map, so that readers and indexes read it again.

    Returns
    -------
    changed : whether the stored bytes changed
    """
    own = (signatures.c.frame_number == frame.number) & (
        signatures.c.model_id == signature.model_id
    )
    stored = connection.execute(select(signatures.c.vector, signatures.c.checksum).where(own))
    before = stored.first()
    _write_signature(connection, frame, signature)
    searched = select(maps.c.model_id).where(maps.c.number == frame.map_number)
    is_searched = connection.execute(searched).scalar_one() == signature.model_id
    if is_searched:  # the artifact may have been lost
        note_edit(connection, [frame.number], frame.map_number)
    # compare the checksum too, since readers skip frames with a wrong checksum
    if before is not None and tuple(before) == (signature.vector, crc32(signature.vector)):
        return False
    if is_searched:
        revision = next_revision(connection, frame.map_number)
        connection.execute(
            update(frames).where(frames.c.number == frame.number).values(revision=revision)
        )
    return True


def _write_signature(connection: Connection, frame: FrameRow, signature: StoredSignature) -> None:
    """Insert or replace the signature of a frame for a model."""
    own = (signatures.c.frame_number == frame.number) & (
        signatures.c.model_id == signature.model_id
    )
    connection.execute(delete(signatures).where(own))
    put_signatures(connection, [(frame.number, signature)])


def put_signatures(connection: Connection, new: Sequence[tuple[int, StoredSignature]]) -> None:
    """Insert signatures by frame number; the frames must lack signatures of these models."""
    rows = [
        {
            "frame_number": number, "model_id": signature.model_id, "vector": signature.vector,
            "checksum": crc32(signature.vector), "geometry": signature.geometry,
            "n_patches": list(signature.n_patches), "n_pairs": list(signature.n_pairs),
        }
        for number, signature in new
    ]  # fmt: skip
    connection.execute(insert(signatures), rows)


def changes_since(
    connection: Connection, row: MapRow, revision: int, limit: int = 256
) -> Iterator[list[SignatureChange]]:
    """Yield the changes after a revision in order, in blocks of up to `limit`."""
    while True:
        rows = connection.execute(
            select(frames.c.number, frames.c.id, frames.c.revision, frames.c.state,
                   signatures.c.vector, signatures.c.checksum)
            .outerjoin(
                signatures,
                (signatures.c.frame_number == frames.c.number)
                & (signatures.c.model_id == row.model_id),
            )
            .where(frames.c.map_number == row.number, frames.c.revision > revision)
            .order_by(frames.c.revision)
            .limit(limit)
        ).all()  # fmt: skip
        if not rows:
            return
        yield [_change(*columns) for columns in rows]
        revision = rows[-1].revision


def _change(
    number: int, frame_id: str, revision: int, state: str, vector: bytes | None,
    checksum: int | None,
) -> SignatureChange:  # fmt: skip
    if state != FrameState.INDEXED:
        return SignatureChange(number, frame_id, revision, None, deleted=True)
    sound = vector is not None and crc32(vector) == checksum
    return SignatureChange(number, frame_id, revision, vector if sound else None)


def count_indexed(connection: Connection, map_number: int, revision: int) -> int:
    """Count the frames of a map that were indexed after a revision."""
    return count_rows(
        connection, frames.c.map_number == map_number, frames.c.revision > revision,
        frames.c.state == FrameState.INDEXED,
    )  # fmt: skip


def deleted_since(connection: Connection, map_number: int, revision: int) -> frozenset[int]:
    """Return the numbers of the frames of a map that left the search after a revision."""
    statement = select(frames.c.number).where(*_deletion_conditions(map_number, revision))
    return frozenset(connection.execute(statement).scalars())


def count_gone(connection: Connection, map_number: int, revision: int) -> int:
    """Count the frames of a map that left the search after a revision."""
    return count_rows(connection, *_deletion_conditions(map_number, revision))


def _deletion_conditions(map_number: int, revision: int) -> tuple[ColumnElement[bool], ...]:
    return (
        frames.c.map_number == map_number,
        frames.c.revision > revision,
        frames.c.state != FrameState.INDEXED,
    )


def stored_vector(connection: Connection, number: int, model_id: str) -> bytes | None:
    """Return the signature of a frame, None if missing. Raise DamagedSignature if it is damaged."""
    own = (signatures.c.frame_number == number) & (signatures.c.model_id == model_id)
    statement = select(signatures.c.vector, signatures.c.checksum).where(own)
    row = connection.execute(statement).first()
    if row is None:
        return None
    if crc32(row.vector) != row.checksum:
        raise DamagedSignature(
            "The signature of the frame is damaged: its checksum is wrong. A worker will compute "
            "it again from the upload. Run `sceneprint fsck` to check whether this is possible."
        )
    return bytes(row.vector)


def patch_counts(
    connection: Connection, number: int, model_id: str
) -> tuple[list[int], list[int]] | None:
    """Return the counts of patches and ordered pairs per level, finest first; None if unsigned."""
    statement = select(signatures.c.n_patches, signatures.c.n_pairs).where(
        signatures.c.frame_number == number, signatures.c.model_id == model_id
    )
    row = connection.execute(statement).first()
    return None if row is None else (row.n_patches, row.n_pairs)


def stored_signatures(
    connection: Connection, numbers: Iterable[int], model_id: str
) -> dict[int, bytes]:
    """Return the signatures of frames by frame number, except missing or damaged signatures."""
    statement = select(signatures.c.frame_number, signatures.c.vector, signatures.c.checksum)
    own = statement.where(signatures.c.model_id == model_id)
    rows = rows_among(connection, own, signatures.c.frame_number, numbers)
    return {n: bytes(vector) for n, vector, checksum in rows if crc32(vector) == checksum}


# Signatures and jobs of models that are neither the current nor the next model of a map.


def stale_signatures(connection: Connection, row: MapRow, after: int) -> list[tuple[int, str]]:
    """Return frame number and model of obsolete signatures of a map, after frame number `after`."""
    rows = connection.execute(
        select(signatures.c.frame_number, signatures.c.model_id)
        .join(frames, frames.c.number == signatures.c.frame_number)
        .where(
            frames.c.map_number == row.number, frames.c.number > after,
            signatures.c.model_id.not_in(reencoding_rows.models_of(row)),
        )
        .order_by(frames.c.number)
        .limit(reencoding_rows.REMOVED_AT_ONCE)
    )  # fmt: skip
    return [(number, model_id) for number, model_id in rows]


def remove_signature(connection: Connection, number: int, model_id: str) -> list[str]:
    """Remove the signature of a frame for a model; return the blobs that the row referred to."""
    own = (signatures.c.frame_number == number) & (signatures.c.model_id == model_id)
    blobs = list(connection.execute(select(signatures.c.geometry).where(own)).scalars())
    connection.execute(delete(signatures).where(own))
    return blobs


def stale_jobs(connection: Connection, row: MapRow) -> list[int]:
    """Return the numbers of a block of unfinished jobs for models that a map does not use."""
    numbers = connection.execute(
        select(jobs.c.number)
        .join(frames, frames.c.number == jobs.c.frame_number)
        .where(
            jobs.c.state.in_(PENDING), jobs.c.kind == reencoding_rows.REENCODE,
            jobs.c.model_id.not_in(reencoding_rows.models_of(row)),
            frames.c.map_number == row.number,
        )
        .limit(reencoding_rows.QUEUED_AT_ONCE)
    )  # fmt: skip
    return list(numbers.scalars())
