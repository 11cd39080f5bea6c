"""Uploads: check and store frames durably, and queue their signing, many in one commit.

    Upload  --read_upload-->  decoded  --Store.blobs-->  durable blob  --add_frame-->  Added

An answered upload cannot be lost. Concurrent uploads share the wait for the disk.
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
from sceneprint.store.frames import relax_novelty, renew_frame
from sceneprint.store.keys import IdempotentRequest, Overtaken
from sceneprint.store.maps import add_frame, find_map, frames_of_content, living_frame, require_room
from sceneprint.store.new_frames import NewFrame, receive_frames
from sceneprint.store.queue import enqueue, signing_jobs
from sceneprint.store.tables import FrameRow, MapRow, frame_row, frames
from sceneprint_client.api import Added, FrameMeta, FrameState
from sceneprint_client.api.frames import BatchItem, SampleRange, check_frame_id, problem_of

# Identity: an upload is a new frame, a duplicate, or a conflict.

#: Names of columns in error messages.
_FIELDS = {
    "pose_parent": "pose.parent_frame", "base": "T_base_sensor", "content_id": "content",
    "cloud": "units_per_metre",
}  # fmt: skip
#: Columns that do not distinguish uploads: the same content with another name is a duplicate, and
#: keeps its first name; samples follow from the content.
_LABELS = ("name", "sequence", "samples")


def find_duplicate(
    connection: Connection, row: MapRow, content: str, metadata: dict[str, Any],
    frame_id: str | None = None,
) -> FrameRow | None:  # fmt: skip
    """Return the frame that an upload duplicates; None if it is new.

    Parameters
    ----------
    metadata : the upload's columns
    frame_id : requested id: only its frame is compared; None compares all frames with the content

    Raises
    ------
    FrameConflict : If the frame with the id has other content or metadata; without an id, if every
        frame with the content has other metadata.
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
            f"{', '.join(_differing(alike[0], metadata))}. A map stores the same content once: "
            "delete that frame first, send it unchanged, or PUT it under its own id."
        )
    return None


def _sent_value(frame: FrameRow, name: str) -> Any:
    """Return a column of a frame as it was sent, before a join moved its pose."""
    if frame.sent_parent is not None and name in ("pose", "pose_parent"):
        return frame.sent_pose if name == "pose" else frame.sent_parent
    return getattr(frame, name)


def _differing(frame: FrameRow, metadata: dict[str, Any]) -> list[str]:
    return [
        _FIELDS.get(name, name)
        for name, value in metadata.items()
        if name not in _LABELS
        and _caller_value(name, _sent_value(frame, name)) != _caller_value(name, value)
    ]


def _caller_value(name: str, value: Any) -> Any:
    """Return the part of a column that the caller supplied: for a cloud, only its units."""
    return value["units_per_metre"] if name == "cloud" and value is not None else value


def is_retried(state: FrameState) -> bool:
    """Return whether a repeated upload retries a frame in this state.

    Failed and redundant frames are retried: the frame that made them redundant may be deleted.
    """
    return state in (FrameState.FAILED, FrameState.REDUNDANT)


@dataclass(frozen=True)
class UploadResult:
    """The result of an upload.

    Parameters
    ----------
    added : the frame and its job; None if the upload was refused
    new : False if the frame existed already, and nothing is to be done
    error : why the upload was refused
    """

    added: Added | None
    new: bool = False
    error: errors.SceneprintError | None = None

    @property
    def accepted(self) -> Added:
        """The frame and its job; raise `error` if the upload was refused."""
        if self.added is None:
            raise self.error or ValueError("neither stored nor refused")
        return self.added


def item_of(outcome: UploadResult) -> BatchItem:
    """Return the item of a batch for an upload's result."""
    if outcome.error is not None:
        problem = problem_of(outcome.error)
        return BatchItem(status=problem.status, frame=None, problem=problem)
    return BatchItem(status=202 if outcome.new else 200, frame=outcome.accepted, problem=None)


def upload_response(connection: Connection, frame: FrameRow) -> Added:
    """Return the answer to an upload of a stored frame."""
    job_id = signing_jobs(connection, [frame.number])[frame.number]
    return _added(frame, job_id, frame.reason)


def _added(frame: FrameRow, job_id: str, reason: str | None = None) -> Added:
    return Added(
        frame_id=frame.id, job_id=job_id, state=frame.state, reason=reason,
        samples=sample_range_of(frame), has_pose=frame.pose is not None,
    )  # fmt: skip


def replayed(
    connection: Connection, row: MapRow, data: dict[str, Any]
) -> list[UploadResult] | None:
    """Return stored results with their current frames; None if the map was replaced."""
    results = []
    for one in data["frames"]:
        if "error" in one:
            results.append(UploadResult(None, error=_error(one)))
            continue
        own = frames.c.id == one["frame_id"], frames.c.map_number == row.number
        frame = connection.execute(select(frames).where(*own)).mappings().first()
        if frame is None:
            return None
        results.append(UploadResult(upload_response(connection, frame_row(frame)), one["new"]))
    return results


def _stored_outcome(outcome: UploadResult) -> dict[str, Any]:
    """Return the JSON that stores an upload's result."""
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
    """A frame as sent.

    Parameters
    ----------
    data : a depth image as PNG or NPY, or a point cloud: see `sceneprint.formats.points`
    priority : frames of a higher priority are signed first; ignored if the frame exists
    if_novel : minimum distance from the nearest frame of the map, as a share of the distance of
        unrelated frames; None: no minimum. For a duplicate that is not signed yet, the weaker
        condition applies
    frame_id : requested id; None: a new one, or the duplicate's
    """

    data: bytes
    meta: FrameMeta
    priority: int = 0
    if_novel: float | None = None
    frame_id: str | None = None


@dataclass(frozen=True, eq=False)
class _Prepared:
    """A decoded upload, with its identity and columns."""

    upload: Upload
    blob: str
    content: str
    metadata: dict[str, Any]

    @property
    def size(self) -> int:
        """Bytes of the upload."""
        return len(self.upload.data)

    @property
    def blob_columns(self) -> dict[str, Any]:
        """Columns of the upload's bytes and novelty."""
        return {"blob": self.blob, "bytes": self.size, "novelty": self.upload.if_novel}

    @property
    def columns(self) -> dict[str, Any]:
        """Columns of a new frame; see `add_frame`."""
        return {"content_id": self.content, **self.blob_columns, **self.metadata}


@dataclass(frozen=True, eq=False)
class _Request:
    """Uploads to store together.

    Parameters
    ----------
    todo : uploads without a result yet, by index
    results, once, fence : see `Uploads.add_all`
    left : possibly unused blobs of the last attempt
    """

    todo: dict[int, _Prepared]
    results: list[UploadResult | None]
    once: IdempotentRequest | None
    fence: Callable[[Connection], None] | None
    left: list[str] = field(default_factory=list)

    @cached_property
    def blobs(self) -> dict[str, bytes]:
        """Blobs to write before the rows."""
        return {one.blob: one.upload.data for one in self.todo.values()}

    @property
    def is_single(self) -> bool:
        """Whether the request is one upload, and writes only its frame."""
        return len(self.results) == len(self.todo) == 1 and self.fence is None


class IncomingBytes:
    """Bytes of archives that this process is receiving, by map; no row counts them yet."""

    def __init__(self) -> None:
        self._sizes, self._guard = Counter[int](), threading.Lock()

    def add(self, map_number: int, size: int) -> int:
        """Add bytes, which may be negative, and return the map's sum."""
        with self._guard:
            self._sizes[map_number] += size
            return self._sizes[map_number]


class Uploads:
    """Store uploaded frames in maps; safe to share between threads."""

    def __init__(self, context: Context) -> None:
        self._store, self._bell = context.store, context.bell
        # groups by map, while a thread writes to it
        self._writes = WeakValueDictionary[int | None, Grouping]()
        self._guard = threading.Lock()
        self._new_frames = NewFrames(context.store.database)
        self.incoming = IncomingBytes()

    def add(
        self, map_name: str, upload: Upload, once: IdempotentRequest | None = None
    ) -> tuple[UploadResult, bool]:
        """Store a frame in a map durably, and queue its signing.

        An upload with the content and the metadata of a frame is a duplicate. It retries a failed
        or redundant frame, and replaces a lost or damaged upload.

        Returns
        -------
        outcome : result with `added`
        replayed : whether an earlier request with the key of `once` stored it

        Raises
        ------
        UnknownMap : If the map does not exist.
        InvalidRequest : If the frame id is not valid. See also `read_upload`.
        FrameError : See `read_upload`.
        FrameConflict : If the frame exists with other content or metadata.
        QuotaExceeded : If the map's quota has no room for another frame; nothing was stored.
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
        """Store frames in a map in one commit; see `add`.

        The results contain errors of single frames.

        Parameters
        ----------
        fence : function that is called in the commit before anything is written; if it raises a
            `SceneprintError`, nothing is stored

        Raises
        ------
        UnknownMap, IdempotencyConflict, UnusableStore : See `add`; nothing was stored.
        """
        with self._store.database.read() as connection:
            row = find_map(connection, map_name)  # before decoding
            before = _before(connection, row, once)
        if before is not None:
            for upload, outcome in zip(uploads, before, strict=True):
                if outcome.added is not None:  # the stored upload may be lost
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
        if any(one is not None and one.new for one in outcomes) and not again:
            self._bell.ring()
        return [one for one in outcomes if one is not None], again

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
        """Return the result of an upload without a write; None if a write is needed."""
        try:
            with self._store.database.read() as connection:
                row = find_map(connection, map_name)
                frame = find_duplicate(
                    connection, row, ready.content, ready.metadata, ready.upload.frame_id
                )
                if frame is None:  # check the quota before a blob is written
                    require_room(connection, row, ready.size + self.incoming.add(row.number, 0))
                if frame is None or is_retried(frame.state):
                    return None
                waits = frame.state in (FrameState.RECEIVED, FrameState.SIGNING)
                if waits and frame.novelty is not None:
                    return None  # its novelty threshold may change
                added = upload_response(connection, frame)
        except (errors.StoreError, errors.UnknownMap):
            raise
        except errors.SceneprintError as error:
            return UploadResult(None, error=error)
        self._renew(map_name, added.frame_id, ready.upload)
        reason = repair.without_loss(added.reason)
        return UploadResult(added.model_copy(update={"reason": reason}))

    def _renew(self, map_name: str, frame_id: str, upload: Upload) -> None:
        """Replace the lost upload of a frame."""
        left = repair.take_upload(self._store, map_name, frame_id, upload.data)
        if left:
            garbage_collection.collect_blobs(self._store, left)

    def _write(
        self, row: MapRow, ready: dict[int, _Prepared], results: list[UploadResult | None],
        once: IdempotentRequest | None, fence: Callable[[Connection], None] | None,
    ) -> tuple[list[UploadResult | None], bool]:  # fmt: skip
        """Store the uploads that have no result yet.

        Parameters
        ----------
        row : map, as read before decoding
        ready : decoded uploads by their place

        Returns
        -------
        outcomes : results of all uploads
        replayed : whether an earlier request stored them
        """
        self._store.database.require_writable()  # check this before blobs are written
        todo = {i: one for i, one in ready.items() if results[i] is None}
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
                if request.left:
                    garbage_collection.collect_deleted_blobs(self._store, request.left)
                return written

    def _insert_single(self, row: MapRow, request: _Request) -> UploadResult | None:
        """Insert one new frame in one round trip to PostgreSQL, together with concurrent ones.

        Return None on SQLite, which has no round trips, and if the frame needs more statements.
        """
        [one] = request.todo.values()
        if self._store.database.is_sqlite or one.upload.frame_id is not None:
            return None
        if row.number in self._writes:  # earlier uploads wait for the map
            return None
        new = _new_frame(row, one, request.once)
        if not self._new_frames.receive(new):
            return None
        # a deletion may have removed the blob before the commit; a worker that misses it retries
        self._store.blobs.ensure(one.blob, one.upload.data)
        return _new_result(new)

    def _store_all(
        self, row: MapRow, request: _Request, connection: Connection
    ) -> tuple[list[UploadResult | None], bool] | None:
        """Store uploads in a transaction; return None if a blob or the map was deleted."""
        if request.fence is not None:
            request.fence(connection)
        if not all(map(self._store.blobs.holds, request.blobs)):
            return None  # check this first, since the frame of a replay may need the blob
        if request.once is not None:
            now = find_map(connection, row.name)
            if now.number != row.number:
                return None
            before = _before(connection, now, request.once)
            if before is not None:
                request.left[:] = request.blobs
                return list(before), True
        request.left.clear()
        written = _insert_new(connection, row, request.todo)
        for i, one in request.todo.items():
            if i in written:
                continue
            now = find_map(connection, row.name)
            if now.number != row.number:
                return None
            written[i] = _store_one(connection, now, one, request.left)
        outcomes = [written.get(i, one) for i, one in enumerate(request.results)]
        if request.once is not None and not any(
            one is not None and isinstance(one.error, errors.QuotaExceeded) for one in outcomes
        ):  # a repeated request may succeed
            stored = [_stored_outcome(one) for one in outcomes if one is not None]
            request.once.store(connection, {"frames": stored})
        return outcomes, False

    def _grouping(self, row: MapRow) -> Grouping:
        """Return the group of writes to a map that are committed together; SQLite has one group."""
        key = None if self._store.database.is_sqlite else row.number
        with self._guard:
            group = self._writes.get(key)
            if group is None:
                group = self._writes[key] = Grouping(self._store.database, key)
            return group


def _before(
    connection: Connection, row: MapRow, once: IdempotentRequest | None
) -> list[UploadResult] | None:
    """Return the results of an earlier identical request; None without one."""
    data = None if once is None else once.stored_result(connection)
    return None if data is None else replayed(connection, row, data)


def _new_frame(row: MapRow, ready: _Prepared, once: IdempotentRequest | None = None) -> NewFrame:
    """Return the row of a frame that may be new.

    With `once`, on PostgreSQL, the same statement stores the result for the idempotency key.
    """
    frame_id = uuid.uuid4().hex
    outcome = None
    if once is not None:
        outcome = once.columns({"frames": [{"frame_id": frame_id, "new": True}]})
    return NewFrame(row, ready.columns, ready.upload.priority, outcome, frame_id)


def _new_result(new: NewFrame) -> UploadResult:
    """Return the result of an upload whose frame was inserted."""
    added = Added(
        frame_id=new.frame_id, job_id=new.job_id, state=FrameState.RECEIVED, reason=None,
        samples=SampleRange.model_validate(new.values["samples"]),
        has_pose=new.values["pose"] is not None,
    )  # fmt: skip
    return UploadResult(added, new=True)


def _insert_new(
    connection: Connection, row: MapRow, todo: dict[int, _Prepared]
) -> dict[int, UploadResult]:
    """Insert new frames, and return their results by index; see `_store_one` for the others."""
    new = {i: _new_frame(row, one) for i, one in todo.items() if one.upload.frame_id is None}
    ids = receive_frames(connection, list(new.values()))
    return {i: _new_result(one) for i, one in new.items() if one.frame_id in ids}


def _store_one(
    connection: Connection, row: MapRow, ready: _Prepared, left: list[str]
) -> UploadResult:
    """Store an upload and return its result; add unused blobs to `left`."""
    upload = ready.upload
    try:  # repeats the search, since another upload may have been first
        frame = find_duplicate(connection, row, ready.content, ready.metadata, upload.frame_id)
    except errors.FrameConflict as error:
        left.append(ready.blob)
        return UploadResult(None, error=error)
    if frame is not None and not is_retried(frame.state):
        relax_novelty(connection, frame.number, upload.if_novel)
        left.append(ready.blob)
        return UploadResult(upload_response(connection, frame))
    new = frame is None or frame.state == FrameState.REDUNDANT
    # the quota counts a failed frame already, but the size of the upload may differ
    counted = 0 if frame is None or new else frame.bytes
    try:
        left.extend(make_room(connection, row, ready.size - counted, new=new))
    except errors.QuotaExceeded as error:
        left.append(ready.blob)
        return UploadResult(None, error=error)
    if frame is None:
        frame = add_frame(connection, row.number, ready.columns, upload.frame_id)
    else:  # retry it
        left.append(frame.blob)  # the new upload may have another packing
        frame = renew_frame(connection, frame.number, ready.blob_columns)
    job = enqueue(connection, "sign", frame.number, upload.priority)
    record_event(connection, "frame.received", row.name, frame.id, job.id)
    return UploadResult(_added(frame, job.id), new=True)
