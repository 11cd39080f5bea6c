"""Checks of the database: pages, foreign keys, and inconsistent, damaged or unreadable rows.

If pages or foreign keys are damaged, nothing is repaired, since a repair that relies on damaged
rows might remove sound data.
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any
from zlib import crc32

from sqlalchemy import (
    Connection,
    ForeignKeyConstraint,
    LargeBinary,
    Select,
    Text,
    and_,
    cast,
    delete,
    insert,
    select,
    text,
    update,
)

from sceneprint.engine.upkeep.repair import PRIORITY, reason_of_loss
from sceneprint.maintenance.fsck.findings import (
    GONE,
    Finding,
    Folder,
    read_rows,
)
from sceneprint.models import PRESETS, Model, read_model, write_model
from sceneprint.store.deletion import doom
from sceneprint.store.events import record_event
from sceneprint.store.maps import counted_usage, list_maps, map_usage, next_revision
from sceneprint.store.postgres.connection import allow
from sceneprint.store.queue import PENDING, enqueue
from sceneprint.store.reencoding_rows import REENCODE
from sceneprint.store.signatures import remove_signature
from sceneprint.store.tables import (
    FrameRow,
    MapRow,
    frame_row,
    frame_tags,
    frames,
    jobs,
    map_row,
    maps,
    metadata,
    models,
    signatures,
)
from sceneprint_client.api import FrameState

#: Kinds of findings that prevent all later repairs.
FATAL = frozenset({"damaged-database", "dangling-row"})
#: Maximum number of findings of one kind.
_MOST = 20
_RESTORE = (
    "restore a backup of the data folder (`sceneprint restore`); a damaged database is not repaired"
)


def check_database(folder: Folder) -> Iterator[Finding]:
    """Check the pages and indexes of SQLite, and the foreign keys of both databases.

    PostgreSQL does not enforce foreign keys while a dump is loaded without triggers. To check its
    pages, use pg_amcheck.
    """
    database = folder.store.database
    folder.progress("database", 0, 1)
    if database.is_sqlite:
        # only integrity_check compares indexes with their tables
        pragma = "quick_check" if folder.quick else "integrity_check"
        with database.read() as connection:
            lines = connection.execute(text(f"PRAGMA {pragma}({_MOST})")).scalars().all()
        yield from (damaged_database(" ".join(line.split())) for line in lines if line != "ok")
    keys = [] if folder.quick else [
        key for table in metadata.sorted_tables
        for key in sorted(table.foreign_key_constraints, key=lambda foreign: str(foreign.name))
    ]  # fmt: skip
    for done, key in enumerate(keys):
        folder.progress("database", done, len(keys))
        yield from _dangling(folder, key)


def _dangling(folder: Folder, key: ForeignKeyConstraint) -> Iterator[Finding]:
    """Yield findings for up to _MOST rows whose foreign key refers to a missing row."""
    child, parent = key.table, key.referred_table
    pairs = [(element.parent, element.column) for element in key.elements]
    lost = (
        select(*child.primary_key.columns)
        .join(parent, and_(*(own == its for own, its in pairs)), isouter=True)
        .where(*(own.is_not(None) for own, _ in pairs), *(its.is_(None) for _, its in pairs))
        .limit(_MOST)
    )
    with folder.store.database.read() as connection:
        allow(connection, 0)
        rows = connection.execute(lost).all()
    for row in rows:
        key_text = ", ".join(f"{value!r:.80}" for value in row)
        yield Finding(
            "dangling-row", f"row {key_text} of table {child.name}", "damage",
            f"it refers to a missing row of {parent.name}", _RESTORE,
        )  # fmt: skip


def damaged_database(message: str) -> Finding:
    """Return the finding for an unreadable or inconsistent database."""
    return Finding("damaged-database", "the database", "damage", message, _RESTORE)


def check_models(folder: Folder) -> Iterator[Finding]:
    """Yield findings for models whose files are damaged."""
    with folder.store.database.read() as connection:
        stored = connection.execute(select(models.c.id)).scalars().all()
    for model_id in stored:
        folder.counts["models"] += 1
        if folder.model(model_id) is not None:
            continue
        source = next((name for name in PRESETS if read_model(name).id == model_id), None)
        yield Finding(
            "damaged-model", f"model {model_id[:12]}", "damage",
            "its file is damaged: frames of its maps can be neither signed nor searched",
            "restore a backup" if source is None else f"replace it with the preset {source}",
            repair=None if source is None else partial(_put_preset, folder, model_id, source),
        )  # fmt: skip


def _put_preset(folder: Folder, model_id: str, source: str) -> str:
    own = update(models).where(models.c.id == model_id)
    with folder.store.database.write() as connection:
        replaced = connection.execute(own.values(content=write_model(read_model(source))))
    return f"the preset {source} replaces it" if replaced.rowcount else GONE


def check_counts(folder: Folder) -> Iterator[Finding]:
    """Yield findings for maps whose stored usage, used for quotas, is wrong."""
    with folder.store.database.read() as connection:
        rows = list_maps(connection)
    for row in rows:
        if folder.quick or folder.map_name not in (None, row.name):
            continue
        with folder.store.database.read() as connection:
            allow(connection, 0)
            stored = map_usage(connection, row.number)
            counted = counted_usage(connection, row.number)
        if stored != counted:
            yield Finding(
                "stale-value", f"map {row.name}", "damage",
                f"its stored usage is {stored.frames} frames with {stored.bytes} bytes, but it "
                f"holds {counted.frames} frames with {counted.bytes} bytes", "count again",
                map=row.name, repair=partial(_count_again, folder, row.number),
            )  # fmt: skip


def _count_again(folder: Folder, number: int) -> str:
    own = update(maps).where(maps.c.number == number)
    with folder.store.database.write() as connection:
        counted = counted_usage(connection, number)
        connection.execute(own.values(used_frames=counted.frames, used_bytes=counted.bytes))
    return f"counted {counted.frames} frames with {counted.bytes} bytes"


# Rows of frames, and related rows of other tables.

_BEING_SIGNED = (FrameState.RECEIVED, FrameState.SIGNING)
_GONE = (FrameState.DELETED, FrameState.REDUNDANT, FrameState.REJECTED)


@dataclass(frozen=True)
class _CheckedFrame:
    """A frame with its rows in other tables."""

    frame: FrameRow
    map: MapRow
    tags: frozenset[str]
    signed: dict[str, bool]  # whether the signature is sound, by model
    busy: bool  # whether a job will sign the frame


def check_rows(folder: Folder, numbers: list[int]) -> Iterator[Finding]:
    """Check the rows of the frames with these numbers; yield findings for damaged rows."""
    for row in read_rows(folder, numbers, partial(_read_frames, folder)):
        folder.counts["frames"] += 1
        if isinstance(row, tuple):
            number, error = row
            message = " ".join(str(error).split())
            yield Finding(
                "unreadable-row", f"frame number {number}", "damage",
                f"its row cannot be read: {type(error).__name__}: {message:.200}",
                "restore a backup; other frames are not affected",
            )  # fmt: skip
            continue
        folder.counts["signatures"] += len(row.signed)
        for kind, fault in _FAULTS.items():
            if fault.is_found(row):
                yield Finding(
                    kind, f"frame {row.frame.id} of map {row.map.name}",
                    "leftover" if kind == "stray-signature" else "damage",
                    fault.means, fault.would, map=row.map.name, frame_id=row.frame.id,
                    repair=partial(_repair_row, folder, row.frame.number, fault),
                )  # fmt: skip


def _repair_row(folder: Folder, number: int, fault: _Fault) -> str:
    with folder.store.database.write() as connection:
        for checked in _read_frames(folder, connection, [number]):  # read the row again
            if fault.is_found(checked):
                return fault.fix(folder, connection, checked)
    return GONE


def _read_frames(folder: Folder, connection: Connection, numbers: list[int]) -> list[_CheckedFrame]:
    """Read the frames with these numbers; if `folder.quick` is set, skip signature checks."""
    here = frames.c.number.in_(numbers)
    own = select(maps).where(maps.c.number.in_(select(frames.c.map_number).where(here)))
    map_rows = {row["number"]: map_row(row) for row in connection.execute(own).mappings()}
    tags, signed = defaultdict[int, set[str]](set), defaultdict[int, dict[str, bool]](dict)
    c = frame_tags.c
    for number, tag in connection.execute(
        select(c.frame_number, c.tag).where(c.frame_number.in_(numbers))
    ):
        tags[number].add(tag)
    for number, model_id, *stored in connection.execute(_signatures(folder, numbers)):
        signed[number][model_id] = folder.quick or _is_sound(folder.model(model_id), *stored)
    waiting = select(jobs.c.frame_number).where(
        jobs.c.frame_number.in_(numbers), jobs.c.kind == "sign", jobs.c.state.in_(PENDING)
    )
    busy = set(connection.execute(waiting).scalars())
    return [
        _CheckedFrame(frame_row(row), map_rows[row["map_number"]], frozenset(tags[row["number"]]),
               signed[row["number"]], row["number"] in busy)
        for row in connection.execute(select(frames).where(here)).mappings().all()
    ]  # fmt: skip


def _signatures(folder: Folder, numbers: list[int]) -> Select[Any]:
    c = signatures.c
    statement = select(c.frame_number, c.model_id).where(c.frame_number.in_(numbers))
    if folder.quick:
        return statement
    # read bytes, since damaged text columns of SQLite cannot be decoded
    raw = LargeBinary if folder.store.database.is_sqlite else Text
    counts = (cast(column, raw) for column in (c.n_patches, c.n_pairs))
    return statement.add_columns(cast(c.vector, LargeBinary), c.checksum, *counts)


def _is_sound(model: Model | None, vector: bytes, checksum: int, *counts: str | bytes) -> bool:
    """Return whether the checksum and length of a signature are correct."""
    try:
        readable = all(isinstance(json.loads(count), list) for count in counts)
        fits = model is None or len(vector) == model.signature_bytes
        return readable and fits and crc32(vector) == checksum
    except (ValueError, TypeError):
        return False


def _is_indexed(checked: _CheckedFrame) -> bool:
    return checked.frame.state == FrameState.INDEXED


def _damaged(checked: _CheckedFrame) -> set[str]:
    """Return the models of the map for which an indexed frame has a damaged signature."""
    own = (checked.map.model_id, checked.map.next_model_id) if _is_indexed(checked) else ()
    return {model_id for model_id, sound in checked.signed.items() if not sound and model_id in own}


def _stray(checked: _CheckedFrame) -> set[str]:
    """Return the models for which a frame has signatures that it should not have."""
    if checked.frame.deletion is not None:
        return set()  # keep them, since the deletion may be undone
    if checked.frame.state in _GONE:
        return set(checked.signed)
    # a signature of an unsigned frame would prevent signing
    own = {checked.map.model_id} if _is_indexed(checked) else set[str]()
    return checked.signed.keys() - own - {checked.map.next_model_id or ""}


def _place(frame: FrameRow) -> tuple[float | None, ...]:
    return (None,) * 3 if frame.pose is None else tuple(row[3] for row in frame.pose[:3])


def _is_stale(checked: _CheckedFrame) -> bool:
    """Return whether the search columns for tags and position differ from the frame."""
    frame = checked.frame
    placed = (frame.pose_x, frame.pose_y, frame.pose_z) == _place(frame)
    return not placed or (
        frame.state != FrameState.DELETED and checked.tags != frozenset(frame.tags)
    )


def _queue(_: Folder, connection: Connection, checked: _CheckedFrame) -> str:
    own = update(frames).where(frames.c.number == checked.frame.number)
    connection.execute(own.values(state=FrameState.RECEIVED, reason=None))
    return f"job {enqueue(connection, 'sign', checked.frame.number).id} is queued"


def _sign(folder: Folder, connection: Connection, checked: _CheckedFrame) -> str:
    """Schedule a frame to be signed again, or mark it as failed if its upload is lost."""
    frame, row, damaged = checked.frame, checked.map, _damaged(checked)
    _remove_signatures(connection, frame.number, damaged)
    if row.model_id in checked.signed and row.model_id not in damaged:
        for model_id in damaged:  # queries continue to use sound signatures
            enqueue(connection, REENCODE, frame.number, PRIORITY, model_id)
        return "a worker computes it again from the upload"
    condition = folder.store.blobs.condition(frame.blob)
    loss = None if condition == "sound" else reason_of_loss(condition, found=False)
    values = {
        "state": FrameState.RECEIVED if loss is None else FrameState.FAILED,
        "reason": loss,
        "indexed_at": None,
        "novelty": None,  # the frame was accepted earlier
        # a new revision makes readers and indexes drop the frame until it is signed
        "revision": next_revision(connection, row.number),
    }
    connection.execute(update(frames).where(frames.c.number == frame.number).values(**values))
    if loss is not None:
        record_event(connection, "frame.failed", row.name, frame.id)
        return f"the frame is set to failed: {loss}"
    job = enqueue(connection, "sign", frame.number, PRIORITY)
    record_event(connection, "frame.received", row.name, frame.id, job.id)
    return "a worker signs it again from its upload"


def _remove_stray(_: Folder, connection: Connection, checked: _CheckedFrame) -> str:
    _remove_signatures(connection, checked.frame.number, _stray(checked))
    return f"{len(_stray(checked))} signatures removed"


def _remove_signatures(connection: Connection, number: int, models: set[str]) -> None:
    for model_id in models:
        doom(connection, remove_signature(connection, number, model_id))


def _write_derived(_: Folder, connection: Connection, checked: _CheckedFrame) -> str:
    number, (x, y, z) = checked.frame.number, _place(checked.frame)
    own = update(frames).where(frames.c.number == number)
    connection.execute(own.values(pose_x=x, pose_y=y, pose_z=z))
    if checked.frame.state != FrameState.DELETED:
        connection.execute(delete(frame_tags).where(frame_tags.c.frame_number == number))
        named = [{"frame_number": number, "tag": tag} for tag in sorted(set(checked.frame.tags))]
        if named:
            connection.execute(insert(frame_tags), named)
    return "copied from the frame"


def _assign_revision(_: Folder, connection: Connection, checked: _CheckedFrame) -> str:
    revision = next_revision(connection, checked.map.number)
    own = update(frames).where(frames.c.number == checked.frame.number)
    connection.execute(own.values(revision=revision))
    return f"the frame is now at revision {revision}"


@dataclass(frozen=True)
class _Fault:
    """A fault in the rows of a frame; `fix` repairs it, and returns a description."""

    is_found: Callable[[_CheckedFrame], object]
    means: str
    would: str
    fix: Callable[[Folder, Connection, _CheckedFrame], str]


_FAULTS = {
    "frame-without-job": _Fault(
        lambda checked: checked.frame.state in _BEING_SIGNED and not checked.busy,
        "it waits to be signed, but has no job", "queue a job", _queue,
    ),
    "frame-without-signature": _Fault(
        lambda checked: _is_indexed(checked) and checked.map.model_id not in checked.signed,
        "it is indexed without a signature, so queries cannot find it",
        "sign it again from its upload", _sign,
    ),
    "damaged-signature": _Fault(
        _damaged, "its signature is damaged, so queries ignore it",
        "remove the signature, and sign the frame again from its upload", _sign,
    ),
    "stray-signature": _Fault(
        _stray, "it has a signature that its model or state does not allow",
        "remove that signature", _remove_stray,
    ),
    "stale-value": _Fault(
        _is_stale, "the search columns for tags and position differ from the frame's values",
        "copy them from the frame", _write_derived,
    ),
    "revision-ahead": _Fault(
        lambda checked: (checked.frame.revision or 0) > checked.map.revision,
        "its revision is greater than its map's", "assign the map's next revision",
        _assign_revision,
    ),
}  # fmt: skip
