"""Uploads: durable storage of frames, and jobs that sign them.

    Upload  --read_upload-->  decoded  --Store.blobs-->  durable blob  --add_frame-->  Added

An acknowledged upload is never lost. Concurrent uploads share commits.
"""

from __future__ import annotations

import hashlib
import threading
import uuid
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any
from weakref import WeakValueDictionary

from sqlalchemy import Connection, select

from sceneprint import errors
from sceneprint.engine.context import Context
from sceneprint.engine.ingest.frame_decoder import columns, content_id, read_upload
from sceneprint.engine.ingest.write_groups import Grouping, NewFrames
from sceneprint.engine.serializers import sample_range_of
from sceneprint.engine.upkeep import garbage_collection, repair
from sceneprint.formats.sample_range import sample_range
from sceneprint.store.deletion import make_room
from sceneprint.store.events import record_event
from sceneprint.store.frames import relax_novelty, reset_frame
from sceneprint.store.keys import IdempotentRequest, Overtaken
from sceneprint.store.maps import add_frame, find_map, frames_of_content, living_frame, require_room
from sceneprint.store.new_frames import NewFrame, receive_frames
from sceneprint.store.queue import enqueue, signing_jobs
from sceneprint.store.tables import FrameRow, MapRow, frame_row, frames
from sceneprint_client.api import Added, FrameMeta, FrameState
from sceneprint_client.api.frames import BatchItem, SampleRange, check_frame_id, problem_of

# Identity: decide whether an upload is a new frame, a duplicate, or a conflict.

#: Names of columns in error messages, where they differ from the column names.
_FIELDS = {
    "pose_parent": "pose.parent_frame", "base": "T_base_sensor", "content_id": "content",
    "cloud": "units_per_metre",
}  # fmt: skip
#: Columns that do not distinguish uploads: the same content with another name is a duplicate, and
#: the samples follow from the content.
_LABELS = ("name", "sequence", "samples")


def find_duplicate(
    connection: Connection, row: MapRow, content: str, metadata: dict[str, Any],
    frame_id: str | None = None,
) -> FrameRow | None:  # fmt: skip
    """Return the frame that an upload duplicates; None if it is new.

    Parameters
    ----------
    content : content hash of the upload
    metadata : metadata columns of the upload
    frame_id : id of the only frame to compare; None compares all frames with the same content

    Raises
    ------
    FrameConflict : If frame `frame_id` has different content or metadata; without `frame_id`, if
        all frames with the same content have different metadata.
    """
    if frame_id is not None:
        frame = living_frame(connection, row.number, frame_id)
        if frame is None:
            return None
        differing = _differing(frame, {"content_id": content, **metadata})
        if differing:
            raise errors.FrameConflict(
                f"Frame {frame.id} of map {row.name} already exists with a different "
                f"{', '.join(differing)}. Delete the stored frame first, send the frame unchanged, "
                "or use another id."
            )
        return frame
    alike = frames_of_content(connection, row.number, content)
    for frame in alike:
        if not _differing(frame, metadata):
            return frame
    if alike:
        raise errors.FrameConflict(
            f"Frame {alike[0].id} has the same content, but a different "
            f"{', '.join(_differing(alike[0], metadata))}. A map stores the same content once. "
            "Delete the stored frame first, send the frame unchanged, or PUT it with its own id."
        )
    return None


def _differing(frame: FrameRow, metadata: dict[str, Any]) -> list[str]:
    """Return the names of the upload fields that differ from those sent with a stored frame."""
    stored = vars(frame)
    if frame.sent_parent is not None:  # a join has moved the pose
        stored = {**stored, "pose": frame.sent_pose, "pose_parent": frame.sent_parent}

    def sent(name: str, value: Any) -> Any:  # compare only the units of a cloud
        return value["units_per_metre"] if name == "cloud" and value is not None else value

    names = [name for name in metadata if name not in _LABELS]
    return [
        _FIELDS.get(name, name)
        for name in names
        if sent(name, stored[name]) != sent(name, metadata[name])
    ]


def is_retried(state: FrameState) -> bool:
    """Return whether a repeated upload retries a frame in this state.

    It retries failed frames, and redundant frames, since the frame that made them redundant may
    have been deleted.
    """
    return state in (FrameState.FAILED, FrameState.REDUNDANT)


@dataclass(frozen=True)
class UploadResult:
    """The result of an upload.

    Parameters
    ----------
    added : record of the frame and its job; None if the upload was refused
    new : whether the upload queued a job; False for a duplicate
    error : reason for the refusal; None if the upload was accepted
    """

    added: Added | None
    new: bool = False
    error: errors.SceneprintError | None = None

    @property
    def accepted(self) -> Added:
        """Record of the frame and its job; raise `error` if the upload was refused."""
        if self.added is None:
            raise self.error or ValueError("neither stored nor refused")
        return self.added


def item_of(outcome: UploadResult) -> BatchItem:
    """Convert the result of an upload to an item of a batch response."""
    if outcome.error is not None:
        problem = problem_of(outcome.error)
        return BatchItem(status=problem.status, frame=None, problem=problem)
    return BatchItem(status=202 if outcome.new else 200, frame=outcome.accepted, problem=None)


def upload_response(connection: Connection, frame: FrameRow) -> Added:
    """Return the response to an upload whose frame is stored."""
    job_id = signing_jobs(connection, [frame.number])[frame.number]
    return _added(frame, job_id, frame.reason)


def _added(frame: FrameRow, job_id: str, reason: str | None = None) -> Added:
    return Added(
        frame_id=frame.id, job_id=job_id, state=frame.state, reason=reason,
        samples=sample_range_of(frame), has_pose=frame.pose is not None,
    )  # fmt: skip


def _earlier_results(
    connection: Connection, row: MapRow, once: IdempotentRequest | None
) -> list[UploadResult] | None:
    """Return the results of an earlier request with the key of `once`, with the current states of
    its frames; None if there was no such request, or one of its frames no longer exists.

    Raise IdempotencyConflict if the earlier request was different.
    """
    data = None if once is None else once.stored_result(connection)
    if data is None:
        return None
    results = []
    for stored in data["frames"]:
        if "error" in stored:
            results.append(UploadResult(None, error=_error(stored)))
            continue
        own = frames.c.id == stored["frame_id"], frames.c.map_number == row.number
        frame = connection.execute(select(frames).where(*own)).mappings().first()
        if frame is None:
            return None
        results.append(UploadResult(upload_response(connection, frame_row(frame)), stored["new"]))
    return results


def _stored_outcome(outcome: UploadResult) -> dict[str, Any]:
    """Convert the result of an upload to JSON for an idempotency key; see `_error`."""
    if outcome.added is not None:
        return {"frame_id": outcome.added.frame_id, "new": outcome.new}
    error = outcome.error
    fields = error.fields if isinstance(error, errors.InvalidRequest) else ()
    return {"error": type(error).__name__, "detail": str(error), "fields": fields}


def _error(stored: dict[str, Any]) -> errors.SceneprintError:
    kind: type[errors.SceneprintError] = getattr(errors, stored["error"])
    if issubclass(kind, errors.InvalidRequest):
        return kind(stored["detail"], tuple((place, reason) for place, reason in stored["fields"]))
    return kind(stored["detail"])


@dataclass(frozen=True, eq=False)
class Upload:
    """A frame to store, as sent by a client.

    Parameters
    ----------
    data : file of a depth image (PNG or NPY), or of a point cloud (`sceneprint_client.formats`)
    priority : priority of the job; ignored if the frame exists
    if_novel : minimum distance from the nearest frame of the map, as a share of the mean distance
        between unrelated frames; None accepts any distance. If the frame exists and is not signed
        yet, the smaller minimum applies
    frame_id : requested id; None selects a new id, or that of the duplicate
    """

    data: bytes
    meta: FrameMeta
    priority: int = 0
    if_novel: float | None = None
    frame_id: str | None = None


@dataclass(frozen=True, eq=False)
class _Prepared:
    """An upload after decoding: its blob, content hash and metadata columns."""

    upload: Upload
    blob: str
    content: str
    metadata: dict[str, Any]

    @property
    def size(self) -> int:
        """Size of the upload, bytes."""
        return len(self.upload.data)

    @property
    def blob_columns(self) -> dict[str, Any]:
        """Columns of the blob and of the novelty threshold."""
        return {"blob": self.blob, "bytes": self.size, "novelty": self.upload.if_novel}

    @property
    def columns(self) -> dict[str, Any]:
        """All columns of a new frame; see `add_frame`."""
        return {"content_id": self.content, **self.blob_columns, **self.metadata}


@dataclass(frozen=True, eq=False)
class _Request:
    """Uploads to store in one transaction.

    Parameters
    ----------
    todo : uploads without a result, by their index in the request
    results, once, fence : see `Uploads.add_all`
    unused : blobs of the last attempt that may be unreferenced
    """

    todo: dict[int, _Prepared]
    results: list[UploadResult | None]
    once: IdempotentRequest | None
    fence: Callable[[Connection], None] | None
    unused: list[str] = field(default_factory=list)

    @cached_property
    def blobs(self) -> dict[str, bytes]:
        """Contents of the blobs to write before the rows, by digest."""
        return {prepared.blob: prepared.upload.data for prepared in self.todo.values()}

    @property
    def is_single(self) -> bool:
        """Return whether the request stores exactly one frame and has no fence."""
        return len(self.results) == len(self.todo) == 1 and self.fence is None


class IncomingBytes:
    """Number of archive bytes that a map is receiving, and that no database row counts yet."""

    def __init__(self) -> None:
        self._sizes, self._guard = Counter[int](), threading.Lock()

    def add(self, map_number: int, size: int) -> int:
        """Add bytes (negative to remove) to the count of a map, and return the new count."""
        with self._guard:
            self._sizes[map_number] += size
            return self._sizes[map_number]


class Uploads:
    """Storage of uploaded frames; safe to share between threads."""

    def __init__(self, context: Context) -> None:
        self._store, self._bell = context.store, context.bell
        # write groups by map number, while a thread writes to the map
        self._writes = WeakValueDictionary[int | None, Grouping]()
        self._guard = threading.Lock()
        self._new_frames = NewFrames(context.store.database)
        self.incoming = IncomingBytes()

    def add(
        self, map_name: str, upload: Upload, once: IdempotentRequest | None = None
    ) -> tuple[UploadResult, bool]:
        """Store a frame in a map durably, and queue its signing.

        An upload with the content and the metadata of a stored frame is a duplicate: it retries a
        failed or redundant frame, and replaces a lost or damaged blob.

        Returns
        -------
        result : result with `added`
        replayed : whether an earlier request with the key of `once` stored the frame

        Raises
        ------
        UnknownMap : If the map does not exist.
        InvalidRequest : If the frame id is not valid. See also `read_upload`.
        FrameError : See `read_upload`.
        FrameConflict : See `find_duplicate`.
        QuotaExceeded : If the map has no room for the frame; nothing was stored.
        IdempotencyConflict : See `IdempotentRequest`.
        UnusableStore : If the disk is full, or the database cannot be written; nothing was stored.
        """
        [outcome], again = self.add_all(map_name, [upload], once)
        if outcome.error is not None:
            raise outcome.error
        return outcome, again

    def add_all(
        self, map_name: str, uploads: Sequence[Upload], once: IdempotentRequest | None = None,
        fence: Callable[[Connection], None] | None = None,
    ) -> tuple[list[UploadResult], bool]:  # fmt: skip
        """Store frames in one commit; return (results, replayed) as `add`, with errors of frames.

        Parameters
        ----------
        fence : function that is called first in the transaction; if it raises a
            `SceneprintError`, nothing is stored

        Raises
        ------
        UnknownMap, IdempotencyConflict, UnusableStore : See `add`; nothing was stored.
        """
        with self._store.database.read() as connection:
            row = find_map(connection, map_name)
            before = _earlier_results(connection, row, once)
        if before is not None:
            for upload, outcome in zip(uploads, before, strict=True):
                if outcome.added is not None:  # the stored blob may be lost
                    self._renew(map_name, outcome.added.frame_id, upload)
            return before, True
        outcomes: list[UploadResult | None] = [None] * len(uploads)
        ready: dict[int, _Prepared] = {}
        for i, upload in enumerate(uploads):
            try:
                ready[i] = self._prepared(upload)
            except errors.StoreError:
                raise
            except errors.SceneprintError as error:
                outcomes[i] = UploadResult(None, error=error)
        for i in list(ready):
            result = self._read_result(map_name, ready[i])
            if result is not None:
                outcomes[i] = result
                if once is None or result.added is None:
                    del ready[i]
        again = False
        if ready:
            outcomes, again = self._write(row, ready, outcomes, once, fence)
        if any(outcome is not None and outcome.new for outcome in outcomes) and not again:
            self._bell.ring()
        return [outcome for outcome in outcomes if outcome is not None], again

    def _prepared(self, upload: Upload) -> _Prepared:
        if upload.frame_id is not None:
            check_frame_id(upload.frame_id)
        read = read_upload(upload.data, upload.meta, self._store.decoders)
        samples = sample_range(read.frame).model_dump()
        metadata = {
            **columns(upload.meta, read.frame.pose, read.base), "cloud": read.cloud,
            "samples": {**samples, "trusted": upload.meta.trust_depth},
        }  # fmt: skip
        blob = hashlib.sha256(upload.data).hexdigest()
        return _Prepared(upload, blob, content_id(read), metadata)

    def _read_result(self, map_name: str, ready: _Prepared) -> UploadResult | None:
        """Return the result of an upload that requires no write; None if a write is required."""
        try:
            with self._store.database.read() as connection:
                row = find_map(connection, map_name)
                frame = find_duplicate(
                    connection, row, ready.content, ready.metadata, ready.upload.frame_id
                )
                if frame is None:  # check the quota before writing a blob
                    require_room(connection, row, ready.size + self.incoming.add(row.number, 0))
                if frame is None or is_retried(frame.state):
                    return None
                waits = frame.state in (FrameState.RECEIVED, FrameState.SIGNING)
                if waits and frame.novelty is not None:
                    return None  # the write may relax the novelty threshold
                added = upload_response(connection, frame)
        except (errors.StoreError, errors.UnknownMap):
            raise
        except errors.SceneprintError as error:
            return UploadResult(None, error=error)
        self._renew(map_name, added.frame_id, ready.upload)
        reason = repair.without_loss(added.reason)
        return UploadResult(added.model_copy(update={"reason": reason}))

    def _renew(self, map_name: str, frame_id: str, upload: Upload) -> None:
        """Replace the blob of a frame if it is lost or damaged; remove unreferenced blobs."""
        unused = repair.take_upload(self._store, map_name, frame_id, upload.data)
        if unused:
            garbage_collection.collect_blobs(self._store, unused)

    def _write(
        self, row: MapRow, ready: dict[int, _Prepared], results: list[UploadResult | None],
        once: IdempotentRequest | None, fence: Callable[[Connection], None] | None,
    ) -> tuple[list[UploadResult | None], bool]:  # fmt: skip
        """Store the uploads that have no result yet.

        Parameters
        ----------
        row : map
        ready : decoded uploads by index

        Returns
        -------
        results : results of all uploads
        replayed : see `add`
        """
        self._store.database.require_writable()  # fail before any blob is written
        todo = {i: prepared for i, prepared in ready.items() if results[i] is None}
        request = _Request(todo, results, once, fence)
        blobs = request.blobs
        while True:
            try:
                for data in blobs.values():
                    self._store.blobs.put(data)
                single = self._insert_single(row, request) if request.is_single else None
                if single is not None:
                    return [single], False
                written = self._grouping(row).run(partial(self._store_all, row, request))
                if written is None:
                    with self._store.database.read() as connection:
                        row = find_map(connection, row.name)
            except Overtaken:
                continue
            except errors.SceneprintError:
                with suppress(errors.UnusableStore):
                    garbage_collection.collect_blobs(self._store, list(blobs))
                raise
            if written is not None:
                if request.unused:
                    garbage_collection.collect_deleted_blobs(self._store, request.unused)
                return written

    def _insert_single(self, row: MapRow, request: _Request) -> UploadResult | None:
        """Insert a new frame with a statement that concurrent uploads share, on PostgreSQL.

        Write nothing and return None if the frame is not new or has a requested id, other uploads
        wait for the map, or the database is SQLite.
        """
        [prepared] = request.todo.values()
        if self._store.database.is_sqlite or prepared.upload.frame_id is not None:
            return None
        if row.number in self._writes:
            return None
        new = _new_frame(row, prepared, request.once)
        if not self._new_frames.receive(new):
            return None
        # a deletion may have removed the blob before the commit; until it is written again, a
        # worker retries
        self._store.blobs.ensure(prepared.blob, prepared.upload.data)
        return _new_result(new)

    def _store_all(
        self, row: MapRow, request: _Request, connection: Connection
    ) -> tuple[list[UploadResult | None], bool] | None:
        """Store uploads; return (results, replayed), or None if a blob or the map is gone."""
        if request.fence is not None:
            request.fence(connection)
        if not all(map(self._store.blobs.holds, request.blobs)):
            return None  # retry before a replay too: its frame may refer to the blob
        if request.once is not None:
            now = find_map(connection, row.name)
            if now.number != row.number:
                return None
            before = _earlier_results(connection, now, request.once)
            if before is not None:
                request.unused[:] = request.blobs
                return list(before), True
        request.unused.clear()
        new = {
            i: _new_frame(row, prepared)
            for i, prepared in request.todo.items()
            if prepared.upload.frame_id is None
        }
        ids = receive_frames(connection, list(new.values()))
        written = {i: _new_result(frame) for i, frame in new.items() if frame.frame_id in ids}
        for i, prepared in request.todo.items():
            if i in written:
                continue
            now = find_map(connection, row.name)
            if now.number != row.number:
                return None
            written[i] = _store_single(connection, now, prepared, request.unused)
        results = [written.get(i, result) for i, result in enumerate(request.results)]
        if request.once is not None and not any(
            result is not None and isinstance(result.error, errors.QuotaExceeded)
            for result in results
        ):  # after QuotaExceeded, a repeated request may succeed
            stored = [_stored_outcome(result) for result in results if result is not None]
            request.once.store(connection, {"frames": stored})
        return results, False

    def _grouping(self, row: MapRow) -> Grouping:
        """Return the write group of a map; on SQLite, all maps share one group."""
        key = None if self._store.database.is_sqlite else row.number
        with self._guard:
            group = self._writes.get(key)
            if group is None:
                group = self._writes[key] = Grouping(self._store.database, key)
            return group


def _new_frame(row: MapRow, ready: _Prepared, once: IdempotentRequest | None = None) -> NewFrame:
    """Return a frame that a statement inserts unless it exists.

    With `once` (PostgreSQL only), the statement also stores the result for the idempotency key.
    """
    frame_id = uuid.uuid4().hex
    outcome = None
    if once is not None:
        outcome = once.columns({"frames": [{"frame_id": frame_id, "new": True}]})
    return NewFrame(row, ready.columns, ready.upload.priority, outcome, frame_id)


def _new_result(new: NewFrame) -> UploadResult:
    """Return the result of an upload that inserted a frame."""
    added = Added(
        frame_id=new.frame_id, job_id=new.job_id, state=FrameState.RECEIVED, reason=None,
        samples=SampleRange.model_validate(new.values["samples"]),
        has_pose=new.values["pose"] is not None,
    )  # fmt: skip
    return UploadResult(added, new=True)


def _store_single(
    connection: Connection, row: MapRow, ready: _Prepared, unused: list[str]
) -> UploadResult:
    """Store an upload, and return its result; add blobs that may be unreferenced to `unused`."""
    upload = ready.upload
    try:  # another upload may have added the frame
        frame = find_duplicate(connection, row, ready.content, ready.metadata, upload.frame_id)
    except errors.FrameConflict as error:
        unused.append(ready.blob)
        return UploadResult(None, error=error)
    if frame is not None and not is_retried(frame.state):
        relax_novelty(connection, frame.number, upload.if_novel)
        unused.append(ready.blob)
        return UploadResult(upload_response(connection, frame))
    new = frame is None or frame.state == FrameState.REDUNDANT
    # the quota already counts the former blob of a failed frame, whose size may differ
    counted = 0 if frame is None or new else frame.bytes
    try:
        unused.extend(make_room(connection, row, ready.size - counted, new=new))
    except errors.QuotaExceeded as error:
        unused.append(ready.blob)
        return UploadResult(None, error=error)
    if frame is None:
        frame = add_frame(connection, row.number, ready.columns, upload.frame_id)
    else:
        unused.append(frame.blob)  # the new blob may have another file format
        frame = reset_frame(connection, frame.number, ready.blob_columns)
    job = enqueue(connection, "sign", frame.number, upload.priority)
    record_event(connection, "frame.received", row.name, frame.id, job.id)
    return UploadResult(_added(frame, job.id), new=True)
