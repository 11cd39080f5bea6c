"""Checks of blobs: comparison with their digests, and search for unreferenced files."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from sqlalchemy import Column, Connection, Select, Table, Text, cast, literal, select, update

from sceneprint.engine.upkeep.garbage_collection import collect_blobs
from sceneprint.engine.upkeep.repair import PRIORITY, is_known_loss, reason_of_loss, without_loss
from sceneprint.errors import StoreError
from sceneprint.maintenance.fsck.findings import (
    BUSY_BLOBS,
    GONE,
    Finding,
    Folder,
    quarantine_blob,
    read_rows,
)
from sceneprint.store.blobs.folder import BlobEntry, Condition
from sceneprint.store.events import record_event
from sceneprint.store.frames import referred_blobs
from sceneprint.store.queue import PENDING, cancel_jobs, enqueue, remove_parts
from sceneprint.store.reencoding_rows import REENCODE
from sceneprint.store.surface_rows import schedule_rebuild, tile_of_number
from sceneprint.store.tables import frames, job_files, jobs, maps, signatures, surface_tiles
from sceneprint_client.api import FrameState

_BEING_SIGNED = (FrameState.RECEIVED, FrameState.SIGNING)
_HAS_UPLOAD = frames.c.state.not_in((FrameState.DELETED, FrameState.REDUNDANT))


@dataclass(frozen=True)
class BlobReference:
    """A reference of a row to a blob.

    Parameters
    ----------
    name : name of the blob within the row: model of an artifact, name of a file, position of a tile
    owner : id of the frame or job
    state, reason : state and reason of the frame; None for rows of other tables
    on_its_way : whether a queued job will compute the blob again
    """

    kind: str
    number: int
    digest: str
    map: str | None
    name: str = ""
    owner: str | None = None
    state: str | None = None
    reason: str | None = None
    on_its_way: bool = False

    @property
    def frame_id(self) -> str | None:
        """Id of the frame; None for rows of other tables."""
        return None if self.state is None else self.owner

    @property
    def what(self) -> str:
        """Description of the blob."""
        if self.state is not None:
            return f"the {self.kind} of frame {self.owner} of map {self.map}"
        owner = f"map {self.map}" if self.owner is None else f"job {self.owner}"
        return f"{self.kind} {self.name} of {owner}"


def _uploads() -> Select[Any]:
    c = frames.c
    return (
        select(c.number, c.blob, maps.c.name, literal(""), c.id, c.state, c.reason)
        .join(maps, maps.c.number == c.map_number)
        .where(_HAS_UPLOAD)
    )


def _artifacts() -> Select[Any]:
    c, signed = frames.c, signatures.c
    job = (jobs.c.frame_number == c.number) & (jobs.c.model_id == signed.model_id)
    job &= (jobs.c.kind == REENCODE) & jobs.c.state.in_(PENDING)
    return (
        select(c.number, signed.geometry, maps.c.name, signed.model_id, c.id, c.state, c.reason,
               select(jobs.c.number).where(job).exists())
        .join(maps, maps.c.number == c.map_number)
        .join(signatures, signed.frame_number == c.number)
        .where(c.state == FrameState.INDEXED)
    )  # fmt: skip


def _job_files() -> Select[Any]:
    return (
        select(jobs.c.number, job_files.c.blob, maps.c.name, job_files.c.name, jobs.c.id)
        .join(job_files, job_files.c.job_number == jobs.c.number)
        .join(maps, maps.c.number == jobs.c.map_number, isouter=True)
    )


def _tiles(blob: Column[str]) -> Select[Any]:
    c = surface_tiles.c
    x, y, z, level = (cast(column, Text) for column in (c.tile_x, c.tile_y, c.tile_z, c.level))
    return (
        select(c.number, blob, maps.c.name, x + "," + y + "," + z + " of level " + level)
        .join(maps, maps.c.number == c.map_number)
        .where(blob.is_not(None))
    )


# Repairs of references to lost blobs, and to damaged blobs after their move to quarantine.


def _note_loss(connection: Connection, reference: BlobReference, condition: Condition) -> str:
    """Record a lost upload in the frame's reason, and set an unsigned frame to failed."""
    waiting = reference.state in _BEING_SIGNED
    state = FrameState.FAILED if waiting else reference.state
    loss = reason_of_loss(condition, found=reference.state == FrameState.INDEXED)
    if reference.reason is not None and reference.state == FrameState.REJECTED:
        loss = f"{reference.reason}; {loss}"
    own = update(frames).where(frames.c.number == reference.number)
    connection.execute(own.values(state=state, reason=loss))
    if waiting:
        cancel_jobs(connection, jobs.c.frame_number == reference.number)
        record_event(connection, "frame.failed", str(reference.map), reference.frame_id)
    return f"the frame is {state}, and its reason describes the loss"


def _clear_loss(connection: Connection, reference: BlobReference) -> str:
    own = update(frames).where(frames.c.number == reference.number)
    if reference.state != FrameState.FAILED:
        connection.execute(own.values(reason=without_loss(reference.reason)))
        return "cleared"
    connection.execute(own.values(state=FrameState.RECEIVED, reason=None))
    return f"job {enqueue(connection, 'sign', reference.number).id} is queued"


def _rebuild_artifact(connection: Connection, reference: BlobReference, _: Condition) -> str:
    if is_known_loss(reference.reason):
        return "its upload is lost too: upload the frame again"
    if not reference.on_its_way:
        enqueue(connection, REENCODE, reference.number, PRIORITY, reference.name)
    return "a worker computes it again from the upload"


def _remove_job_file(connection: Connection, reference: BlobReference, _: Condition) -> str:
    remove_parts(connection, reference.number, items=False, files=[reference.name])
    return "the file is removed from the job"


def _rebuild_tile(connection: Connection, reference: BlobReference, _: Condition) -> str:
    tile = tile_of_number(connection, reference.number)
    if tile is not None:
        schedule_rebuild(connection, tile)
    return "a worker computes it again from the frames"


@dataclass(frozen=True)
class _Kind:
    """A kind of blob: references, consequence of a loss, and repair."""

    table: Table
    references: tuple[Select[Any], ...]
    means: str
    would: str
    repair: Callable[[Connection, BlobReference, Condition], str]


_KINDS = {
    "upload": _Kind(
        frames, (_uploads(),), "the frame cannot be signed again; upload it again to repair it",
        "record the loss in the frame's reason, and set an unsigned frame to failed", _note_loss,
    ),
    "artifact": _Kind(
        frames, (_artifacts(),), "queries find the frame, but cannot validate it",
        "compute it again from the upload", _rebuild_artifact,
    ),
    "job-file": _Kind(
        jobs, (_job_files(),), "it cannot be downloaded, and the job cannot continue",
        "remove it from the job; then start the job again", _remove_job_file,
    ),
    "tile": _Kind(
        surface_tiles, (_tiles(surface_tiles.c.blob), _tiles(surface_tiles.c.draft)),
        "that part of the surface cannot be shown",
        "compute it again from the frames", _rebuild_tile,
    ),
}  # fmt: skip


def _read(kind: str, connection: Connection, numbers: list[int]) -> list[BlobReference]:
    """Read the blob references of the rows with these numbers, in ascending order."""
    number = _KINDS[kind].table.c.number
    return [
        BlobReference(kind, *row)
        for statement in _KINDS[kind].references
        for row in connection.execute(statement.where(number.in_(numbers)).order_by(number))
    ]


def check_blobs(folder: Folder, kind: str, numbers: list[int]) -> Iterator[Finding]:
    """Compare the blobs of some rows with their digests, count them, and yield findings.

    If `folder.quick` is set, only check that the blobs exist. Skip unreadable rows.

    Parameters
    ----------
    kind : `upload`, `artifact`, `job-file` or `tile`
    """
    blobs = folder.store.blobs
    for row in read_rows(folder, numbers, partial(_read, kind)):
        if isinstance(row, tuple):
            continue  # `check_rows` reports it
        folder.counts["blobs"] += 1
        folder.counts["bytes"] += 0 if folder.quick else blobs.size(row.digest) or 0
        condition = blobs.condition(row.digest, quick=folder.quick)
        recovered = _is_recovered(row, condition) and not folder.quick
        if condition == "sound" and not recovered:
            continue
        with folder.store.database.read() as connection:
            if _current_reference(connection, row) is None:  # the row was deleted
                continue
        finding = partial(
            Finding, what=row.what, map=row.map, frame_id=row.frame_id,
            path=blobs.place(row.digest),
        )  # fmt: skip
        means = _KINDS[kind].means
        if recovered:
            yield finding(
                kind="found-upload", severity="leftover",
                means="the frame's reason says that the upload is lost, but it exists",
                would="clear the reason, and sign the frame if it failed for that reason",
                repair=partial(_repair, folder, row),
            )  # fmt: skip
        elif condition == "missing" and (row.on_its_way or is_known_loss(row.reason)):
            yield finding(
                kind=f"missing-{kind}", severity="note", means=f"{means}; the loss is recorded"
            )
        else:
            move = "move the file to the quarantine, and " if condition == "damaged" else ""
            yield finding(
                kind=f"{condition}-{kind}", severity="damage", means=means,
                would=move + _KINDS[kind].would, repair=partial(_repair, folder, row),
            )  # fmt: skip


def _is_recovered(reference: BlobReference, condition: Condition) -> bool:
    """Return whether an upload is sound, but its frame's reason still reports it as lost."""
    return reference.kind == "upload" and condition == "sound" and is_known_loss(reference.reason)


def check_products(folder: Folder) -> Iterator[Finding]:
    """Check the files of long jobs, such as meshes, and the tiles of surfaces."""
    has_files = jobs.c.number.in_(select(job_files.c.job_number))
    for numbers in folder.numbers("files of jobs", jobs, has_files):
        yield from check_blobs(folder, "job-file", numbers)
    for numbers in folder.numbers("surfaces", surface_tiles):
        yield from check_blobs(folder, "tile", numbers)


def _current_reference(connection: Connection, reference: BlobReference) -> BlobReference | None:
    """Read a reference again; return None if the row no longer refers to the blob."""
    references = _read(reference.kind, connection, [reference.number])
    return next(
        (o for o in references if (o.digest, o.name) == (reference.digest, reference.name)), None
    )


def _repair(folder: Folder, reference: BlobReference) -> str:
    # one transaction, so that the repair does not remove a new upload of the same bytes
    with folder.store.database.write() as connection:
        now, condition = (
            _current_reference(connection, reference),
            folder.store.blobs.condition(reference.digest),
        )
        if now is not None and _is_recovered(now, condition):
            return _clear_loss(connection, now)
        if now is None or condition == "sound":
            return GONE
        moved = quarantine_blob(folder, reference.digest) if condition == "damaged" else ""
        return moved + _KINDS[reference.kind].repair(connection, now, condition)


#: Minimum age of unfinished files that are reported, seconds.
WRITING_S = 60.0
#: Number of files to look up in one transaction.
_BATCH = 200


def check_files(folder: Folder) -> Iterator[Finding]:
    """Yield findings for unreferenced and foreign files, unless only one map is checked."""
    if folder.map_name is not None:
        return
    now, waiting = time.time(), list[BlobEntry]()
    for done, entry in enumerate(folder.store.blobs.entries()):
        if done % 1000 == 0:
            folder.progress("files", done, done)
        folder.counts["files"] += 1
        if entry.digest is None and not entry.unfinished:
            yield Finding(
                "foreign-file", entry.place, "note",
                "it does not belong to the store, which ignores it", path=entry.place,
            )  # fmt: skip
        elif entry.changed_at < now - max(folder.grace_s, WRITING_S * entry.unfinished):
            waiting.append(entry)
        if len(waiting) == _BATCH:
            yield from _unreferenced(folder, waiting)
            waiting = []
    yield from _unreferenced(folder, waiting)


def _unreferenced(folder: Folder, entries: list[BlobEntry]) -> Iterator[Finding]:
    with folder.store.database.read() as connection:
        referred = referred_blobs(connection, [each.digest for each in entries if each.digest])
        in_use = connection.execute(select(frames.c.number).limit(1)).first() is not None
    for entry in entries:
        if entry.digest in referred:
            continue
        yield Finding(
            "unreferenced-file", entry.place, "leftover" if in_use else "note",
            "no row refers to it: its writer was killed, or its frame was deleted" if in_use
            else "the database has no frames: check that it belongs to this blob store",
            "remove it" if in_use else None, path=entry.place,
            repair=partial(_remove, folder, entry) if in_use else None,
        )  # fmt: skip


def _remove(folder: Folder, entry: BlobEntry) -> str:
    if entry.digest is None:
        Path(entry.place).unlink(missing_ok=True)
        return "removed"
    collect_blobs(folder.store, [entry.digest])
    if not folder.store.blobs.holds(entry.digest):
        return "removed"
    with folder.store.database.read() as connection:
        if referred_blobs(connection, [entry.digest]):  # by a new upload
            return GONE
    raise StoreError(BUSY_BLOBS)
