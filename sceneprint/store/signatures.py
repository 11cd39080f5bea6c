"""Signatures, and what changed for searching since a revision of the map."""

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
    func,
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
    """What a worker made of a frame.

    Parameters
    ----------
    model_id : of the model that made it
    vector : the signature's bytes
    geometry : blob of the artifact
    n_patches, n_pairs : of each level
    """

    model_id: str
    vector: bytes
    geometry: str
    n_patches: Sequence[int]
    n_pairs: Sequence[int]


@dataclass(frozen=True)
class SignatureChange:
    """A frame that was indexed, or is searched no more; `vector` is None then, or is damaged.

    `deleted` says that it was deleted, or rejected by a model that its map came to have.
    """

    number: int
    frame_id: str
    revision: int
    vector: bytes | None
    deleted: bool = False


def index_frame(connection: Connection, frame: FrameRow, made: StoredSignature) -> int:
    """Store a signature and let queries find the frame; returns the map's revision."""
    # a map that goes back to a model may still have what that model once made of the frame
    _write_signature(connection, frame, made)
    mark_edited(connection, frame.number)  # it may have been indexed before
    revision = next_revision(connection, frame.map_number)
    moved = root_columns(connection, frame)
    if moved:
        moved |= position(moved["pose"])
    connection.execute(
        update(frames)
        .where(frames.c.number == frame.number)
        .values(
            state=FrameState.INDEXED,
            reason=None,
            indexed_at=time.time(),
            revision=revision,
            **moved,
        )
    )
    return revision


def index_claimed_frame(
    connection: Connection, job: JobRow, frame: FrameRow, map_name: str, made: StoredSignature
) -> bool:
    """End a job and index its frame in one statement, as most signatures are on PostgreSQL: the
    map's other writers wait for each round trip.

    Parameters
    ----------
    connection : of a writing transaction of the frame's map
    job : as it was claimed, of that frame
    frame, made : see `index_frame`
    map_name : of the frame's map

    Returns
    -------
    done : False, and nothing was written, on SQLite; where the job is not held any more; where
        the map has another model, or is to have one, or joined the frame's parent frame: then what
        else has to be done must be found
    """
    if connection.dialect.name == "sqlite":
        return False
    told = event_values("frame.indexed", map_name, frame.id, job.id, {})
    values = {
        "job": job.number, "token": job.token, "worker": job.worker, "map_number": frame.map_number,
        "frame": frame.number, "model": made.model_id, "vector": made.vector,
        "checksum": crc32(made.vector), "geometry": made.geometry,
        "n_patches": json.dumps(list(made.n_patches)), "n_pairs": json.dumps(list(made.n_pairs)),
        "indexed_at": time.time(), "parent": frame.pose_parent, **told,
        "data": json.dumps(told["data"]),
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
        ), found AS (
            UPDATE frames SET state = '{FrameState.INDEXED}', reason = NULL,
                indexed_at = :indexed_at, revision = revised.revision
            FROM revised WHERE number = :frame
        ), told AS (
            INSERT INTO {events_name} (at, kind, map, frame_id, job_id, data)
            SELECT :at, :kind, :map, :frame_id, :job_id, cast(:data AS json) FROM revised
        )
        SELECT revision FROM revised
        """
    )


def replace_signature(connection: Connection, frame: FrameRow, made: StoredSignature) -> bool:
    """Store what was made of an indexed frame once more, in place of what is damaged or missing.

    The frame stays found all the while. Where the bytes of the map's own signatures change, it
    takes the map's next revision, so that readers and indexes learn of it.

    Returns
    -------
    changed : whether the stored bytes were others
    """
    own = (signatures.c.frame_number == frame.number) & (signatures.c.model_id == made.model_id)
    known = connection.execute(select(signatures.c.vector, signatures.c.checksum).where(own))
    before = known.first()
    _write_signature(connection, frame, made)
    searched = select(maps.c.model_id).where(maps.c.number == frame.map_number)
    is_searched = connection.execute(searched).scalar_one() == made.model_id
    if is_searched:  # its artifact may have been lost
        note_edit(connection, frame.number, frame.map_number)
    # a checksum that does not fit made readers pass the frame over, whatever its bytes
    if before is not None and tuple(before) == (made.vector, crc32(made.vector)):
        return False
    if is_searched:
        revision = next_revision(connection, frame.map_number)
        connection.execute(
            update(frames).where(frames.c.number == frame.number).values(revision=revision)
        )
    return True


def _write_signature(connection: Connection, frame: FrameRow, made: StoredSignature) -> None:
    """Store a signature in place of the one that the model made before."""
    own = (signatures.c.frame_number == frame.number) & (signatures.c.model_id == made.model_id)
    connection.execute(delete(signatures).where(own))
    put_signatures(connection, [(frame.number, made)])


def put_signatures(connection: Connection, made: Sequence[tuple[int, StoredSignature]]) -> None:
    """Store signatures of frames, by their numbers, that have none of these models."""
    rows = [
        {
            "frame_number": number, "model_id": one.model_id, "vector": one.vector,
            "checksum": crc32(one.vector), "geometry": one.geometry,
            "n_patches": list(one.n_patches), "n_pairs": list(one.n_pairs),
        }
        for number, one in made
    ]  # fmt: skip
    connection.execute(insert(signatures), rows)


def changes_since(
    connection: Connection, row: MapRow, revision: int, limit: int = 256
) -> Iterator[list[SignatureChange]]:
    """What was indexed and deleted after a revision, in order, in blocks of at most `limit`."""
    while True:
        found = connection.execute(
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
        if not found:
            return
        yield [_change(*one) for one in found]
        revision = found[-1].revision


def _change(
    number: int, frame_id: str, revision: int, state: str, vector: bytes | None,
    checksum: int | None,
) -> SignatureChange:  # fmt: skip
    if state != FrameState.INDEXED:
        return SignatureChange(number, frame_id, revision, None, deleted=True)
    sound = vector is not None and crc32(vector) == checksum
    return SignatureChange(number, frame_id, revision, vector if sound else None)


def count_indexed(
    connection: Connection, map_number: int, revision: int, most: int | None = None
) -> int:
    """How many frames of a map were indexed after a revision, counted no farther than `most`."""
    newer = (
        select(frames.c.number)
        .where(
            frames.c.map_number == map_number,
            frames.c.revision > revision,
            frames.c.state == FrameState.INDEXED,
        )
        .limit(most)
    )
    return int(connection.execute(select(func.count()).select_from(newer.subquery())).scalar_one())


def deleted_since(connection: Connection, map_number: int, revision: int) -> frozenset[int]:
    """Numbers of the frames of a map that are searched no more since a revision."""
    gone = select(frames.c.number).where(*_gone(map_number, revision))
    return frozenset(connection.execute(gone).scalars())


def count_gone(connection: Connection, map_number: int, revision: int) -> int:
    """How many frames of a map are searched no more since a revision."""
    return count_rows(connection, *_gone(map_number, revision))


def _gone(map_number: int, revision: int) -> tuple[ColumnElement[bool], ...]:
    return (
        frames.c.map_number == map_number,
        frames.c.revision > revision,
        frames.c.state != FrameState.INDEXED,
    )


def stored_vector(connection: Connection, number: int, model_id: str) -> bytes | None:
    """The signature of a frame, or None where it has none.

    Raises
    ------
    DamagedSignature : its bytes are not those that were stored.
    """
    own = (signatures.c.frame_number == number) & (signatures.c.model_id == model_id)
    asked = select(signatures.c.vector, signatures.c.checksum).where(own)
    found = connection.execute(asked).first()
    if found is None:
        return None
    if crc32(found.vector) != found.checksum:
        raise DamagedSignature(
            "The signature of the frame is damaged: its checksum does not fit. It is made again "
            "from its upload while a worker runs; `sceneprint fsck` says whether that can be done."
        )
    return bytes(found.vector)


def patch_counts(
    connection: Connection, number: int, model_id: str
) -> tuple[list[int], list[int]] | None:
    """Patches and ordered pairs of each level of a signature, the finest first, if known."""
    asked = select(signatures.c.n_patches, signatures.c.n_pairs).where(
        signatures.c.frame_number == number, signatures.c.model_id == model_id
    )
    found = connection.execute(asked).first()
    return None if found is None else (found.n_patches, found.n_pairs)


def stored_signatures(
    connection: Connection, numbers: Iterable[int], model_id: str
) -> dict[int, bytes]:
    """Signatures of frames; those that have none, or a damaged one, are left out."""
    asked = select(signatures.c.frame_number, signatures.c.vector, signatures.c.checksum)
    own = asked.where(signatures.c.model_id == model_id)
    rows = rows_among(connection, own, signatures.c.frame_number, numbers)
    return {n: bytes(vector) for n, vector, checksum in rows if crc32(vector) == checksum}


# What is left of the models that a map no longer has, nor is to have.


def stale_signatures(connection: Connection, row: MapRow, after: int) -> list[tuple[int, str]]:
    """The next signatures of a map that are of neither of its models: frame, model."""
    found = connection.execute(
        select(signatures.c.frame_number, signatures.c.model_id)
        .join(frames, frames.c.number == signatures.c.frame_number)
        .where(
            frames.c.map_number == row.number, frames.c.number > after,
            signatures.c.model_id.not_in(reencoding_rows.models_of(row)),
        )
        .order_by(frames.c.number)
        .limit(reencoding_rows.REMOVED_AT_ONCE)
    )  # fmt: skip
    return [(number, model_id) for number, model_id in found]


def remove_signature(connection: Connection, number: int, model_id: str) -> list[str]:
    """Forget what a model made of a frame; returns the blobs that it referred to."""
    own = (signatures.c.frame_number == number) & (signatures.c.model_id == model_id)
    blobs = list(connection.execute(select(signatures.c.geometry).where(own)).scalars())
    connection.execute(delete(signatures).where(own))
    return blobs


def stale_jobs(connection: Connection, row: MapRow) -> list[int]:
    """Some jobs that wait or run for a model that is neither of a map's."""
    found = connection.execute(
        select(jobs.c.number)
        .join(frames, frames.c.number == jobs.c.frame_number)
        .where(
            jobs.c.state.in_(PENDING), jobs.c.kind == reencoding_rows.REENCODE,
            jobs.c.model_id.not_in(reencoding_rows.models_of(row)),
            frames.c.map_number == row.number,
        )
        .limit(reencoding_rows.QUEUED_AT_ONCE)
    )  # fmt: skip
    return list(found.scalars())
