"""Blobs that frames refer to: uploads and artifacts that are lost or damaged."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

from sqlalchemy import Connection, select, update

from sceneprint.engine.healing import is_known_loss, reason_of_loss
from sceneprint.maintenance.findings import Finding, Folder, each
from sceneprint.maintenance.repairs import GONE, quarantine_blob, sign_while_indexed
from sceneprint.schemas import FrameState, JobState
from sceneprint.store.blobs import Condition
from sceneprint.store.cancelling import cancel_of
from sceneprint.store.events import tell
from sceneprint.store.reencoding import REENCODE
from sceneprint.store.tables import frames, jobs, maps, signatures

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
            cancel_of(connection, one.number)
            tell(connection, "frame.failed", one.map, one.frame_id)
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
