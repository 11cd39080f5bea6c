"""Signatures whose bytes are not those that were stored."""

from __future__ import annotations

import json
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

from sqlalchemy import Connection, Text, cast, delete, func, select
from sqlalchemy.exc import DBAPIError

from sceneprint.engine.healing import PRIORITY
from sceneprint.engine.sweeping import sweep
from sceneprint.maintenance.findings import Finding, Folder, each
from sceneprint.maintenance.repairs import GONE, quarantine_bytes, sign_from_upload
from sceneprint.models import Model
from sceneprint.schemas import FrameState
from sceneprint.store.queue import enqueue
from sceneprint.store.reencoding import REENCODE
from sceneprint.store.tables import frames, maps, signatures

#: Signatures that are read in one transaction; one may have 125,000 bytes.
_BLOCK = 32


@dataclass(frozen=True)
class _Stored:
    """A signature as it lies in the database."""

    number: int
    frame_id: str
    map: str
    model_id: str
    searched: bool  # whether it is of its map's model, not of the one to come
    vector: bytes
    sound: bool


def check_signatures(folder: Folder) -> Iterator[Finding]:
    """Signatures of indexed frames, each against its checksum and its model."""
    for numbers in folder.numbers("signatures"):
        if folder.quick:
            folder.counts["signatures"] += _count(folder, numbers)
            continue
        for start in range(0, len(numbers), _BLOCK):
            block = numbers[start : start + _BLOCK]
            for one in each(folder, block, partial(_stored, folder)):
                folder.counts["signatures"] += 1
                if isinstance(one, tuple):
                    yield _finding(folder, one[0])
                elif not one.sound:
                    yield _finding(folder, one.number, one)


def _finding(folder: Folder, number: int, one: _Stored | None = None) -> Finding:
    frame = f"number {number}" if one is None else f"{one.frame_id} of map {one.map}"
    return Finding(
        "damaged-signature", f"the signature of frame {frame}", "damage",
        "its bytes are not those that were stored: queries pass it over",
        "move it to the quarantine, and have the frame signed again from its upload",
        map=None if one is None else one.map, frame_id=None if one is None else one.frame_id,
        repair=partial(_repair, folder, number),
    )  # fmt: skip


def _count(folder: Folder, numbers: list[int]) -> int:
    own = signatures.c.frame_number.in_(numbers)
    with folder.store.database.read() as connection:
        return int(connection.execute(select(func.count()).where(own)).scalar_one())


def _stored(folder: Folder, connection: Connection, numbers: list[int]) -> list[_Stored]:
    """The signatures that are searched, or will be: others are strays, whatever their bytes."""
    found = connection.execute(
        select(
            frames.c.number, frames.c.id, maps.c.name, signatures.c.model_id,
            signatures.c.model_id == maps.c.model_id,
            signatures.c.vector, signatures.c.checksum,
            cast(signatures.c.n_patches, Text), cast(signatures.c.n_pairs, Text),
        )
        .join(frames, frames.c.number == signatures.c.frame_number)
        .join(maps, maps.c.number == frames.c.map_number)
        .where(
            frames.c.number.in_(numbers),
            frames.c.state == FrameState.INDEXED,
            (signatures.c.model_id == maps.c.model_id)
            | (signatures.c.model_id == maps.c.next_model_id),
        )
    ).all()  # fmt: skip
    return [
        _Stored(
            number, frame_id, name, model_id, searched, vector,
            zlib.crc32(vector) == checksum and _fits(folder.model(model_id), vector, counts),
        )
        for number, frame_id, name, model_id, searched, vector, checksum, *counts in found
    ]  # fmt: skip


def _fits(model: Model | None, vector: bytes, counts: list[str]) -> bool:
    """Whether a signature is as long as its model makes them, with a count for each level."""
    if model is None:
        return True
    try:
        told = [json.loads(each) for each in counts]
    except ValueError:
        return False
    levels = len(model.levels)
    return len(vector) == model.signature_bytes and all(
        isinstance(one, list) and len(one) == levels and all(isinstance(n, int) for n in one)
        for one in told
    )


def _repair(folder: Folder, number: int) -> str:
    """Quarantine first, durably; then the row goes, and a job comes, in one commit."""
    own = signatures.c.frame_number == number
    with folder.store.database.write() as connection:
        try:
            damaged = [one for one in _stored(folder, connection, [number]) if not one.sound]
        except (ValueError, TypeError, DBAPIError):
            # not even its columns can be read: there is nothing to keep
            removed = connection.execute(delete(signatures).where(own))
            return f"{removed.rowcount} removed; {sign_from_upload(folder, connection, number)}"
        told, blobs = [], list[str]()
        for one in damaged:
            name = f"signature-{one.frame_id}-{one.model_id[:12]}.bin"
            place = quarantine_bytes(folder, name, one.vector)
            removal = delete(signatures).where(own, signatures.c.model_id == one.model_id)
            removed_blobs = connection.execute(removal.returning(signatures.c.geometry))
            blobs += removed_blobs.scalars()
            if one.searched:
                then = sign_from_upload(folder, connection, number)
            else:  # meanwhile the frame is found by its other signature
                enqueue(connection, REENCODE, number, PRIORITY, one.model_id)
                then = "a worker makes it again from the upload"
            told.append(f"moved to {place}; {then}")
    if blobs:
        sweep(folder.store, blobs)
    return "; ".join(told) or GONE
