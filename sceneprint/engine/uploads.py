"""Uploads into the store: checked, durable, and queued, many in one commit.

    Upload  --prepare-->  Prepared  --blob-->  durable  --commit-->  Added

When an upload is answered, nothing can lose it. The disk is waited for by many at once.
"""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection

from sceneprint.engine.frames import columns, content_id, read_upload
from sceneprint.engine.healing import take_upload, without_loss
from sceneprint.engine.replaying import Outcome, kept_of, replayed, told
from sceneprint.engine.standing import being_signed, is_tried_again, standing
from sceneprint.engine.sweeping import sweep, sweep_deleted
from sceneprint.errors import (
    FrameConflict,
    QuotaExceeded,
    SceneprintError,
    StoreError,
    UnknownMap,
    UnusableStore,
)
from sceneprint.schemas import Added, FrameMeta, FrameState
from sceneprint.schemas.ingest import check_frame_id
from sceneprint.store import Store
from sceneprint.store.bell import Bell
from sceneprint.store.events import tell
from sceneprint.store.frames import add_frame, renew_frame
from sceneprint.store.grouping import Grouping
from sceneprint.store.idempotency import Once
from sceneprint.store.maps import find_map
from sceneprint.store.novelty import loosen
from sceneprint.store.queue import enqueue
from sceneprint.store.quotas import require_room
from sceneprint.store.records import MapRow


@dataclass(frozen=True, eq=False)
class Upload:
    """A frame as it is sent.

    Parameters
    ----------
    data : a depth image as PNG or NPY, or a point cloud: see `sceneprint.scans`
    meta : what is known of it
    priority : frames of a greater one are signed first; of one that is there it changes nothing
    if_novel : keep it only if the nearest frame of the map is farther, as a share of the distance
        of unrelated frames; None to keep it anyway. Of one that is not signed yet, the weaker
        condition counts
    frame_id : that it is to have; None: one of ours, and none where the map has its content
    """

    data: bytes
    meta: FrameMeta
    priority: int = 0
    if_novel: float | None = None
    frame_id: str | None = None


@dataclass(frozen=True, eq=False)
class _Prepared:
    """An upload that was looked at: who it is, and what is stored with it."""

    upload: Upload
    blob: str
    content: str
    known: dict[str, Any]


class Uploads:
    """Takes frames into maps; safe to share between threads.

    Parameters
    ----------
    store, bell : see there
    decoding : uploads that are decoded at once, which takes processors and memory; any number
        may wait for the disk
    """

    def __init__(self, store: Store, bell: Bell, decoding: int) -> None:
        self._store, self._bell = store, bell
        self._decoding = threading.BoundedSemaphore(decoding)
        self._writes = Grouping(store.database)

    def add(self, map_name: str, upload: Upload, once: Once | None = None) -> tuple[Outcome, bool]:
        """Take a frame into a map; it is safe when this returns, and signed soon after.

        The same content with the same metadata is the frame that is there; one that failed, or
        that was not kept as the map had its place, is tried again, and one whose upload was lost or
        damaged on disk has it again.

        Returns
        -------
        outcome : of which `added` is there
        replayed : whether it is that of an earlier request of the same `once`

        Raises
        ------
        UnknownMap : no such map.
        InvalidRequest : a frame id that is none; or see `read_upload`.
        FrameError : see `read_upload`.
        FrameConflict : the frame is there with other content or metadata.
        QuotaExceeded : the map's quota has no room for one more; nothing was taken.
        IdempotencyConflict : see `Once`.
        UnusableStore : the disk is full, or the database cannot be written; nothing was taken.
        """
        [outcome], again = self.add_all(map_name, [upload], once)
        if outcome.error is not None:
            raise outcome.error
        return outcome, again

    def add_all(
        self, map_name: str, uploads: Sequence[Upload], once: Once | None = None,
        fence: Callable[[Connection], None] | None = None,
    ) -> tuple[list[Outcome], bool]:  # fmt: skip
        """Take frames into a map in one commit; see `add`, but what is wrong with one is told.

        Parameters
        ----------
        map_name, uploads, once : see `add`
        fence : called in that commit before anything is written; whatever it raises of
            `SceneprintError` is raised, and none was taken

        Raises
        ------
        UnknownMap, IdempotencyConflict, UnusableStore : as `add`; none was taken.
        """
        with self._store.database.read() as connection:
            row = find_map(connection, map_name)  # before the work of decoding
            before = _before(connection, row, once)
            if before is not None:
                return before, True
        outcomes: list[Outcome | None] = [None] * len(uploads)
        ready: dict[int, _Prepared] = {}
        for i, upload in enumerate(uploads):
            try:
                ready[i] = self._prepared(upload)
            except StoreError:
                raise
            except SceneprintError as error:
                outcomes[i] = Outcome(None, error=error)
        for i in list(ready):
            found = self._settled(map_name, ready[i])
            if found is not None:
                outcomes[i] = found
                if once is None or found.added is None:
                    del ready[i]
        again = False
        if ready:
            outcomes, again = self._write(map_name, ready, outcomes, once, fence)
        if any(one is not None and one.new for one in outcomes) and not again:
            self._bell.ring()
        return [one for one in outcomes if one is not None], again

    def _prepared(self, upload: Upload) -> _Prepared:
        if upload.frame_id is not None:
            check_frame_id(upload.frame_id)
        with self._decoding:
            read = read_upload(upload.data, upload.meta)
            content = content_id(read)
        blob = hashlib.sha256(upload.data).hexdigest()
        known = {**columns(upload.meta, read.frame.pose, read.base), "cloud": read.cloud}
        return _Prepared(upload, blob, content, known)

    def _settled(self, map_name: str, ready: _Prepared) -> Outcome | None:
        """What comes of an upload for which nothing has to be written; None: it has to be."""
        try:
            with self._store.database.read() as connection:
                row = find_map(connection, map_name)
                frame = standing(connection, row, ready.content, ready.known, ready.upload.frame_id)
                if frame is None:  # what has no room is not even written to the disk
                    require_room(connection, row, len(ready.upload.data))
                if frame is None or is_tried_again(frame.state):
                    return None
                if being_signed(frame.state) and frame.novelty is not None:
                    return None  # its condition may have to be loosened
                there = told(connection, frame)
        except (StoreError, UnknownMap):
            raise
        except SceneprintError as error:
            return Outcome(None, error=error)
        return Outcome(self._healed(map_name, there, ready.upload.data))

    def _write(
        self, map_name: str, ready: dict[int, _Prepared], known: list[Outcome | None],
        once: Once | None, fence: Callable[[Connection], None] | None,
    ) -> tuple[list[Outcome | None], bool]:  # fmt: skip
        """Store those uploads of which it is not known yet what comes of them.

        Returns
        -------
        outcomes : of all
        replayed : whether they are those of an earlier request
        """
        self._store.database.require_writable()  # before a blob to which nothing could refer
        todo = {i: one for i, one in ready.items() if known[i] is None}
        blobs = {one.blob: one.upload.data for one in todo.values()}
        left = list[str]()  # blobs that may be of no use

        def do(connection: Connection) -> tuple[list[Outcome | None], bool] | None:
            if fence is not None:
                fence(connection)
            row = find_map(connection, map_name)
            before = _before(connection, row, once)
            if before is not None:
                left[:] = blobs
                return list(before), True
            if not all(map(self._store.blobs.holds, blobs)):
                return None  # a deletion has removed one
            left.clear()
            written = {i: _stored(connection, row, one, left) for i, one in todo.items()}
            outcomes = [written.get(i, one) for i, one in enumerate(known)]
            came = [one for one in outcomes if one is not None]
            # what had no room may have it when it is sent again
            if once is not None and not any(isinstance(one.error, QuotaExceeded) for one in came):
                once.keep(connection, kept_of(came))
            return outcomes, False

        while True:
            try:
                for data in blobs.values():
                    self._store.blobs.put(data)
                found = self._writes.run(do)
            except SceneprintError:
                with suppress(UnusableStore):  # leave nothing, on a full disk least of all
                    sweep(self._store, list(blobs))
                raise
            if found is not None:
                sweep_deleted(self._store, left)
                return found

    def _healed(self, map_name: str, there: Added, data: bytes) -> Added:
        """The frame that is there; what came takes the place of an upload that was lost."""
        left = take_upload(self._store, map_name, there.frame_id, data)
        if left:
            sweep(self._store, left)
        return there.model_copy(update={"reason": without_loss(there.reason)})


def _before(connection: Connection, row: MapRow, once: Once | None) -> list[Outcome] | None:
    """What came of the same request before."""
    data = None if once is None else once.found(connection)
    return None if data is None else replayed(connection, row, data)


def _stored(connection: Connection, row: MapRow, ready: _Prepared, left: list[str]) -> Outcome:
    """What comes of an upload; blobs that are of no use any more are added to `left`."""
    upload = ready.upload
    try:  # once more: another upload may have been first
        frame = standing(connection, row, ready.content, ready.known, upload.frame_id)
    except FrameConflict as error:
        left.append(ready.blob)
        return Outcome(None, error=error)
    if frame is not None and not is_tried_again(frame.state):
        loosen(connection, frame.number, upload.if_novel)
        left.append(ready.blob)
        return Outcome(told(connection, frame))
    new = frame is None or frame.state == FrameState.REDUNDANT
    # a failed one is counted already, and may come packed otherwise
    held = 0 if frame is None or new else frame.bytes
    try:
        require_room(connection, row, len(upload.data) - held, new=new)
    except QuotaExceeded as error:
        left.append(ready.blob)
        return Outcome(None, error=error)
    of_blob = {"blob": ready.blob, "bytes": len(upload.data), "novelty": upload.if_novel}
    if frame is None:
        values = {"content_id": ready.content, **of_blob, **ready.known}
        frame = add_frame(connection, row.number, values, upload.frame_id)
    else:  # it was given up, and somebody asks for another try
        left.append(frame.blob)  # it was packed otherwise
        frame = renew_frame(connection, frame.number, of_blob)
    job = enqueue(connection, "sign", frame.number, upload.priority)
    tell(connection, "frame.received", row.name, frame.id, job.id)
    added = Added(frame_id=frame.id, job_id=job.id, state=frame.state, reason=None)
    return Outcome(added, new=True)
