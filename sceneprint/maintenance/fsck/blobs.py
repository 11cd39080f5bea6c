"""Blobs that rows refer to, each against its digest, and files that nothing refers to."""

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
from sceneprint.store.surface_rows import spoil_tile, tile_of_number
from sceneprint.store.tables import frames, job_files, jobs, maps, signatures, surface_tiles
from sceneprint_client.api import FrameState

_BEING_SIGNED = (FrameState.RECEIVED, FrameState.SIGNING)
_KEPT = frames.c.state.not_in((FrameState.DELETED, FrameState.REDUNDANT))


@dataclass(frozen=True)
class BlobReference:
    """A blob, and the row that refers to it.

    Parameters
    ----------
    number : of the row
    name : which blob of the row it is: an artifact's model, a file's name, a tile's place
    owner : id of the frame or job
    state, reason : of the frame, where it is one's
    on_its_way : whether a job is to make the blob again
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
        """The frame, where it is one's."""
        return None if self.state is None else self.owner

    @property
    def what(self) -> str:
        """The blob, for people."""
        if self.state is not None:
            return f"the {self.kind} of frame {self.owner} of map {self.map}"
        of = f"of map {self.map}" if self.owner is None else f"of job {self.owner}"
        return f"{self.kind} {self.name} {of}"


def _uploads() -> Select[Any]:
    c = frames.c
    return (
        select(c.number, c.blob, maps.c.name, literal(""), c.id, c.state, c.reason)
        .join(maps, maps.c.number == c.map_number)
        .where(_KEPT)
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
    x, y, z, level = (cast(one, Text) for one in (c.tile_x, c.tile_y, c.tile_z, c.level))
    return (
        select(c.number, blob, maps.c.name, x + "," + y + "," + z + " of level " + level)
        .join(maps, maps.c.number == c.map_number)
        .where(blob.is_not(None))
    )


# What a repair does about a blob that is lost or damaged, and moved away.


def _note_loss(connection: Connection, one: BlobReference, condition: Condition) -> str:
    waiting = one.state in _BEING_SIGNED
    state = FrameState.FAILED if waiting else one.state
    loss = reason_of_loss(condition, found=one.state == FrameState.INDEXED)
    if one.reason is not None and one.state == FrameState.REJECTED:
        loss = f"{one.reason}; {loss}"
    own = update(frames).where(frames.c.number == one.number)
    connection.execute(own.values(state=state, reason=loss))
    if waiting:
        cancel_jobs(connection, jobs.c.frame_number == one.number)
        record_event(connection, "frame.failed", str(one.map), one.frame_id)
    return f"the frame is {state}, and says so in its reason"


def _clear_loss(connection: Connection, one: BlobReference) -> str:
    own = update(frames).where(frames.c.number == one.number)
    if one.state != FrameState.FAILED:
        connection.execute(own.values(reason=without_loss(one.reason)))
        return "cleared"
    connection.execute(own.values(state=FrameState.RECEIVED, reason=None))
    return f"job {enqueue(connection, 'sign', one.number).id} is queued"


def _make_artifact(connection: Connection, one: BlobReference, _: Condition) -> str:
    if is_known_loss(one.reason):
        return "its upload is lost too: upload the frame again"
    if not one.on_its_way:
        enqueue(connection, REENCODE, one.number, PRIORITY, one.name)
    return "a worker makes it again from the upload"


def _forget_file(connection: Connection, one: BlobReference, _: Condition) -> str:
    remove_parts(connection, one.number, items=False, files=[one.name])
    return "the job has it no more"


def _make_tile(connection: Connection, one: BlobReference, _: Condition) -> str:
    tile = tile_of_number(connection, one.number)
    if tile is not None:
        spoil_tile(connection, tile)
    return "a worker makes it again from the frames"


@dataclass(frozen=True)
class _Kind:
    """A kind of blob: who refers to one, what its loss means, and how it is repaired."""

    table: Table
    asked: tuple[Select[Any], ...]
    means: str
    would: str
    repair: Callable[[Connection, BlobReference, Condition], str]


_KINDS = {
    "upload": _Kind(
        frames, (_uploads(),), "the frame cannot be signed again; upload it again to heal",
        "say so in the frame's reason; one that is not signed yet fails", _note_loss,
    ),
    "artifact": _Kind(
        frames, (_artifacts(),), "the frame is found, and cannot be validated",
        "have it made again from the upload", _make_artifact,
    ),
    "job-file": _Kind(
        jobs, (_job_files(),), "it cannot be given out, nor gone on with",
        "forget it: begin the job anew", _forget_file,
    ),
    "tile": _Kind(
        surface_tiles, (_tiles(surface_tiles.c.blob), _tiles(surface_tiles.c.draft)),
        "that part of the surface cannot be shown",
        "have it made again from the frames", _make_tile,
    ),
}  # fmt: skip


def _read(kind: str, connection: Connection, numbers: list[int]) -> list[BlobReference]:
    """Read the references of some rows, in their order."""
    number = _KINDS[kind].table.c.number
    return [
        BlobReference(kind, *row)
        for asked in _KINDS[kind].asked
        for row in connection.execute(asked.where(number.in_(numbers)).order_by(number))
    ]


def check_blobs(folder: Folder, kind: str, numbers: list[int]) -> Iterator[Finding]:
    """Check the blobs of a kind that some rows refer to, each against its digest."""
    blobs = folder.store.blobs
    for one in read_rows(folder, numbers, partial(_read, kind)):
        if isinstance(one, tuple):
            continue  # found when rows were looked at
        folder.counts["blobs"] += 1
        folder.counts["bytes"] += 0 if folder.quick else blobs.size(one.digest) or 0
        condition = blobs.condition(one.digest, quick=folder.quick)
        found = _is_found(one, condition) and not folder.quick
        if condition == "sound" and not found:
            continue
        with folder.store.database.read() as connection:
            if _now(connection, one) is None:  # deleted since
                continue
        finding = partial(
            Finding, what=one.what, map=one.map, frame_id=one.frame_id,
            path=blobs.place(one.digest),
        )  # fmt: skip
        means = _KINDS[kind].means
        if found:
            yield finding(
                kind="found-upload", severity="leftover",
                means="the frame's reason says that it is lost, and it is there",
                would="clear the reason, and sign a frame that had failed for that",
                repair=partial(_repair, folder, one),
            )  # fmt: skip
        elif condition == "missing" and (one.on_its_way or is_known_loss(one.reason)):
            yield finding(kind=f"missing-{kind}", severity="note", means=f"{means}; this is known")
        else:
            move = "move it to the quarantine, and " if condition == "damaged" else ""
            yield finding(
                kind=f"{condition}-{kind}", severity="damage", means=means,
                would=move + _KINDS[kind].would, repair=partial(_repair, folder, one),
            )  # fmt: skip


def _is_found(one: BlobReference, condition: Condition) -> bool:
    """Return whether an upload is there that its frame calls lost."""
    return one.kind == "upload" and condition == "sound" and is_known_loss(one.reason)


def check_products(folder: Folder) -> Iterator[Finding]:
    """Check the files of long jobs, such as a mesh, and the tiles of surfaces."""
    has_files = jobs.c.number.in_(select(job_files.c.job_number))
    for numbers in folder.numbers("files of jobs", jobs, has_files):
        yield from check_blobs(folder, "job-file", numbers)
    for numbers in folder.numbers("surfaces", surface_tiles):
        yield from check_blobs(folder, "tile", numbers)


def _now(connection: Connection, one: BlobReference) -> BlobReference | None:
    """Return the reference as it is now; None where the row refers to the blob no more."""
    found = _read(one.kind, connection, [one.number])
    return next((o for o in found if (o.digest, o.name) == (one.digest, one.name)), None)


def _repair(folder: Folder, one: BlobReference) -> str:
    # in one transaction: an upload of the same bytes may come, and what it put must stay
    with folder.store.database.write() as connection:
        now, condition = _now(connection, one), folder.store.blobs.condition(one.digest)
        if now is not None and _is_found(now, condition):
            return _clear_loss(connection, now)
        if now is None or condition == "sound":
            return GONE
        moved = quarantine_blob(folder, one.digest) if condition == "damaged" else ""
        return moved + _KINDS[one.kind].repair(connection, now, condition)


# What lies where blobs are kept and nothing refers to, or is none of ours.

#: Seconds that a file which is being written is left alone at least, whatever the grace.
WRITING_S = 60.0
#: Files that are looked up in one transaction.
_BATCH = 200


def check_files(folder: Folder) -> Iterator[Finding]:
    """Find what lies where blobs are kept and nothing refers to, or is none of ours."""
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
                "nothing here is called so: it is left alone", path=entry.place,
            )  # fmt: skip
        elif entry.changed_at < now - max(folder.grace_s, WRITING_S * entry.unfinished):
            waiting.append(entry)
        if len(waiting) == _BATCH:
            yield from _unreferenced(folder, waiting)
            waiting = []
    yield from _unreferenced(folder, waiting)


def _unreferenced(folder: Folder, entries: list[BlobEntry]) -> Iterator[Finding]:
    with folder.store.database.read() as connection:
        kept = referred_blobs(connection, [each.digest for each in entries if each.digest])
        known = connection.execute(select(frames.c.number).limit(1)).first() is not None
    for entry in entries:
        if entry.digest in kept:
            continue
        yield Finding(
            "unreferenced-file", entry.place, "leftover" if known else "note",
            "no row refers to it: its writer was killed half way, or its frame was deleted"
            if known else "the database has never held a frame: is it the one of these blobs?",
            "remove it" if known else None, path=entry.place,
            repair=partial(_remove, folder, entry) if known else None,
        )  # fmt: skip


def _remove(folder: Folder, entry: BlobEntry) -> str:
    if entry.digest is None:
        Path(entry.place).unlink(missing_ok=True)  # of a folder: elsewhere nobody sees one
        return "removed"
    collect_blobs(folder.store, [entry.digest])
    if not folder.store.blobs.holds(entry.digest):
        return "removed"
    with folder.store.database.read() as connection:
        if referred_blobs(connection, [entry.digest]):  # its upload was only just committed
            return GONE
    raise StoreError(BUSY_BLOBS)
