"""Repair of frames: what is damaged is signed again from its upload, and a lost upload is replaced
when the same content comes again.
"""

from __future__ import annotations

import logging
import random
import re
import time
from collections.abc import Sequence

from sqlalchemy import Connection
from sqlalchemy.exc import SQLAlchemyError

from sceneprint.engine.ingest.frame_decoder import read_stored
from sceneprint.errors import SceneprintError, UnknownFrame
from sceneprint.formats.artifact import write_geometry
from sceneprint.pipeline import Signer, prepare
from sceneprint.store import Store
from sceneprint.store.blobs.folder import Condition
from sceneprint.store.events import record_event
from sceneprint.store.frames import renew_upload
from sceneprint.store.maps import find_frame, find_map, frames_of, geometry_blobs
from sceneprint.store.queue import enqueue, latest_job
from sceneprint.store.reencoding_rows import REENCODE
from sceneprint.store.tables import FrameRow, MapRow
from sceneprint.types import Bytes
from sceneprint_client.api import FrameState

log = logging.getLogger(__name__)

#: Of jobs that heal: before what robots have just sent, which can wait a moment longer.
PRIORITY = 5
#: Seconds until a frame is signed again once more: where that does not help, a crowd of queries
#: should not keep all workers at it.
PAUSE_S = 600.0
#: Frames that one query has signed again; the next one finds the others.
MOST = 16

_LOST = re.compile(r"its upload is (lost|damaged): .* upload it again to heal")


def reason_of_loss(condition: Condition, *, found: bool) -> str:
    """Return the `reason` of a frame whose upload is missing or damaged, and which queries may
    still find.
    """
    what = "lost" if condition == "missing" else "damaged"
    but = "it can be found, but not signed again" if found else "it cannot be signed"
    return f"its upload is {what}: {but}; upload it again to heal"


def is_known_loss(reason: str | None) -> bool:
    """Whether the reason of a frame says that its upload is gone."""
    return reason is not None and _LOST.search(reason) is not None


def without_loss(reason: str | None) -> str | None:
    """A reason without what `reason_of_loss` put there."""
    return _LOST.sub("", reason or "").rstrip("; ") or None


def resign_frames(store: Store, row: MapRow, numbers: Sequence[int], model_id: str) -> int:
    """Have frames signed again whose artifact or signature is damaged; they stay found meanwhile.

    For use beside a query: what goes wrong is logged, and nothing is raised. A frame that is being
    signed again, or was a while ago, is left as it is.

    Returns
    -------
    how many jobs were queued
    """
    if not numbers or store.database.read_only:
        return 0
    try:
        with store.database.read() as connection:  # most often all is done already: no lock
            # at random: some may never be healed, and must not keep others from it
            some = random.sample(list(numbers), min(MOST, len(numbers)))
            due = _due(connection, some, model_id)
        if not due:
            return 0
        with store.database.write() as connection:
            due = _due(connection, due, model_id)
            ids = {one.number: one.id for one in frames_of(connection, due).values()}
            for number in due:
                job = enqueue(connection, REENCODE, number, PRIORITY, model_id)
                record_event(connection, "frame.damaged", row.name, ids[number], job.id)
    except (SceneprintError, SQLAlchemyError) as error:
        log.warning("repair failed", extra={"map": row.name, "error": str(error)})
        return 0
    log.warning("frames queued for signing again", extra={"map": row.name, "frames": len(due)})
    return len(due)


def rebuild_frame(store: Store, signer: Signer, frame: FrameRow) -> tuple[Bytes, bytes]:
    """What signing makes of a stored frame, for a request that meets it damaged: a worker stores
    it later, see `resign_frames`.

    Returns
    -------
    vector : of its signature
    artifact : bytes of its geometry, the same that were stored

    Raises
    ------
    DamagedBlob : its upload is lost or damaged too.
    FrameError : nothing in it can be signed.
    """
    read = read_stored(store.blobs.get(frame.blob), frame, store.decoders)
    signature, geometry = prepare(read, signer)
    return signature.vector, write_geometry(geometry)


def _due(connection: Connection, numbers: Sequence[int], model_id: str) -> list[int]:
    found = frames_of(connection, numbers)
    now, due = time.time(), []
    for number in dict.fromkeys(numbers):
        job = latest_job(connection, REENCODE, number, model_id)
        # a job of the future was made before the clock was set back
        busy = job is not None and (not job.state.over or abs(now - job.created_at) < PAUSE_S)
        if number not in found or busy or is_known_loss(found[number].reason):
            continue  # or nothing is left to sign it from
        if found[number].state == FrameState.INDEXED:
            due.append(number)
    return due


def take_upload(store: Store, map_name: str, frame_id: str, data: bytes) -> list[str]:
    """Keep an upload in the place of the one that a frame had, where that is lost or damaged.

    Parameters
    ----------
    map_name, frame_id : of a frame that has the content of the upload

    Returns
    -------
    blobs : that nothing may refer to any more; none where nothing was wrong
    """
    try:
        with store.database.read() as connection:
            row = find_map(connection, map_name)
            frame = find_frame(connection, row, frame_id)
    except UnknownFrame:  # its map was made anew meanwhile
        return []
    if store.database.read_only or frame.state == FrameState.DELETED:
        return []
    store.blobs.wait_for_removal(frame.blob)  # one that began before its commit
    if not is_known_loss(frame.reason) and store.blobs.condition(frame.blob) == "sound":
        return []
    while True:
        blob = store.blobs.put(data)
        with store.database.write() as connection:
            now = frames_of(connection, [frame.number]).get(frame.number)
            if now is None:
                return [blob, frame.blob]
            if store.blobs.holds(blob):  # a deletion may have removed it
                renew_upload(connection, now.number, blob, len(data), without_loss(now.reason))
                artifacts = geometry_blobs(connection, [now.number], row.model_id)
                break
    log.info("lost upload restored", extra={"map": row.name, "frame_id": frame_id})
    if any(store.blobs.condition(artifact) != "sound" for artifact in artifacts.values()):
        resign_frames(store, row, [now.number], row.model_id)
    return [] if blob == frame.blob else [frame.blob]
