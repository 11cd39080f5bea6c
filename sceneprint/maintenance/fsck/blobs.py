"""Blobs that frames refer to: uploads and artifacts that are lost or damaged."""

from __future__ import annotations

import json
import re
import time
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from sqlalchemy import Connection, Text, cast, delete, func, select, update
from sqlalchemy.exc import DBAPIError

from sceneprint.engine.upkeep.garbage_collection import collect_blobs
from sceneprint.engine.upkeep.repair import PRIORITY, is_known_loss, reason_of_loss
from sceneprint.errors import StoreError
from sceneprint.maintenance.fsck.findings import (
    BUSY_BLOBS,
    GONE,
    Finding,
    Folder,
    each,
    quarantine_blob,
    quarantine_bytes,
    sign_from_upload,
    sign_while_indexed,
)
from sceneprint.models import Model
from sceneprint.models.model_file import is_sound_table
from sceneprint.store.blobs.folder import PART, BlobEntry, Condition
from sceneprint.store.events import record_event
from sceneprint.store.frames import refers_to
from sceneprint.store.maps import map_of
from sceneprint.store.queue import cancel_jobs, enqueue, remove_parts
from sceneprint.store.reencoding_rows import REENCODE
from sceneprint.store.surface_rows import spoil_tile, tile_of_number
from sceneprint.store.tables import (
    frames,
    job_files,
    jobs,
    maps,
    signatures,
    surface_tiles,
)
from sceneprint_client.api import FrameState, JobState

_BEING_SIGNED = (FrameState.RECEIVED, FrameState.SIGNING)


@dataclass(frozen=True)
class _Reference:
    """A blob as a frame refers to it: its upload, or an artifact made by a model."""

    number: int
    frame_id: str
    map: str
    state: str
    reason: str | None
    upload: str
    model_id: str | None = None
    artifact: str | None = None
    on_its_way: bool = False  # whether a job is to make the artifact again

    @property
    def digest(self) -> str:
        return self.upload if self.artifact is None else self.artifact

    @property
    def what(self) -> str:
        kind = "upload" if self.artifact is None else "artifact"
        return f"the {kind} of frame {self.frame_id} of map {self.map}"


def check_uploads(folder: Folder) -> Iterator[Finding]:
    """Uploads of frames that are kept, each against its hash."""
    for numbers in folder.numbers("uploads"):
        for one in each(folder, numbers, _uploads):
            if isinstance(one, tuple):
                continue  # found when rows were looked at
            folder.counts["blobs"] += 1
            condition = _condition(folder, one)
            if condition == "sound" or not _still(folder, one):
                continue
            known = condition == "missing" and is_known_loss(one.reason)
            means = reason_of_loss(condition, found=one.state == FrameState.INDEXED)
            yield Finding(
                f"{condition}-upload", one.what, "note" if known else "damage",
                "known: " + means if known else means,
                None if known else _would(one, condition),
                map=one.map, frame_id=one.frame_id, path=folder.store.blobs.place(one.digest),
                repair=None if known else partial(_repair_upload, folder, one),
            )  # fmt: skip


def check_artifacts(folder: Folder) -> Iterator[Finding]:
    """Geometry artifacts of indexed frames, each against its hash."""
    for numbers in folder.numbers("artifacts"):
        for one in each(folder, numbers, _artifacts):
            if isinstance(one, tuple):
                continue
            folder.counts["blobs"] += 1
            condition = _condition(folder, one)
            if condition == "sound" or not _still(folder, one):
                continue
            known = condition == "missing" and (one.on_its_way or is_known_loss(one.reason))
            means = "the frame is found, and cannot be validated"
            if known:
                then = "a job is to make it again" if one.on_its_way else "so is its upload"
                means = f"{means}; known: {then}"
            move = "move it to the quarantine, and " if condition == "damaged" else ""
            yield Finding(
                f"{condition}-artifact", one.what, "note" if known else "damage", means,
                None if known else f"{move}have it made again from the upload",
                map=one.map, frame_id=one.frame_id, path=folder.store.blobs.place(one.digest),
                repair=None if known else partial(_repair_artifact, folder, one),
            )  # fmt: skip


def _would(one: _Reference, condition: Condition) -> str:
    move = "move it to the quarantine, " if condition == "damaged" else ""
    if one.state == FrameState.INDEXED:
        return f"{move}keep the frame, which is found without it, and say so in its reason"
    return f"{move}let the frame be {_without(one)}, and say so in its reason"


def _without(one: _Reference) -> str:
    """State of a frame that has lost its upload."""
    return FrameState.FAILED if one.state in _BEING_SIGNED else one.state


def _condition(folder: Folder, one: _Reference) -> Condition:
    return folder.store.blobs.condition(one.digest, quick=folder.quick)


def _still(folder: Folder, one: _Reference) -> bool:
    """Whether the frame still refers to the blob, which may have been deleted since."""
    with folder.store.database.read() as connection:
        return _now(connection, one) is not None


def _now(connection: Connection, one: _Reference) -> _Reference | None:
    read = _uploads if one.artifact is None else _artifacts
    same = (
        now
        for now in read(connection, [one.number])
        if (now.digest, now.model_id) == (one.digest, one.model_id)
    )
    return next(same, None)


_COLUMNS = (
    frames.c.number, frames.c.id, maps.c.name, frames.c.state, frames.c.reason, frames.c.blob,
)  # fmt: skip


def _uploads(connection: Connection, numbers: list[int]) -> list[_Reference]:
    found = connection.execute(
        select(*_COLUMNS)
        .join(maps, maps.c.number == frames.c.map_number)
        .where(
            frames.c.number.in_(numbers),
            frames.c.state.not_in((FrameState.DELETED, FrameState.REDUNDANT)),
        )
        .order_by(frames.c.number)
    ).all()
    return [_Reference(*row) for row in found]


def _artifacts(connection: Connection, numbers: list[int]) -> list[_Reference]:
    job = (
        select(jobs.c.number)
        .where(
            jobs.c.frame_number == frames.c.number,
            jobs.c.kind == REENCODE,
            jobs.c.model_id == signatures.c.model_id,
            jobs.c.state.in_((JobState.QUEUED, JobState.RUNNING)),
        )
        .exists()
    )
    found = connection.execute(
        select(*_COLUMNS, signatures.c.model_id, signatures.c.geometry, job)
        .join(maps, maps.c.number == frames.c.map_number)
        .join(signatures, signatures.c.frame_number == frames.c.number)
        .where(frames.c.number.in_(numbers), frames.c.state == FrameState.INDEXED)
        .order_by(frames.c.number)
    ).all()
    return [_Reference(*row) for row in found]


def _repair_upload(folder: Folder, one: _Reference) -> str:
    with folder.store.database.write() as connection:
        now = _now(connection, one)
        condition = folder.store.blobs.condition(one.digest)
        if now is None or condition == "sound":
            return GONE
        moved = quarantine_blob(folder, one.digest) if condition == "damaged" else ""
        loss = reason_of_loss(condition, found=now.state == FrameState.INDEXED)
        own = now.reason if now.state == FrameState.REJECTED else None
        state = _without(now)
        connection.execute(
            update(frames)
            .where(frames.c.number == one.number)
            .values(state=state, reason=loss if own is None else f"{own}; {loss}")
        )
        if now.state in _BEING_SIGNED:
            cancel_jobs(connection, jobs.c.frame_number == one.number)
            record_event(connection, "frame.failed", one.map, one.frame_id)
        return f"{moved}the frame stays {state}" if state == now.state else f"{moved}it is {state}"


def _repair_artifact(folder: Folder, one: _Reference) -> str:
    with folder.store.database.write() as connection:
        now = _now(connection, one)
        condition = folder.store.blobs.condition(one.digest)
        if now is None or now.model_id is None or condition == "sound":
            return GONE
        moved = quarantine_blob(folder, one.digest) if condition == "damaged" else ""
        if now.on_its_way:
            return f"{moved}a job is to make it again already"
        return moved + sign_while_indexed(folder, connection, one.number, now.model_id)


# What lies where blobs are kept and nothing refers to, or is none of ours.

#: Seconds that a file which is being written is left alone at least, whatever the grace.
WRITING_S = 60.0
#: Blobs that are looked up in one transaction.
_BATCH = 64


def check_files(folder: Folder) -> Iterator[Finding]:
    """What lies where blobs are kept and nothing refers to, or is none of ours."""
    if folder.map_name is not None:
        return
    now = time.time()
    old = now - folder.grace_s
    waiting: list[BlobEntry] = []
    for done, entry in enumerate(folder.store.blobs.entries()):
        if done % 1000 == 0:
            folder.progress("files", done, done)
        folder.counts["files"] += 1
        if entry.digest is not None and entry.changed_at < old:
            waiting.append(entry)
        elif entry.unfinished and entry.changed_at < min(old, now - WRITING_S):
            yield Finding(
                "unfinished-file", entry.place, "leftover",
                "a writer was killed before it was whole", "remove it",
                path=entry.place, repair=partial(_remove_part, entry),
            )  # fmt: skip
        elif entry.digest is None and not entry.unfinished:
            yield Finding(
                "foreign-file", entry.place, "note",
                "nothing here is called so: it is left alone", path=entry.place,
            )  # fmt: skip
        if len(waiting) == _BATCH:
            yield from _unreferenced(folder, waiting)
            waiting = []
    yield from _unreferenced(folder, waiting)


def _unreferenced(folder: Folder, entries: list[BlobEntry]) -> Iterator[Finding]:
    with folder.store.database.read() as connection:
        stray = [each for each in entries if not refers_to(connection, str(each.digest))]
        known = connection.execute(select(frames.c.number).limit(1)).first() is not None
    for entry in stray:
        if not known:  # more likely another database's than nobody's
            yield Finding(
                "unreferenced-blob", entry.place, "note",
                "the database has never held a frame: is it the one of these blobs?",
                path=entry.place,
            )  # fmt: skip
            continue
        yield Finding(
            "unreferenced-blob", entry.place, "leftover",
            "no frame refers to it: its upload was killed half way, or its frame was deleted",
            "remove it",
            path=entry.place, repair=partial(_sweep, folder, str(entry.digest)),
        )  # fmt: skip


def _remove_part(entry: BlobEntry) -> str:
    Path(entry.place).unlink(missing_ok=True)  # of a folder: elsewhere nobody sees one
    return "removed"


def _sweep(folder: Folder, digest: str) -> str:
    collect_blobs(folder.store, [digest])
    if not folder.store.blobs.holds(digest):
        return "removed"
    with folder.store.database.read() as connection:
        if refers_to(connection, digest):  # its upload was only just committed
            return GONE
    raise StoreError(BUSY_BLOBS)


def changed_at(path: Path) -> float:
    """When a file was changed, seconds since 1970; never old where it is gone."""
    try:
        return path.stat().st_mtime
    except OSError:  # gone meanwhile
        return float("inf")


# Files of long jobs, such as a mesh: lost or damaged.


def check_products(folder: Folder) -> Iterator[Finding]:
    """Files of jobs, each against its hash."""
    asked = (
        select(job_files.c.job_number, job_files.c.name, job_files.c.blob, jobs.c.id, jobs.c.kind,
               maps.c.name.label("map"))
        .join(jobs, jobs.c.number == job_files.c.job_number)
        .join(maps, maps.c.number == jobs.c.map_number, isouter=True)
        .order_by(job_files.c.job_number, job_files.c.name)
    )  # fmt: skip
    if folder.map_name is not None:
        asked = asked.where(maps.c.name == folder.map_name)
    with folder.store.database.read() as connection:
        found = connection.execute(asked).all()
    for done, one in enumerate(found):
        folder.progress("files of jobs", done, len(found))
        folder.counts["blobs"] += 1
        condition = folder.store.blobs.condition(one.blob, quick=folder.quick)
        if condition == "sound":
            continue
        with folder.store.database.read() as connection:
            if not _is_there(connection, one.job_number, one.name, one.blob):
                continue
        move = "move it to the quarantine, and " if condition == "damaged" else ""
        yield Finding(
            f"{condition}-job-file", f"{one.name} of job {one.id} ({one.kind})", "damage",
            "it cannot be given out, nor gone on with", f"{move}forget it: begin the job anew",
            map=one.map, path=folder.store.blobs.place(one.blob),
            repair=partial(_repair_product, folder, one.job_number, one.name, one.blob),
        )  # fmt: skip


def _is_there(connection: Connection, job_number: int, name: str, blob: str) -> bool:
    """Whether the job still has the file: it may have been removed since."""
    own = (
        (job_files.c.job_number == job_number)
        & (job_files.c.name == name)
        & (job_files.c.blob == blob)
    )
    return connection.execute(select(job_files.c.name).where(own)).first() is not None


def _repair_product(folder: Folder, job_number: int, name: str, blob: str) -> str:
    # in one transaction: an upload of the same bytes may come, and what it put must stay
    with folder.store.database.write() as connection:
        condition = folder.store.blobs.condition(blob)
        if condition == "sound" or not _is_there(connection, job_number, name, blob):
            return GONE
        moved = quarantine_blob(folder, blob) if condition == "damaged" else ""
        remove_parts(connection, job_number, items=False, files=[name])
    return f"{moved}the job has it no more"


# Tiles of surfaces: workers make them anew from the frames.


def check_surfaces(folder: Folder) -> Iterator[Finding]:
    """Tiles of surfaces, each against its hash."""
    c = surface_tiles.c
    with folder.store.database.read() as connection:
        asked = select(c.number).join(maps, maps.c.number == c.map_number)
        if folder.map_name is not None:
            asked = asked.where(maps.c.name == folder.map_name)
        numbers = list(connection.execute(asked.order_by(c.number)).scalars())
    for done, number in enumerate(numbers):
        folder.progress("surfaces", done, len(numbers))
        with folder.store.database.read() as connection:
            tile = tile_of_number(connection, number)
        for blob in () if tile is None else (tile.blob, tile.draft):
            if tile is None or blob is None:
                continue
            folder.counts["blobs"] += 1
            condition = folder.store.blobs.condition(blob, quick=folder.quick)
            if condition == "sound":
                continue
            with folder.store.database.read() as connection:
                now = tile_of_number(connection, number)
                if now is None or blob not in (now.blob, now.draft):
                    continue
                name = map_of(connection, tile.map_number).name
            move = "move it to the quarantine, and " if condition == "damaged" else ""
            yield Finding(
                f"{condition}-tile", f"tile {tile.place} of level {tile.level} of map {name}",
                "damage", "that part of the surface cannot be shown",
                f"{move}have it made again from the frames",
                map=name, path=folder.store.blobs.place(blob),
                repair=partial(_repair_tile, folder, number, blob),
            )  # fmt: skip


def _repair_tile(folder: Folder, number: int, blob: str) -> str:
    with folder.store.database.write() as connection:
        tile = tile_of_number(connection, number)
        condition = folder.store.blobs.condition(blob)
        if tile is None or blob not in (tile.blob, tile.draft) or condition == "sound":
            return GONE
        moved = quarantine_blob(folder, blob) if condition == "damaged" else ""
        spoil_tile(connection, tile)
    return f"{moved}a worker makes it again"


# Signatures whose bytes are not those that were stored.

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
        repair=partial(_repair_signature, folder, number),
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


def _repair_signature(folder: Folder, number: int) -> str:
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
        collect_blobs(folder.store, blobs)
    return "; ".join(told) or GONE


# Pair tables that are damaged: who needs one builds it again.

_TABLE = re.compile(r"table-v\d+-[0-9a-f]{64}\.bin")


def check_tables(folder: Folder) -> Iterator[Finding]:
    """Pair tables of models, each against its checksum."""
    place = folder.settings.cache_dir
    if folder.map_name is not None or not place.is_dir():
        return
    found = sorted(place.iterdir())
    for done, path in enumerate(found):
        folder.progress("tables", done, len(found))
        part = PART.fullmatch(path.name) is not None
        if part and changed_at(path) < time.time() - max(folder.grace_s, WRITING_S):
            yield Finding(
                "unfinished-file", str(path), "leftover",
                "a writer was killed before it was whole", "remove it",
                path=path, repair=partial(_remove_cached, path),
            )  # fmt: skip
        if not _TABLE.fullmatch(path.name):
            continue
        folder.counts["tables"] += 1
        if not folder.quick and not _is_sound(path):
            yield Finding(
                "damaged-table", str(path), "damage",
                "a pair table is not the one that was written: it is built again when it is "
                "needed",
                "remove it", path=path, repair=partial(_remove_cached, path),
            )  # fmt: skip
    folder.progress("tables", len(found), len(found))


def _is_sound(path: Path) -> bool:
    try:
        return is_sound_table(path)
    except FileNotFoundError:  # removed meanwhile
        return True
    except OSError:
        return False


def _remove_cached(path: Path) -> str:
    path.unlink(missing_ok=True)
    return "removed"
