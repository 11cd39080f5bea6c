"""An upload into the store: checked, durable, and queued in one commit."""

from __future__ import annotations

from typing import Any

from sqlalchemy import Connection

from sceneprint.engine.frames import columns, content_id, read_upload
from sceneprint.errors import FrameConflict
from sceneprint.schemas import Added, FrameMeta, FrameState
from sceneprint.store import Store
from sceneprint.store.events import tell
from sceneprint.store.frames import add_frame, find_content, refers_to, renew_frame
from sceneprint.store.maps import find_map
from sceneprint.store.queue import enqueue, jobs_of
from sceneprint.store.records import MapRow

#: What to call a column when it differs.
_FIELDS = {"pose_parent": "pose.parent_frame"}


def upload(store: Store, map_name: str, data: bytes, meta: FrameMeta) -> tuple[Added, bool]:
    """Take a frame into a map; it is safe when this returns, and signed soon after.

    The same content with the same metadata is the frame that is there; one that failed is tried
    again.

    Parameters
    ----------
    store : see Store
    map_name : of the map
    data : a PNG or NPY file
    meta : what is known of it

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
    if there is not None and there.state != FrameState.FAILED:
        return there, False
    while True:
        blob = store.blobs.put(data)
        with store.database.write() as connection:
            row = find_map(connection, map_name)
            there = _there(connection, row, content, known)  # another upload may have been first
            if there is not None and there.state != FrameState.FAILED:
                break
            if store.blobs.holds(blob):  # a deletion may have removed it
                of_blob = {"blob": blob, "bytes": len(data)}
                if there is None:
                    values = {"content_id": content, **of_blob, **known}
                    frame_row = add_frame(connection, row.number, values)
                else:  # it broke down every time, and somebody asks for another
                    frame_row = renew_frame(connection, there.frame_id, of_blob)
                job = enqueue(connection, "sign", frame_row.number)
                tell(connection, "frame.received", row.name, frame_row.id, job.id)
                state = frame_row.state
                return Added(frame_id=frame_row.id, job_id=job.id, state=state, reason=None), True
    sweep(store, [blob])
    return there, False


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

    In a writing transaction, so that no upload comes to refer to one in between.
    """
    with store.database.write() as connection:
        for blob in blobs:
            if not refers_to(connection, blob):
                store.blobs.remove(blob)
