"""An upload into the store: checked, durable, and queued in one commit."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

from sqlalchemy import Connection

from sceneprint.engine.frames import columns, content_id, read_upload
from sceneprint.engine.healing import take_upload, without_loss
from sceneprint.errors import FrameConflict, UnusableStore
from sceneprint.schemas import Added, FrameMeta, FrameState
from sceneprint.store import Store
from sceneprint.store.events import tell
from sceneprint.store.frames import add_frame, find_content, find_frame, refers_to, renew_frame
from sceneprint.store.listing import jobs_of
from sceneprint.store.maps import find_map
from sceneprint.store.novelty import loosen
from sceneprint.store.queue import enqueue
from sceneprint.store.records import MapRow

log = logging.getLogger(__name__)

#: Blobs that are removed in one transaction: writers wait meanwhile.
SWEPT_AT_ONCE = 200
#: What to call a column when it differs.
_FIELDS = {"pose_parent": "pose.parent_frame"}
_BEING_SIGNED = (FrameState.RECEIVED, FrameState.SIGNING)
#: It broke down every time, or was near to a frame that may be gone since.
_TRIED_AGAIN = (FrameState.FAILED, FrameState.REDUNDANT)


def upload(
    store: Store, map_name: str, data: bytes, meta: FrameMeta, priority: int = 0,
    if_novel: float | None = None,
) -> tuple[Added, bool]:  # fmt: skip
    """Take a frame into a map; it is safe when this returns, and signed soon after.

    The same content with the same metadata is the frame that is there; one that failed, or that
    was not kept as the map had its place, is tried again, and one whose upload was lost or damaged
    on disk has it again.

    Parameters
    ----------
    store : see Store
    map_name : of the map
    data : a PNG or NPY file
    meta : what is known of it
    priority : frames of a greater one are signed first; of one that is there it changes nothing
    if_novel : keep it only if the nearest frame of the map is farther, as a share of the distance
        of unrelated frames; None to keep it anyway. Of one that is not signed yet, the weaker
        condition counts

    Returns
    -------
    added : the frame and its job
    new : False where it was there already, and there is nothing to be done

    Raises
    ------
    UnknownMap : no such map.
    FrameError : see `read_upload`.
    FrameConflict : the same content is there with other metadata.
    UnusableStore : the disk is full, or the database cannot be written; nothing was taken.
    """
    with store.database.read() as connection:
        find_map(connection, map_name)  # before the work of decoding
    frame = read_upload(data, meta)
    content, known = content_id(frame), columns(meta, frame)
    with store.database.read() as connection:
        there = _there(connection, find_map(connection, map_name), content, known)
    if there is not None and there.state in _BEING_SIGNED:
        with store.database.write() as connection:
            there = _there(connection, find_map(connection, map_name), content, known)
            if there is not None:
                loosen(connection, there.frame_id, if_novel)
    if there is not None and there.state not in _TRIED_AGAIN:
        return _healed(store, map_name, there, data), False
    store.database.require_writable()  # before a blob to which nothing could refer
    former, added = list[str](), None
    while True:
        blob = store.blobs.put(data)
        with _unless_refused(store, blob), store.database.write() as connection:
            row = find_map(connection, map_name)
            there = _there(connection, row, content, known)  # another upload may have been first
            if there is not None and there.state not in _TRIED_AGAIN:
                loosen(connection, there.frame_id, if_novel)
                break
            if store.blobs.holds(blob):  # a deletion may have removed it
                of_blob = {"blob": blob, "bytes": len(data), "novelty": if_novel}
                if there is None:
                    values = {"content_id": content, **of_blob, **known}
                    frame_row = add_frame(connection, row.number, values)
                else:  # it was given up, and somebody asks for another try
                    former = [find_frame(connection, row, there.frame_id).blob]
                    frame_row = renew_frame(connection, there.frame_id, of_blob)
                job = enqueue(connection, "sign", frame_row.number, priority)
                tell(connection, "frame.received", row.name, frame_row.id, job.id)
                state = frame_row.state
                added = Added(frame_id=frame_row.id, job_id=job.id, state=state, reason=None)
                break
    if added is not None:
        sweep_deleted(store, [one for one in former if one != blob])  # it was packed otherwise
        return added, True
    assert there is not None
    sweep(store, [blob])
    return there, False


def _healed(store: Store, map_name: str, there: Added, data: bytes) -> Added:
    """The frame that is there; what came now takes the place of an upload that was lost."""
    left = take_upload(store, map_name, there.frame_id, data)
    if left:
        sweep(store, left)
    return there.model_copy(update={"reason": without_loss(there.reason)})


@contextmanager
def _unless_refused(store: Store, blob: str) -> Iterator[None]:
    """Leave no blob on a full disk that nothing refers to."""
    try:
        yield
    except UnusableStore:
        with suppress(UnusableStore):
            sweep(store, [blob])
        raise


def _there(
    connection: Connection, row: MapRow, content: str, given: dict[str, Any]
) -> Added | None:
    """The frame of that content, where the map has it."""
    frame = find_content(connection, row.number, content)
    if frame is None:
        return None
    differing = [
        _FIELDS.get(name, name) for name, value in given.items() if getattr(frame, name) != value
    ]
    if differing:
        raise FrameConflict(
            f"Frame {frame.id} has the same content, but other {', '.join(differing)}. A frame "
            "is in a map once: delete that one first, or send it as it was."
        )
    job = jobs_of(connection, [frame.number])[frame.number]
    return Added(frame_id=frame.id, job_id=job.id, state=frame.state, reason=frame.reason)


def sweep(store: Store, blobs: list[str]) -> None:
    """Remove blobs that nothing refers to any more.

    In writing transactions, so that no upload comes to refer to one in between, and short ones.
    While a snapshot is being taken they stay, as it may refer to them: `sceneprint fsck` removes
    them later.
    """
    for start in range(0, len(blobs), SWEPT_AT_ONCE):
        with store.database.write() as connection, store.blobs.removing() as allowed:
            if not allowed:
                log.info("blobs left for fsck", extra={"blobs": len(blobs) - start})
                return
            for blob in blobs[start : start + SWEPT_AT_ONCE]:
                if not refers_to(connection, blob):
                    store.blobs.remove(blob)


def sweep_deleted(store: Store, blobs: list[str]) -> None:
    """As `sweep`, after a deletion that took effect already and is not to be refused any more."""
    try:
        sweep(store, blobs)
    except UnusableStore as error:
        log.warning("blobs left for fsck", extra={"blobs": len(blobs), "error": str(error)})
