"""Uploads into the store: checked, durable, and queued, many in one commit.

    Upload  --read_upload-->  decoded  --Store.blobs-->  durable blob  --add_frame-->  Added

When an upload is answered, nothing can lose it. The disk is waited for by many at once.
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
from sceneprint.engine.ingest.frame_decoder import columns, content_id, read_upload
from sceneprint.engine.ingest.write_groups import Grouping, NewFrames
from sceneprint.engine.serializers import sample_range_of
from sceneprint.engine.upkeep import garbage_collection, repair
from sceneprint.formats.sample_range import sample_range
from sceneprint.store import Store
from sceneprint.store.deletion import make_room
from sceneprint.store.events import record_event
from sceneprint.store.frames import loosen, renew_frame
from sceneprint.store.keys import IdempotentRequest, Overtaken
from sceneprint.store.maps import (
    add_frame,
    find_map,
    frames_of_content,
    living_frame,
    require_room,
)
from sceneprint.store.new_frames import NewFrame, receive_frames
from sceneprint.store.queue import enqueue, job_ids_of
from sceneprint.store.tables import FrameRow, MapRow, frame_row, frames
from sceneprint.store.wakeup import Wakeup
from sceneprint_client.api import Added, FrameMeta, FrameState
from sceneprint_client.api.frames import (
    BatchItem,
    SampleRange,
    check_frame_id,
    problem_of,
)

# Who an upload is: the frame that is there, a frame of its own, or a contradiction.

#: What to call a column when it differs.
_FIELDS = {
    "pose_parent": "pose.parent_frame", "base": "T_base_sensor", "content_id": "content",
    "cloud": "units_per_metre",
}  # fmt: skip
#: Columns that do not tell uploads apart: the same content under another name is the frame that is
#: there, and keeps the name that it came with; samples are content.
_LABELS = ("name", "sequence", "samples")


def find_duplicate(
    connection: Connection, row: MapRow, content: str, known: dict[str, Any],
    frame_id: str | None = None,
) -> FrameRow | None:  # fmt: skip
    """The frame that an upload is of; None where the map has none yet.

    Parameters
    ----------
    known : its metadata, by column
    frame_id : that the caller wants for it; None: any frame of that content is it

    Raises
    ------
    FrameConflict : there is one, with other content or metadata.
    """
    if frame_id is not None:
        frame = living_frame(connection, row.number, frame_id)
        if frame is None:
            return None
        differing = _differing(frame, {"content_id": content, **known})
        if differing:
            raise errors.FrameConflict(
                f"Frame {frame.id} of map {row.name} already exists with a different "
                f"{', '.join(differing)}. Delete it first, send it unchanged, or use another id."
            )
        return frame
    found = frames_of_content(connection, row.number, content)
    for frame in found:
        if not _differing(frame, known):
            return frame
    if found:
        raise errors.FrameConflict(
            f"Frame {found[0].id} has the same content, but a different "
            f"{', '.join(_differing(found[0], known))}. A map stores the same content once: "
            "delete that frame first, send it unchanged, or PUT it under its own id."
        )
    return None


def _sent_value(frame: FrameRow, name: str) -> Any:
    """Return a column of a frame as it was sent, before a join moved its pose."""
    if frame.sent_parent is not None and name in ("pose", "pose_parent"):
        return frame.sent_pose if name == "pose" else frame.sent_parent
    return getattr(frame, name)


def _differing(frame: FrameRow, known: dict[str, Any]) -> list[str]:
    return [
        _FIELDS.get(name, name)
        for name, value in known.items()
        if name not in _LABELS
        and _given_value(name, _sent_value(frame, name)) != _given_value(name, value)
    ]


def _given_value(name: str, value: Any) -> Any:
    """What of a column the caller has said: not how a cloud was packed, nor what was found in it.

    Its viewpoint is part of its content.
    """
    return value["units_per_metre"] if name == "cloud" and value is not None else value


def is_retried(state: FrameState) -> bool:
    """Whether an upload of the same gives a frame another try.

    It broke down every time, or was near to a frame that may be gone since.
    """
    return state in (FrameState.FAILED, FrameState.REDUNDANT)


# What is remembered of uploads that are to take effect once, and what is told of them again.


@dataclass(frozen=True)
class UploadResult:
    """What came of an upload.

    Parameters
    ----------
    added : the frame and its job; None where it was refused
    new : False where it was there already, and there is nothing to be done
    error : why it was refused
    """

    added: Added | None
    new: bool = False
    error: errors.SceneprintError | None = None

    @property
    def taken(self) -> Added:
        """The frame and its job; raises `error` where there is none."""
        if self.added is None:
            raise self.error or ValueError("neither taken nor refused")
        return self.added


def item_of(outcome: UploadResult) -> BatchItem:
    """What came of one upload of many."""
    if outcome.error is not None:
        problem = problem_of(outcome.error)
        return BatchItem(status=problem.status, frame=None, problem=problem)
    return BatchItem(status=202 if outcome.new else 200, frame=outcome.taken, problem=None)


def upload_response(connection: Connection, frame: FrameRow) -> Added:
    """A frame as uploads are answered."""
    job_id = job_ids_of(connection, [frame.number])[frame.number]
    return _added(frame, job_id, frame.reason)


def _added(frame: FrameRow, job_id: str, reason: str | None = None) -> Added:
    return Added(
        frame_id=frame.id, job_id=job_id, state=frame.state, reason=reason,
        samples=sample_range_of(frame), has_pose=frame.pose is not None,
    )  # fmt: skip


def replayed(
    connection: Connection, row: MapRow, data: dict[str, Any]
) -> list[UploadResult] | None:
    """What came of uploads, as it is now; None where the map was deleted and made anew since."""
    found = []
    for one in data["frames"]:
        if "error" in one:
            found.append(UploadResult(None, error=_error(one)))
            continue
        asked = select(frames).where(
            frames.c.id == one["frame_id"], frames.c.map_number == row.number
        )
        frame = connection.execute(asked).mappings().first()
        if frame is None:
            return None
        found.append(UploadResult(upload_response(connection, frame_row(frame)), one["new"]))
    return found


def _stored_outcome(outcome: UploadResult) -> dict[str, Any]:
    """What came of an upload, as JSON that is remembered."""
    if outcome.added is not None:
        return {"frame_id": outcome.added.frame_id, "new": outcome.new}
    error = outcome.error
    fields = error.fields if isinstance(error, errors.InvalidRequest) else ()
    return {"error": type(error).__name__, "detail": str(error), "fields": fields}


def _error(kept: dict[str, Any]) -> errors.SceneprintError:
    kind: type[errors.SceneprintError] = getattr(errors, kept["error"])
    if issubclass(kind, errors.InvalidRequest):
        return kind(kept["detail"], tuple((place, reason) for place, reason in kept["fields"]))
    return kind(kept["detail"])


@dataclass(frozen=True, eq=False)
class Upload:
    """A frame as it is sent.

    Parameters
    ----------
    data : a depth image as PNG or NPY, or a point cloud: see `sceneprint.formats.points`
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

    @property
    def size(self) -> int:
        """Bytes of the upload."""
        return len(self.upload.data)

    @property
    def of_blob(self) -> dict[str, Any]:
        """Columns that follow from the bytes and from how they were sent."""
        return {"blob": self.blob, "bytes": self.size, "novelty": self.upload.if_novel}

    @property
    def columns(self) -> dict[str, Any]:
        """Columns of a new frame; see `add_frame`."""
        return {"content_id": self.content, **self.of_blob, **self.known}


@dataclass(frozen=True, eq=False)
class _Request:
    """Uploads that are stored together.

    Parameters
    ----------
    todo : those of which it is not known yet what comes of them, by their place
    known, once, fence : see `Uploads.add_all`
    left : blobs that may be of no use, of the last try
    """

    todo: dict[int, _Prepared]
    known: list[UploadResult | None]
    once: IdempotentRequest | None
    fence: Callable[[Connection], None] | None
    left: list[str] = field(default_factory=list)

    @cached_property
    def blobs(self) -> dict[str, bytes]:
        """What has to be durable first."""
        return {one.blob: one.upload.data for one in self.todo.values()}

    @property
    def is_single(self) -> bool:
        """Whether it is one upload, of which nothing but the frame is to be written."""
        return len(self.known) == len(self.todo) == 1 and self.fence is None


class IncomingBytes:
    """Bytes of archives that this process is receiving for each map; no row counts them yet."""

    def __init__(self) -> None:
        self._sizes, self._guard = Counter[int](), threading.Lock()

    def add(self, map_number: int, size: int) -> int:
        """Add bytes, or remove them, and return how many the map has now."""
        with self._guard:
            self._sizes[map_number] += size
            return self._sizes[map_number]


class Uploads:
    """Takes frames into maps; safe to share between threads.

    Parameters
    ----------
    store, bell : see there
    """

    def __init__(self, store: Store, bell: Wakeup) -> None:
        self._store, self._bell = store, bell
        # of each map that is written to, as long as somebody writes to it
        self._writes = WeakValueDictionary[int | None, Grouping]()
        self._guard = threading.Lock()
        self._new_frames = NewFrames(store.database)
        self.incoming = IncomingBytes()

    def add(
        self, map_name: str, upload: Upload, once: IdempotentRequest | None = None
    ) -> tuple[UploadResult, bool]:
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
        InvalidRequest : the frame id is not valid; or see `read_upload`.
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
        self, map_name: str, uploads: Sequence[Upload], once: IdempotentRequest | None = None,
        fence: Callable[[Connection], None] | None = None,
    ) -> tuple[list[UploadResult], bool]:  # fmt: skip
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
            for upload, outcome in zip(uploads, before, strict=True):
                if outcome.added is not None:  # it may have been told that it was not stored
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
            found = self._settled(map_name, ready[i])
            if found is not None:
                outcomes[i] = found
                if once is None or found.added is None:
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
        content = content_id(read)
        blob = hashlib.sha256(upload.data).hexdigest()
        samples = {
            **sample_range(read.frame).model_dump(), "trusted": upload.meta.trust_depth,
        }  # fmt: skip
        known = {
            **columns(upload.meta, read.frame.pose, read.base),
            "cloud": read.cloud,
            "samples": samples,
        }
        return _Prepared(upload, blob, content, known)

    def _settled(self, map_name: str, ready: _Prepared) -> UploadResult | None:
        """What comes of an upload for which nothing has to be written; None: it has to be."""
        try:
            with self._store.database.read() as connection:
                row = find_map(connection, map_name)
                frame = find_duplicate(
                    connection, row, ready.content, ready.known, ready.upload.frame_id
                )
                if frame is None:  # what has no room is not even written to the disk
                    require_room(connection, row, ready.size + self.incoming.add(row.number, 0))
                if frame is None or is_retried(frame.state):
                    return None
                waits = frame.state in (FrameState.RECEIVED, FrameState.SIGNING)
                if waits and frame.novelty is not None:
                    return None  # its condition may have to be loosened
                there = upload_response(connection, frame)
        except (errors.StoreError, errors.UnknownMap):
            raise
        except errors.SceneprintError as error:
            return UploadResult(None, error=error)
        self._renew(map_name, there.frame_id, ready.upload)
        reason = repair.without_loss(there.reason)
        return UploadResult(there.model_copy(update={"reason": reason}))

    def _renew(self, map_name: str, frame_id: str, upload: Upload) -> None:
        """Let what came take the place of an upload that was lost."""
        left = repair.take_upload(self._store, map_name, frame_id, upload.data)
        if left:
            garbage_collection.collect_blobs(self._store, left)

    def _write(
        self, row: MapRow, ready: dict[int, _Prepared], known: list[UploadResult | None],
        once: IdempotentRequest | None, fence: Callable[[Connection], None] | None,
    ) -> tuple[list[UploadResult | None], bool]:  # fmt: skip
        """Store those uploads of which it is not known yet what comes of them.

        Parameters
        ----------
        row : of the map, as it was before they were decoded
        ready, known, once, fence : see `add_all`

        Returns
        -------
        outcomes : of all
        replayed : whether they are those of an earlier request
        """
        self._store.database.require_writable()  # before a blob to which nothing could refer
        todo = {i: one for i, one in ready.items() if known[i] is None}
        request = _Request(todo, known, once, fence)
        blobs = request.blobs
        while True:
            try:
                for data in blobs.values():
                    self._store.blobs.put(data)
                came_of = self._received(row, request) if request.is_single else None
                if came_of is not None:
                    return [came_of], False
                found = self._grouping(row).run(partial(self._store_all, row, request))
                if found is None:
                    with self._store.database.read() as connection:
                        row = find_map(connection, row.name)
            except Overtaken:
                continue
            except errors.SceneprintError:
                with suppress(errors.UnusableStore):  # leave nothing, on a full disk least of all
                    garbage_collection.collect_blobs(self._store, list(blobs))
                raise
            if found is not None:
                if request.left:
                    garbage_collection.collect_deleted_blobs(self._store, request.left)
                return found

    def _received(self, row: MapRow, request: _Request) -> UploadResult | None:
        """Take one new frame, as most uploads are, in one round trip to PostgreSQL, with those that
        come meanwhile.

        None where more has to be found out or written, and on SQLite, whose transactions cost no
        round trip.
        """
        [one] = request.todo.values()
        if self._store.database.is_sqlite or one.upload.frame_id is not None:
            return None
        if row.number in self._writes:  # others wait for the map already: behind them is its place
            return None
        new = _new_frame(row, one, request.once)
        if not self._new_frames.receive(new):
            return None
        # a deletion may have removed it before the commit, and from now on none does; a worker
        # that missed it meanwhile tries again
        self._store.blobs.ensure(one.blob, one.upload.data)
        return _new_result(new)

    def _store_all(
        self, row: MapRow, request: _Request, connection: Connection
    ) -> tuple[list[UploadResult | None], bool] | None:
        """As `_write`, in a transaction; None where a blob or the map is gone."""
        if request.fence is not None:
            request.fence(connection)
        if not all(map(self._store.blobs.holds, request.blobs)):
            return None  # a deletion has removed one, which an earlier request may refer to, too
        if request.once is not None:
            now = find_map(connection, row.name)
            if now.number != row.number:
                return None
            before = _before(connection, now, request.once)
            if before is not None:
                request.left[:] = request.blobs
                return list(before), True
        request.left.clear()
        written = _received_together(connection, row, request.todo)
        for i, one in request.todo.items():
            if i in written:
                continue
            now = find_map(connection, row.name)
            if now.number != row.number:
                return None
            written[i] = _stored(connection, now, one, request.left)
        outcomes = [written.get(i, one) for i, one in enumerate(request.known)]
        if request.once is not None:
            _keep(connection, request.once, [one for one in outcomes if one is not None])
        return outcomes, False

    def _grouping(self, row: MapRow) -> Grouping:
        """Where uploads wait that may be committed together: of a map, in SQLite of all."""
        key = None if self._store.database.is_sqlite else row.number
        with self._guard:
            found = self._writes.get(key)
            if found is None:
                found = self._writes[key] = Grouping(self._store.database, key)
            return found


def _before(
    connection: Connection, row: MapRow, once: IdempotentRequest | None
) -> list[UploadResult] | None:
    """What came of the same request before."""
    data = None if once is None else once.found(connection)
    return None if data is None else replayed(connection, row, data)


def _keep(connection: Connection, once: IdempotentRequest, came: list[UploadResult]) -> None:
    """Remember what came of a request; what had no room may have it when it is sent again."""
    if not any(isinstance(one.error, errors.QuotaExceeded) for one in came):
        once.keep(connection, {"frames": [_stored_outcome(one) for one in came]})


def _new_frame(row: MapRow, ready: _Prepared, once: IdempotentRequest | None = None) -> NewFrame:
    """Return the row of a frame that its map may lack.

    With `once`, on PostgreSQL alone, the same statement stores the outcome under the request's
    idempotency key.
    """
    frame_id = uuid.uuid4().hex
    outcome = None
    if once is not None:
        outcome = once.columns({"frames": [{"frame_id": frame_id, "new": True}]})
    return NewFrame(row, ready.columns, ready.upload.priority, outcome, frame_id)


def _new_result(new: NewFrame) -> UploadResult:
    """What came of an upload whose frame was taken."""
    added = Added(
        frame_id=new.frame_id, job_id=new.job_id, state=FrameState.RECEIVED, reason=None,
        samples=SampleRange.model_validate(new.values["samples"]),
        has_pose=new.values["pose"] is not None,
    )  # fmt: skip
    return UploadResult(added, new=True)


def _received_together(
    connection: Connection, row: MapRow, todo: dict[int, _Prepared]
) -> dict[int, UploadResult]:
    """Uploads of new frames that were taken, by their place; see `_stored` for the others."""
    new = {i: _new_frame(row, one) for i, one in todo.items() if one.upload.frame_id is None}
    ids = receive_frames(connection, list(new.values()))
    return {i: _new_result(one) for i, one in new.items() if one.frame_id in ids}


def _stored(connection: Connection, row: MapRow, ready: _Prepared, left: list[str]) -> UploadResult:
    """What comes of an upload; blobs that are of no use any more are added to `left`."""
    upload = ready.upload
    try:  # once more: another upload may have been first
        frame = find_duplicate(connection, row, ready.content, ready.known, upload.frame_id)
    except errors.FrameConflict as error:
        left.append(ready.blob)
        return UploadResult(None, error=error)
    if frame is not None and not is_retried(frame.state):
        loosen(connection, frame.number, upload.if_novel)
        left.append(ready.blob)
        return UploadResult(upload_response(connection, frame))
    new = frame is None or frame.state == FrameState.REDUNDANT
    # a failed one is counted already, and may come packed otherwise
    held = 0 if frame is None or new else frame.bytes
    try:
        left.extend(make_room(connection, row, ready.size - held, new=new))
    except errors.QuotaExceeded as error:
        left.append(ready.blob)
        return UploadResult(None, error=error)
    if frame is None:
        frame = add_frame(connection, row.number, ready.columns, upload.frame_id)
    else:  # it was given up, and somebody asks for another try
        left.append(frame.blob)  # it was packed otherwise
        frame = renew_frame(connection, frame.number, ready.of_blob)
    job = enqueue(connection, "sign", frame.number, upload.priority)
    record_event(connection, "frame.received", row.name, frame.id, job.id)
    return UploadResult(_added(frame, job.id), new=True)
