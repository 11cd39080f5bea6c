"""Blobs that rows refer to, each against its digest, and files that nothing refers to."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from sqlalchemy import Connection, select, update

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
    digest, name : of the blob, and which one of the row it is
    what : the row, for people
    state, reason : of the frame, where it is one's
    on_its_way : whether a job is to make the blob again
    """

    kind: str
    number: int
    digest: str
    name: str
    what: str
    map: str | None
    frame_id: str | None = None
    state: str | None = None
    reason: str | None = None
    on_its_way: bool = False


def _uploads(connection: Connection, numbers: list[int]) -> list[BlobReference]:
    c = frames.c
    found = connection.execute(
        select(c.number, c.blob, maps.c.name, c.id, c.state, c.reason)
        .join(maps, maps.c.number == c.map_number)
        .where(c.number.in_(numbers), _KEPT)
        .order_by(c.number)
    )
    return [
        BlobReference("upload", number, blob, "", f"the upload of frame {own} of map {name}",
                      name, own, state, reason)
        for number, blob, name, own, state, reason in found
    ]  # fmt: skip


def _artifacts(connection: Connection, numbers: list[int]) -> list[BlobReference]:
    c, signed = frames.c, signatures.c
    job = jobs.c.frame_number == c.number
    job &= (jobs.c.kind == REENCODE) & (jobs.c.model_id == signed.model_id)
    on_its_way = select(jobs.c.number).where(job, jobs.c.state.in_(PENDING)).exists()
    found = connection.execute(
        select(c.number, signed.geometry, signed.model_id, maps.c.name, c.id, c.state, c.reason,
               on_its_way)
        .join(maps, maps.c.number == c.map_number)
        .join(signatures, signed.frame_number == c.number)
        .where(c.number.in_(numbers), c.state == FrameState.INDEXED)
        .order_by(c.number)
    )  # fmt: skip
    return [
        BlobReference("artifact", number, blob, model_id,
                      f"the artifact of frame {own} of map {name}", name, own, *rest)
        for number, blob, model_id, name, own, *rest in found
    ]  # fmt: skip


def _job_files(connection: Connection, numbers: list[int]) -> list[BlobReference]:
    c = job_files.c
    found = connection.execute(
        select(c.job_number, c.blob, c.name, jobs.c.id, jobs.c.kind, maps.c.name)
        .join(jobs, jobs.c.number == c.job_number)
        .join(maps, maps.c.number == jobs.c.map_number, isouter=True)
        .where(c.job_number.in_(numbers))
        .order_by(c.job_number, c.name)
    )
    return [
        BlobReference("job-file", number, blob, own, f"{own} of job {job} ({kind})", name)
        for number, blob, own, job, kind, name in found
    ]


def _tiles(connection: Connection, numbers: list[int]) -> list[BlobReference]:
    c = surface_tiles.c
    found = connection.execute(
        select(c.number, c.blob, c.draft, maps.c.name, c.level, c.tile_x, c.tile_y, c.tile_z)
        .join(maps, maps.c.number == c.map_number)
        .where(c.number.in_(numbers))
        .order_by(c.number)
    )
    return [
        BlobReference("tile", number, digest, "", f"tile {tuple(place)} of level {level} of map "
                      f"{name}", name)
        for number, blob, draft, name, level, *place in found
        for digest in (blob, draft) if digest is not None
    ]  # fmt: skip


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

    read: Callable[[Connection, list[int]], list[BlobReference]]
    means: str
    would: str
    repair: Callable[[Connection, BlobReference, Condition], str]


_KINDS = {
    "upload": _Kind(
        _uploads, "the frame cannot be signed again; upload it again to heal",
        "say so in the frame's reason; one that is not signed yet fails", _note_loss,
    ),
    "artifact": _Kind(
        _artifacts, "the frame is found, and cannot be validated",
        "have it made again from the upload", _make_artifact,
    ),
    "job-file": _Kind(
        _job_files, "it cannot be given out, nor gone on with",
        "forget it: begin the job anew", _forget_file,
    ),
    "tile": _Kind(
        _tiles, "that part of the surface cannot be shown",
        "have it made again from the frames", _make_tile,
    ),
}  # fmt: skip


def check_blobs(folder: Folder, kind: str, numbers: list[int]) -> Iterator[Finding]:
    """Check the blobs of a kind that some rows refer to, each against its digest."""
    blobs = folder.store.blobs
    for one in read_rows(folder, numbers, _KINDS[kind].read):
        if isinstance(one, tuple):
            continue  # found when rows were looked at
        folder.counts["blobs"] += 1
        folder.counts["bytes"] += 0 if folder.quick else blobs.size(one.digest) or 0
        condition = blobs.condition(one.digest, quick=folder.quick)
        known = is_known_loss(one.reason)
        found = condition == "sound" and known and kind == "upload" and not folder.quick
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
                repair=partial(_clear_loss, folder, one),
            )  # fmt: skip
        elif condition == "missing" and (known or one.on_its_way):
            yield finding(kind=f"missing-{kind}", severity="note", means=f"{means}; this is known")
        else:
            move = "move it to the quarantine, and " if condition == "damaged" else ""
            yield finding(
                kind=f"{condition}-{kind}", severity="damage", means=means,
                would=move + _KINDS[kind].would, repair=partial(_repair, folder, one),
            )  # fmt: skip


def check_products(folder: Folder) -> Iterator[Finding]:
    """Check the files of long jobs, such as a mesh, and the tiles of surfaces."""
    has_files = jobs.c.number.in_(select(job_files.c.job_number))
    for numbers in folder.numbers("files of jobs", jobs, has_files):
        yield from check_blobs(folder, "job-file", numbers)
    for numbers in folder.numbers("surfaces", surface_tiles):
        yield from check_blobs(folder, "tile", numbers)


def _now(connection: Connection, one: BlobReference) -> BlobReference | None:
    """Return the reference as it is now; None where the row refers to the blob no more."""
    found = _KINDS[one.kind].read(connection, [one.number])
    return next((o for o in found if (o.digest, o.name) == (one.digest, one.name)), None)


def _repair(folder: Folder, one: BlobReference) -> str:
    # in one transaction: an upload of the same bytes may come, and what it put must stay
    with folder.store.database.write() as connection:
        now, condition = _now(connection, one), folder.store.blobs.condition(one.digest)
        if now is None or condition == "sound":
            return GONE
        moved = quarantine_blob(folder, one.digest) if condition == "damaged" else ""
        return moved + _KINDS[one.kind].repair(connection, now, condition)


def _clear_loss(folder: Folder, one: BlobReference) -> str:
    with folder.store.database.write() as connection:
        now, condition = _now(connection, one), folder.store.blobs.condition(one.digest)
        if now is None or condition != "sound" or not is_known_loss(now.reason):
            return GONE
        own = update(frames).where(frames.c.number == one.number)
        if now.state != FrameState.FAILED:
            connection.execute(own.values(reason=without_loss(now.reason)))
            return "cleared"
        connection.execute(own.values(state=FrameState.RECEIVED, reason=None))
        return f"job {enqueue(connection, 'sign', one.number).id} is queued"


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
        if not known:  # more likely another database's than nobody's
            yield Finding(
                "unreferenced-file", entry.place, "note",
                "the database has never held a frame: is it the one of these blobs?",
                path=entry.place,
            )  # fmt: skip
            continue
        yield Finding(
            "unreferenced-file", entry.place, "leftover",
            "no row refers to it: its writer was killed half way, or its frame was deleted",
            "remove it", path=entry.place, repair=partial(_remove, folder, entry),
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
