"""What several repairs have in common: a frame that is signed again, bytes that are moved away."""

from __future__ import annotations

from pathlib import Path

from sqlalchemy import Connection, update

from sceneprint.engine.healing import PRIORITY, reason_of_loss
from sceneprint.errors import StoreError
from sceneprint.maintenance.findings import Folder
from sceneprint.schemas import FrameState
from sceneprint.store.events import tell
from sceneprint.store.maps import map_of, next_revision
from sceneprint.store.queue import enqueue
from sceneprint.store.reencoding import REENCODE
from sceneprint.store.tables import frames
from sceneprint.writing import write_durable

#: What a repair says that finds nothing to do.
GONE = "nothing: it was well again, or gone, when it was to be repaired"


def sign_from_upload(folder: Folder, connection: Connection, number: int) -> str:
    """Let a frame that has no signature be signed from its upload; failed where that is gone.

    Parameters
    ----------
    folder : see Folder
    connection : of a writing transaction
    number : of the frame
    """
    found = connection.execute(
        update(frames)
        .where(frames.c.number == number)
        # it was kept once, whatever has come since that is like it
        .values(
            state=FrameState.RECEIVED,
            reason=None,
            indexed_at=None,
            novelty=None,
        )
        .returning(frames.c.id, frames.c.map_number, frames.c.blob)
    ).one()
    # readers and indexes that hold it learn that it is found no more, until it is signed
    connection.execute(
        update(frames)
        .where(frames.c.number == number)
        .values(revision=next_revision(connection, found.map_number))
    )
    name = map_of(connection, found.map_number).name
    condition = folder.store.blobs.condition(found.blob)
    if condition == "sound":
        job = enqueue(connection, "sign", number, PRIORITY)
        tell(connection, "frame.received", name, found.id, job.id)
        return "a worker signs it again from its upload"
    reason = reason_of_loss(condition, found=False)
    connection.execute(
        update(frames)
        .where(frames.c.number == number)
        .values(state=FrameState.FAILED, reason=reason)
    )
    tell(connection, "frame.failed", name, found.id)
    return f"it is failed: {reason}"


def sign_while_indexed(folder: Folder, connection: Connection, number: int, model_id: str) -> str:
    """Let an indexed frame be signed once more, where its upload is there."""
    blob = connection.execute(
        frames.select().with_only_columns(frames.c.blob).where(frames.c.number == number)
    ).scalar_one()
    condition = folder.store.blobs.condition(blob)
    if condition != "sound":
        return f"its upload is {condition}, so it cannot be made again: upload the frame again"
    enqueue(connection, REENCODE, number, PRIORITY, model_id)
    return "a worker makes it again from the upload"


def quarantine_blob(folder: Folder, digest: str) -> str:
    """Move a damaged blob out of the way.

    Raises
    ------
    StoreError : a snapshot is being taken, which needs all blobs where they are.
    """
    with folder.store.blobs.removing() as allowed:
        if not allowed:
            raise StoreError("a snapshot is being taken; run it again when that is done")
        place = folder.store.blobs.quarantine(digest, folder.quarantine)
    return "" if place is None else f"moved to {place}; "


def quarantine_bytes(folder: Folder, name: str, data: bytes) -> Path:
    """Keep damaged bytes that are about to be removed from the database."""
    place = folder.quarantine / name
    place.parent.mkdir(parents=True, exist_ok=True)
    write_durable(place, data)
    return place
