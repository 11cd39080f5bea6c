"""Repair of frames: signatures rebuilt from uploads, and lost uploads replaced."""

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

#: Priority of repair jobs, above that of new uploads.
PRIORITY = 5
#: Minimum seconds between repairs of a frame, since a repair may fail each time.
PAUSE_S = 600.0
#: Maximum number of frames that one query schedules for repair.
MOST = 16

_LOST = re.compile(r"its upload is (lost|damaged): .* upload it again to heal")


def reason_of_loss(condition: Condition, *, found: bool) -> str:
    """Return the text for `reason` of a frame whose upload is lost or damaged.

    Parameters
    ----------
    found : whether the frame is indexed
    """
    what = "lost" if condition == "missing" else "damaged"
    but = "it can be found, but not signed again" if found else "it cannot be signed"
    return f"its upload is {what}: {but}; upload it again to heal"


def is_known_loss(reason: str | None) -> bool:
    """Return whether the reason of a frame contains a text of `reason_of_loss`."""
    return reason is not None and _LOST.search(reason) is not None


def without_loss(reason: str | None) -> str | None:
    """Remove the text of `reason_of_loss` from a reason; return None if nothing remains."""
    return _LOST.sub("", reason or "").rstrip("; ") or None


def resign_frames(store: Store, row: MapRow, numbers: Sequence[int], model_id: str) -> int:
    """Queue jobs that sign damaged frames again; skip frames with a pending or recent job.

    Until then, queries can still find the frames. Errors are logged instead of raised.

    Returns
    -------
    queued : number of queued jobs
    """
    if not numbers or store.database.read_only:
        return 0
    try:
        with store.database.read() as connection:  # usually none is due: avoid a write lock
            # sample randomly, so that irreparable frames do not prevent other repairs
            sample = random.sample(list(numbers), min(MOST, len(numbers)))
            due = _repairable(connection, sample, model_id)
        if not due:
            return 0
        with store.database.write() as connection:
            due = _repairable(connection, due, model_id)
            ids = {frame.number: frame.id for frame in frames_of(connection, due).values()}
            for number in due:
                job = enqueue(connection, REENCODE, number, PRIORITY, model_id)
                record_event(connection, "frame.damaged", row.name, ids[number], job.id)
    except (SceneprintError, SQLAlchemyError) as error:
        log.warning("repair failed", extra={"map": row.name, "error": str(error)})
        return 0
    log.warning("frames queued for signing again", extra={"map": row.name, "frames": len(due)})
    return len(due)


def rebuild_frame(store: Store, signer: Signer, frame: FrameRow) -> tuple[Bytes, bytes]:
    """Sign a damaged frame for a request, without storing the results; see `resign_frames`.

    Returns
    -------
    vector : (D,) signature
    artifact : encoded geometry, equal to the damaged original

    Raises
    ------
    DamagedBlob : If the upload is lost or damaged as well.
    FrameError : If the frame cannot be signed.
    """
    read = read_stored(store.blobs.get(frame.blob), frame, store.decoders)
    signature, geometry = prepare(read, signer)
    return signature.vector, write_geometry(geometry)


def _repairable(connection: Connection, numbers: Sequence[int], model_id: str) -> list[int]:
    """Return the indexed frames without a pending or recent repair job and without a known loss."""
    frames = frames_of(connection, numbers)
    now, due = time.time(), []
    for number in dict.fromkeys(numbers):
        job = latest_job(connection, REENCODE, number, model_id)
        # absolute difference, since a job may be in the future after the clock was set back
        busy = job is not None and (not job.state.over or abs(now - job.created_at) < PAUSE_S)
        if number not in frames or busy or is_known_loss(frames[number].reason):
            continue
        if frames[number].state == FrameState.INDEXED:
            due.append(number)
    return due


def take_upload(store: Store, map_name: str, frame_id: str, data: bytes) -> list[str]:
    """Replace the upload of a frame if it is lost or damaged; repair its geometry if it is, too.

    Parameters
    ----------
    map_name, frame_id : map and id of a frame with the same content
    data : bytes of the new upload

    Returns
    -------
    blobs : blobs that may be unreferenced now; empty if the stored upload is sound
    """
    try:
        with store.database.read() as connection:
            row = find_map(connection, map_name)
            frame = find_frame(connection, row, frame_id)
    except UnknownFrame:
        return []
    if store.database.read_only or frame.state == FrameState.DELETED:
        return []
    store.blobs.locks.await_removal(frame.blob)  # it may have started before the commit
    if not is_known_loss(frame.reason) and store.blobs.condition(frame.blob) == "sound":
        return []
    while True:
        blob = store.blobs.put(data)
        with store.database.write() as connection:
            now = frames_of(connection, [frame.number]).get(frame.number)
            if now is None:
                return [blob, frame.blob]
            if store.blobs.holds(blob):  # no deletion has removed it
                renew_upload(connection, now.number, blob, len(data), without_loss(now.reason))
                artifacts = geometry_blobs(connection, [now.number], row.model_id)
                break
    log.info("lost upload restored", extra={"map": row.name, "frame_id": frame_id})
    if any(store.blobs.condition(artifact) != "sound" for artifact in artifacts.values()):
        resign_frames(store, row, [now.number], row.model_id)
    return [] if blob == frame.blob else [frame.blob]
