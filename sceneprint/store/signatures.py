"""Signatures, and what changed for searching since a revision of the map."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from zlib import crc32

from sqlalchemy import Connection, delete, func, insert, select, update

from sceneprint.errors import DamagedSignature
from sceneprint.schemas import FrameState
from sceneprint.store import vectors
from sceneprint.store.blocks import among, blocks
from sceneprint.store.maps import next_revision
from sceneprint.store.records import FrameRow, MapRow
from sceneprint.store.tables import frames, maps, signatures


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
class Sizes:
    """Patches and ordered pairs of each level of a frame, the finest first."""

    n_patches: tuple[int, ...]
    n_pairs: tuple[int, ...]


@dataclass(frozen=True)
class Change:
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
    connection.execute(
        delete(signatures).where(
            signatures.c.frame_number == frame.number, signatures.c.model_id == made.model_id
        )
    )
    connection.execute(
        insert(signatures).values(
            frame_number=frame.number, model_id=made.model_id, vector=made.vector,
            checksum=crc32(made.vector), geometry=made.geometry,
            n_patches=list(made.n_patches), n_pairs=list(made.n_pairs),
        )
    )  # fmt: skip
    vectors.put(connection, frame.number, made.model_id, len(made.vector))
    revision = next_revision(connection, frame.map_number)
    connection.execute(
        update(frames)
        .where(frames.c.number == frame.number)
        .values(state=FrameState.INDEXED, reason=None, indexed_at=time.time(), revision=revision)
    )
    return revision


def replace_signature(connection: Connection, frame: FrameRow, made: StoredSignature) -> bool:
    """Store what was made of an indexed frame once more, in place of what is damaged or missing.

    The frame stays found all the while. Where the bytes of the map's own signatures change, it
    takes the map's next revision, so that readers and indexes learn of it.

    Returns
    -------
    changed : whether the stored bytes were others
    """
    own = (signatures.c.frame_number == frame.number) & (signatures.c.model_id == made.model_id)
    values = {
        "vector": made.vector, "checksum": crc32(made.vector), "geometry": made.geometry,
        "n_patches": list(made.n_patches), "n_pairs": list(made.n_pairs),
    }  # fmt: skip
    known = connection.execute(select(signatures.c.vector, signatures.c.checksum).where(own))
    before = known.first()
    if before is None:
        connection.execute(
            insert(signatures).values(frame_number=frame.number, model_id=made.model_id, **values)
        )
    else:
        connection.execute(update(signatures).where(own).values(**values))
    vectors.put(connection, frame.number, made.model_id, len(made.vector))
    # a checksum that does not fit made readers pass the frame over, whatever its bytes
    if before is not None and tuple(before) == (made.vector, values["checksum"]):
        return False
    searched = select(maps.c.model_id).where(maps.c.number == frame.map_number)
    if connection.execute(searched).scalar_one() == made.model_id:
        revision = next_revision(connection, frame.map_number)
        connection.execute(
            update(frames).where(frames.c.number == frame.number).values(revision=revision)
        )
    return True


def changes_since(
    connection: Connection, row: MapRow, revision: int, limit: int = 256
) -> Iterator[list[Change]]:
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
) -> Change:  # fmt: skip
    if state != FrameState.INDEXED:
        return Change(number, frame_id, revision, None, deleted=True)
    sound = vector is not None and crc32(vector) == checksum
    return Change(number, frame_id, revision, vector if sound else None)


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
    found = connection.execute(
        select(frames.c.number).where(
            frames.c.map_number == map_number,
            frames.c.revision > revision,
            frames.c.state != FrameState.INDEXED,
        )
    )
    return frozenset(found.scalars())


def count_gone(connection: Connection, map_number: int, revision: int) -> int:
    """How many frames of a map are searched no more since a revision."""
    counted = connection.execute(
        select(func.count()).where(
            frames.c.map_number == map_number,
            frames.c.revision > revision,
            frames.c.state != FrameState.INDEXED,
        )
    )
    return int(counted.scalar_one())


def geometry_blobs(connection: Connection, numbers: Iterable[int], model_id: str) -> dict[int, str]:
    """Blobs of the geometry artifacts of frames."""
    found: dict[int, str] = {}
    for some in blocks(numbers):
        rows = connection.execute(
            select(signatures.c.frame_number, signatures.c.geometry).where(
                among(connection, signatures.c.frame_number, some),
                signatures.c.model_id == model_id,
            )
        )
        found |= {row.frame_number: row.geometry for row in rows}
    return found


def stored_vector(connection: Connection, number: int, model_id: str) -> bytes | None:
    """The signature of a frame, or None where it has none.

    Raises
    ------
    DamagedSignature : its bytes are not those that were stored.
    """
    found = connection.execute(
        select(signatures.c.vector, signatures.c.checksum).where(
            signatures.c.frame_number == number, signatures.c.model_id == model_id
        )
    ).first()
    if found is None:
        return None
    if crc32(found.vector) != found.checksum:
        raise DamagedSignature(
            "The signature of the frame is damaged: its checksum does not fit. It is made again "
            "from its upload while a worker runs; `sceneprint fsck` says whether that can be done."
        )
    return bytes(found.vector)


def signature_sizes(connection: Connection, number: int, model_id: str) -> Sizes | None:
    """How much of a frame went into its signature, or None where it has none."""
    found = connection.execute(
        select(signatures.c.n_patches, signatures.c.n_pairs).where(
            signatures.c.frame_number == number, signatures.c.model_id == model_id
        )
    ).first()
    return None if found is None else Sizes(tuple(found.n_patches), tuple(found.n_pairs))


def stored_signatures(
    connection: Connection, numbers: Iterable[int], model_id: str
) -> dict[int, bytes]:
    """Signatures of frames; those that have none, or a damaged one, are left out."""
    found: dict[int, bytes] = {}
    for some in blocks(numbers):
        rows = connection.execute(
            select(signatures.c.frame_number, signatures.c.vector, signatures.c.checksum).where(
                among(connection, signatures.c.frame_number, some),
                signatures.c.model_id == model_id,
            )
        )
        found |= {n: bytes(vector) for n, vector, checksum in rows if crc32(vector) == checksum}
    return found
