"""What several repairs have in common: a frame that is signed again, bytes that are moved away."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sqlalchemy import Connection, update

from sceneprint.atomic_files import make_folder, write_durable
from sceneprint.engine.upkeep.repair import PRIORITY, reason_of_loss
from sceneprint.errors import StoreError, UnusableStore
from sceneprint.maintenance.fsck.findings import Folder
from sceneprint.settings import Settings
from sceneprint.store import Blobs, Database, FolderBlobs, open_blobs
from sceneprint.store.database import reach_database
from sceneprint.store.events import record_event
from sceneprint.store.maps import map_of, next_revision
from sceneprint.store.queue import enqueue
from sceneprint.store.reencoding_rows import REENCODE
from sceneprint.store.tables import frames
from sceneprint_client.api import FrameState

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
        record_event(connection, "frame.received", name, found.id, job.id)
        return "a worker signs it again from its upload"
    reason = reason_of_loss(condition, found=False)
    connection.execute(
        update(frames)
        .where(frames.c.number == number)
        .values(state=FrameState.FAILED, reason=reason)
    )
    record_event(connection, "frame.failed", name, found.id)
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
    make_folder(place.parent)
    write_durable(place, data)
    return place


# The blobs of a node's settings, opened for maintenance: what is missing is not made.


@contextmanager
def opened_blobs(settings: Settings, database: Database | None = None) -> Iterator[Blobs]:
    """Open them, and give their connections back.

    Parameters
    ----------
    settings : that say where they are
    database : whose they are, where it is open already

    Raises
    ------
    UnusableStore : there is no such folder, or they are another database's.
    """
    place = settings.blobs
    if isinstance(place, Path):
        require_folder(place)
        yield FolderBlobs(place, make=False)
        return
    reached = database or reach_database(settings.database)
    try:
        blobs = open_blobs(place, reached, claim=False)
        try:
            yield blobs
        finally:
            blobs.close()
    finally:
        if database is None:
            reached.close()


def require_folder(place: Path) -> None:
    """See that a folder of blobs is there: a disk that is not mounted is not made up for.

    Raises
    ------
    UnusableStore : it is not.
    """
    if not place.is_dir():
        raise UnusableStore(
            f"{place}: there is no such folder. Name the data folder with --data, see that its "
            "disk is mounted, or restore a snapshot."
        )
