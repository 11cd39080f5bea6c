"""Rows that contradict each other: each is true by itself, and together they cannot be."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

from sqlalchemy import Connection, delete, insert, select, update

from sceneprint.engine.healing import is_known_loss, without_loss
from sceneprint.engine.sweeping import sweep
from sceneprint.maintenance.findings import Finding, Folder, each
from sceneprint.maintenance.repairs import GONE, sign_from_upload
from sceneprint.schemas import FrameState, JobState
from sceneprint.store.maps import list_maps
from sceneprint.store.queue import enqueue
from sceneprint.store.records import FrameRow, MapRow, frame_row
from sceneprint.store.tables import frame_tags, frames, jobs, maps, signatures

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
        for one in each(folder, numbers, _known):
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
                    repair=partial(_repair, folder, one.frame.number, fault.kind),
                )  # fmt: skip


def _repair(folder: Folder, number: int, kind: str) -> str:
    with folder.store.database.write() as connection:
        done, blobs = GONE, list[str]()
        for one in _known(connection, [number]):  # somebody may have been at it since
            for fault in _faults(folder, one):
                if fault.kind == kind:
                    done, blobs = fault.fix(folder, connection, one)
    if blobs:
        sweep(folder.store, blobs)
    return done


def _known(connection: Connection, numbers: list[int]) -> list[_Known]:
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
            _sign_anew if far else _count_on,
        )  # fmt: skip
    if is_known_loss(frame.reason) and folder.store.blobs.condition(frame.blob) == "sound":
        yield _Fault(
            "found-upload", "its reason says that its upload is lost, and it is there",
            "clear the reason, and sign it where it had failed for that",
            _clear_reason, leftover=True,
        )  # fmt: skip


def _stray(one: _Known) -> frozenset[str]:
    """Models with which a frame should not be signed."""
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


def _sign_anew(folder: Folder, connection: Connection, one: _Known) -> tuple[str, list[str]]:
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
