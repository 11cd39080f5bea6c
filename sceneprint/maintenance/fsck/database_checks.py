"""Rows that contradict each other: each is true by itself, and together they cannot be."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

from sqlalchemy import Connection, ForeignKeyConstraint, and_, delete, insert, select, text, update

from sceneprint.engine.upkeep.garbage_collection import collect_blobs
from sceneprint.engine.upkeep.repair import is_known_loss, without_loss
from sceneprint.errors import UnreadableModel, UnusableStore
from sceneprint.maintenance.fsck.findings import (
    GONE,
    Finding,
    Folder,
    each,
    is_of_rows,
    sign_from_upload,
)
from sceneprint.models import PRESETS, parse_model, read_model, write_model
from sceneprint.store.maps import counted_usage, list_maps, use_of
from sceneprint.store.postgres.connection import allow
from sceneprint.store.queue import enqueue
from sceneprint.store.tables import (
    FrameRow,
    MapRow,
    frame_row,
    frame_tags,
    frames,
    jobs,
    maps,
    metadata,
    models,
    signatures,
)
from sceneprint_client.api import FrameState, JobState

_BEING_SIGNED = (FrameState.RECEIVED, FrameState.SIGNING)
#: More changes than any map has had.
_MOST_REVISIONS = 1 << 48
_GONE = (FrameState.DELETED, FrameState.REDUNDANT, FrameState.REJECTED)


@dataclass(frozen=True)
class _Known:
    """A frame, and what other tables say of it."""

    frame: FrameRow
    map: MapRow
    tags: frozenset[str]
    signed: frozenset[str]  # models that it is signed with
    busy: bool  # whether a job is to sign it


@dataclass(frozen=True)
class _Fault:
    """What is wrong with a frame; `fix` does what `would` says, and names blobs to be swept."""

    kind: str
    means: str
    would: str
    fix: Callable[[Folder, Connection, _Known], tuple[str, list[str]]]
    leftover: bool = False


def check_rows(folder: Folder) -> Iterator[Finding]:
    """Frames whose rows contradict each other, or cannot be read."""
    for numbers in folder.numbers("rows"):
        for one in each(folder, numbers, _frames_at_once):
            folder.counts["frames"] += 1
            if isinstance(one, tuple):
                number, error = one
                message = " ".join(str(error).split())
                yield Finding(
                    "unreadable-row", f"frame number {number}", "damage",
                    f"its row cannot be read: {type(error).__name__}: {message:.200}",
                    "restore a snapshot; the frames around it are not affected",
                )  # fmt: skip
                continue
            for fault in _faults(folder, one):
                yield Finding(
                    fault.kind, f"frame {one.frame.id} of map {one.map.name}",
                    "leftover" if fault.leftover else "damage", fault.means, fault.would,
                    map=one.map.name, frame_id=one.frame.id,
                    repair=partial(_repair_row, folder, one.frame.number, fault.kind),
                )  # fmt: skip


def _repair_row(folder: Folder, number: int, kind: str) -> str:
    with folder.store.database.write() as connection:
        done, blobs = GONE, list[str]()
        for one in _frames_at_once(connection, [number]):  # somebody may have been at it since
            for fault in _faults(folder, one):
                if fault.kind == kind:
                    done, blobs = fault.fix(folder, connection, one)
    if blobs:
        collect_blobs(folder.store, blobs)
    return done


def _frames_at_once(connection: Connection, numbers: list[int]) -> list[_Known]:
    """All that is looked at of some frames, as one transaction sees it."""
    known = {row.number: row for row in list_maps(connection)}
    found = connection.execute(select(frames).where(frames.c.number.in_(numbers))).mappings().all()
    tags: dict[int, set[str]] = {}
    for number, tag in connection.execute(
        select(frame_tags.c.frame_number, frame_tags.c.tag).where(
            frame_tags.c.frame_number.in_(numbers)
        )
    ):
        tags.setdefault(number, set()).add(tag)
    signed: dict[int, set[str]] = {}
    for number, model_id in connection.execute(
        select(signatures.c.frame_number, signatures.c.model_id).where(
            signatures.c.frame_number.in_(numbers)
        )
    ):
        signed.setdefault(number, set()).add(model_id)
    busy = connection.execute(
        select(jobs.c.frame_number).where(
            jobs.c.frame_number.in_(numbers),
            jobs.c.kind == "sign",
            jobs.c.state.in_((JobState.QUEUED, JobState.RUNNING)),
        )
    )
    at_work = set(busy.scalars())
    return [
        _Known(
            frame_row(row), known[row["map_number"]], frozenset(tags.get(row["number"], ())),
            frozenset(signed.get(row["number"], ())), row["number"] in at_work,
        )
        for row in found
    ]  # fmt: skip


def _faults(folder: Folder, one: _Known) -> Iterator[_Fault]:
    frame, row = one.frame, one.map
    if frame.state in _BEING_SIGNED and not one.busy:
        yield _Fault(
            "frame-without-job", f"it is {frame.state}, and no job is to sign it",
            "queue a job for it", _queue,
        )  # fmt: skip
    if frame.state == FrameState.INDEXED and row.model_id not in one.signed:
        yield _Fault(
            "frame-without-signature", "it is indexed, and has no signature: it is not found",
            "have it signed again from its upload", _sign,
        )  # fmt: skip
    if _stray(one):
        yield _Fault(
            "stray-signature", "it has a signature of a model, or in a state, that is not its own",
            "remove that signature", _remove_stray, leftover=True,
        )  # fmt: skip
    if frame.state != FrameState.DELETED and one.tags != frozenset(frame.tags):
        yield _Fault(
            "other-tags", "the tags that are searched are not those of the frame",
            "write them anew from the frame", _write_tags,
        )  # fmt: skip
    if (frame.pose_x, frame.pose_y, frame.pose_z) != _place(frame):
        yield _Fault(
            "other-position", "the position that is searched is not that of its pose",
            "write it anew from the pose", _write_place,
        )  # fmt: skip
    if frame.revision is not None and frame.revision > row.revision:
        far = frame.revision > _MOST_REVISIONS  # no map has changed so often
        yield _Fault(
            "revision-ahead", f"its revision {frame.revision} is beyond its map's {row.revision}",
            "sign it again" if far else "count the map's revisions from there",
            _queue_signature if far else _count_on,
        )  # fmt: skip
    if is_known_loss(frame.reason) and folder.store.blobs.condition(frame.blob) == "sound":
        yield _Fault(
            "found-upload", "its reason says that its upload is lost, and it is there",
            "clear the reason, and sign it where it had failed for that",
            _clear_reason, leftover=True,
        )  # fmt: skip


def _stray(one: _Known) -> frozenset[str]:
    """Return the models that a frame should have no signature of."""
    if one.frame.deletion is not None:
        return frozenset()  # it may be restored
    if one.frame.state in _GONE:
        return one.signed
    # another's signature would keep the frame from being signed
    own = {one.map.model_id} if one.frame.state == FrameState.INDEXED else set[str]()
    return one.signed - own - {one.map.next_model_id or ""}


def _place(frame: FrameRow) -> tuple[float | None, ...]:
    return (None,) * 3 if frame.pose is None else tuple(row[3] for row in frame.pose[:3])


def _queue(_: Folder, connection: Connection, one: _Known) -> tuple[str, list[str]]:
    connection.execute(
        update(frames)
        .where(frames.c.number == one.frame.number)
        .values(state=FrameState.RECEIVED, reason=None)
    )
    job = enqueue(connection, "sign", one.frame.number)
    return f"job {job.id} is queued", []


def _sign(folder: Folder, connection: Connection, one: _Known) -> tuple[str, list[str]]:
    return sign_from_upload(folder, connection, one.frame.number), []


def _queue_signature(folder: Folder, connection: Connection, one: _Known) -> tuple[str, list[str]]:
    removed = connection.execute(
        delete(signatures)
        .where(signatures.c.frame_number == one.frame.number)
        .returning(signatures.c.geometry)
    )
    blobs = list(removed.scalars())
    return sign_from_upload(folder, connection, one.frame.number), blobs


def _remove_stray(_: Folder, connection: Connection, one: _Known) -> tuple[str, list[str]]:
    removed = connection.execute(
        delete(signatures)
        .where(
            signatures.c.frame_number == one.frame.number,
            signatures.c.model_id.in_(_stray(one)),
        )
        .returning(signatures.c.geometry)
    )
    blobs = list(removed.scalars())
    return f"{len(blobs)} removed", blobs


def _write_tags(_: Folder, connection: Connection, one: _Known) -> tuple[str, list[str]]:
    number = one.frame.number
    connection.execute(delete(frame_tags).where(frame_tags.c.frame_number == number))
    named = [{"frame_number": number, "tag": tag} for tag in sorted(set(one.frame.tags))]
    if named:
        connection.execute(insert(frame_tags), named)
    return f"{len(named)} written", []


def _write_place(_: Folder, connection: Connection, one: _Known) -> tuple[str, list[str]]:
    x, y, z = _place(one.frame)
    connection.execute(
        update(frames)
        .where(frames.c.number == one.frame.number)
        .values(pose_x=x, pose_y=y, pose_z=z)
    )
    return "written", []


def _count_on(_: Folder, connection: Connection, one: _Known) -> tuple[str, list[str]]:
    connection.execute(
        update(maps).where(maps.c.number == one.map.number).values(revision=one.frame.revision)
    )
    return f"the map is at revision {one.frame.revision}", []


def _clear_reason(folder: Folder, connection: Connection, one: _Known) -> tuple[str, list[str]]:
    if one.frame.state == FrameState.FAILED:  # for want of its upload alone
        return _queue(folder, connection, one)
    connection.execute(
        update(frames)
        .where(frames.c.number == one.frame.number)
        .values(reason=without_loss(one.frame.reason))
    )
    return "cleared", []


# What maps are counted to hold, against what they hold: a quota is asked of the former.


def check_counts(folder: Folder) -> Iterator[Finding]:
    """Maps that are counted to hold more or less than they do."""
    with folder.store.database.read() as connection:
        found = list_maps(connection)
    for row in found:
        if folder.quick or folder.map_name not in (None, row.name):
            continue
        with folder.store.database.read() as connection:
            allow(connection, 0)
            told, there = use_of(connection, row.number), counted_usage(connection, row.number)
        if told != there:
            yield Finding(
                "other-use", f"map {row.name}", "damage",
                f"it is counted to hold {told.frames} frames of {told.bytes} bytes, and holds "
                f"{there.frames} of {there.bytes}: its quota is asked of the former",
                "count anew", map=row.name, repair=partial(_repair_count, folder, row.number),
            )  # fmt: skip


def _repair_count(folder: Folder, number: int) -> str:
    with folder.store.database.write() as connection:
        there = counted_usage(connection, number)
        if use_of(connection, number) == there:
            return GONE
        connection.execute(
            update(maps)
            .where(maps.c.number == number)
            .values(used_frames=there.frames, used_bytes=there.bytes)
        )
    return f"{there.frames} frames of {there.bytes} bytes are counted"


# What refers to what on PostgreSQL: its foreign keys are enforced, but not while a dump is loaded
# without triggers. Pages are the concern of its own pg_amcheck.


def check_server(folder: Folder, restore: str) -> Iterator[Finding]:
    """Rows that refer to none.

    Parameters
    ----------
    restore : what to do about it
    """
    if folder.quick:
        return
    keys = [
        key for table in metadata.sorted_tables
        for key in sorted(table.foreign_key_constraints, key=lambda one: str(one.name))
    ]  # fmt: skip
    for done, key in enumerate(keys):
        folder.progress("database", done, len(keys))
        yield from _dangling(folder, key, restore)
    folder.progress("database", len(keys), len(keys))


def _dangling(folder: Folder, key: ForeignKeyConstraint, restore: str) -> Iterator[Finding]:
    child, parent = key.table, key.referred_table
    pairs = [(one.parent, one.column) for one in key.elements]
    lost = (
        select(*child.primary_key.columns)
        .join(parent, and_(*(own == its for own, its in pairs)), isouter=True)
        .where(*(own.is_not(None) for own, _ in pairs), *(its.is_(None) for _, its in pairs))
        .limit(_MOST)
    )
    with folder.store.database.read() as connection:
        allow(connection, 0)
        found = connection.execute(lost).all()
    for row in found:
        named = ", ".join(f"{value!r:.80}" for value in row)
        yield Finding(
            "dangling-row", f"row {named} of table {child.name}", "damage",
            f"it refers to a row of {parent.name} that is not there", restore,
        )  # fmt: skip


# The database as a whole: its pages, what refers to what, and the models in it.
#
# Where these are damaged nothing is repaired: what the rows say cannot be relied upon, and a repair
# by them might remove what is sound.

#: Kinds of findings after which nothing is repaired.
FATAL = frozenset({"damaged-database", "dangling-row"})
#: Findings of one kind that are named.
_MOST = 20
_RESTORE = (
    "restore a snapshot of the data folder (`sceneprint restore`); nothing is repaired in a "
    "damaged database"
)


def check_database(folder: Folder) -> Iterator[Finding]:
    """What the database says of its own file, and rows that refer to none."""
    database = folder.store.database
    if not database.is_sqlite:
        yield from check_server(folder, _RESTORE)
        return
    subject = "database"
    folder.progress(subject, 0, 2)
    # it alone reads all indexes: where one differs from its table, rows are not to be relied upon
    pragma = "quick_check" if folder.quick else "integrity_check"
    try:
        with database.read() as connection:
            told = connection.execute(text(f"PRAGMA {pragma}({_MOST})")).scalars().all()
            folder.progress(subject, 1, 2)
            dangling = connection.execute(text("PRAGMA foreign_key_check")).all()
    except UnusableStore as error:
        if not is_of_rows(error):
            raise
        yield damaged_database(str(error.__cause__ and getattr(error.__cause__, "orig", error)))
        return
    folder.progress(subject, 2, 2)
    for line in told:
        if line != "ok":
            yield damaged_database(" ".join(line.split()))
    for table, row, parent, _ in dangling[:_MOST]:
        yield Finding(
            "dangling-row", f"row {row} of table {table}", "damage",
            f"it refers to a row of {parent} that is not there", _RESTORE,
        )  # fmt: skip


def damaged_database(message: str) -> Finding:
    """The finding that the database cannot read all of its files, or finds them contradict."""
    return Finding("damaged-database", "the database", "damage", message, _RESTORE)


def check_models(folder: Folder) -> Iterator[Finding]:
    """Models whose file is damaged: nothing can be signed or searched with them."""
    with folder.store.database.read() as connection:
        stored = connection.execute(select(models.c.id, models.c.content)).all()
    for done, (model_id, content) in enumerate(stored):
        folder.progress("models", done, len(stored))
        folder.counts["models"] += 1
        if _is_sound(model_id, bytes(content)):
            continue
        source = next((name for name in PRESETS if read_model(name).id == model_id), None)
        yield Finding(
            "damaged-model", f"model {model_id[:12]}", "damage",
            "its file is not the one that was stored: its maps can be neither signed nor searched",
            "restore a snapshot" if source is None else f"put the preset {source} in its place",
            repair=None if source is None else partial(_put_preset, folder, model_id, source),
        )  # fmt: skip
    folder.progress("models", len(stored), len(stored))


def _is_sound(model_id: str, content: bytes) -> bool:
    try:
        return parse_model(content, model_id).id == model_id
    except UnreadableModel:
        return False


def _put_preset(folder: Folder, model_id: str, source: str) -> str:
    content = write_model(read_model(source))
    with folder.store.database.write() as connection:
        found = connection.execute(
            update(models).where(models.c.id == model_id).values(content=content)
        )
    return f"the preset {source} is in its place" if found.rowcount else GONE
