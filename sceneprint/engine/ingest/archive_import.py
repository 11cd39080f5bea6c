"""Import of archives: a request stores the file, and a worker adds its frames.

See `map_import` for maps in one file, and `recording_import` for recordings.

    chunks  --Receiver-->  a seekable blob  --Imports.begin-->  job  --Imports.handle-->  items
"""

from __future__ import annotations

import math
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from sqlalchemy import Connection, func, select

from sceneprint import errors
from sceneprint.engine.context import Context
from sceneprint.engine.ingest.uploads import Upload, UploadResult, Uploads, item_of
from sceneprint.engine.jobs.tasks import IsOver, LongJob, SliceResult, Swept, queue_task
from sceneprint.engine.upkeep.garbage_collection import collect_deleted_blobs
from sceneprint.formats.archive import BLOCK, Archive, Inflater, is_archive, open_archive
from sceneprint.formats.dataset import FrameReference
from sceneprint.formats.dataset.frame_reference import (
    FrameSequence,
    import_meta,
    numbered_sequences,
)
from sceneprint.formats.surface_file.reading import surface_format
from sceneprint.geometry.views import ViewParameters, view_parameters
from sceneprint.models import ModelParameters, parse_model
from sceneprint.store import queue
from sceneprint.store.blobs.folder import IncomingBlob
from sceneprint.store.database_errors import unusable
from sceneprint.store.deletion import make_room
from sceneprint.store.keys import IdempotentRequest
from sceneprint.store.maps import current_map, find_map, model_content
from sceneprint.store.opaque_ids import row_of
from sceneprint.store.tables import ARCHIVE, IMPORT_FILES, JobRow, MapRow, frames
from sceneprint.types import Intrinsics
from sceneprint_client.api import Job, Page
from sceneprint_client.api.frames import ImportItem, ImportOptions, UploadSummary, upload_summary
from sceneprint_client.formats import HEAD, format_at

# Frames of an archive are added in blocks. An error in one frame does not affect the others.
#
#     archive  --steps_of-->  Steps  --next_block-->  a block  --add_block-->  ImportItems
#
# Frames are added like uploads, so that a repeated slice recognises them as duplicates.

#: Maximum number of frames in one commit, and their maximum total size in bytes. A larger frame is
#: committed alone.
_AT_ONCE, _BYTES_AT_ONCE = 16, 128 << 20


@dataclass(frozen=True, eq=False)
class Step:
    """A frame of an archive, or the error that occurred when the archive was read."""

    name: str
    sequence: FrameSequence | None = None
    reference: FrameReference | None = None
    refused: errors.SceneprintError | None = None


def steps_of(archive: Archive, every: int, session: str | None = None) -> Iterator[Step]:
    """Yield a step for each error of an archive, then for every `every`-th frame of each sequence.

    The order is the same in each call. Without `session`, each sequence becomes its own session.
    """
    for name, reason in archive.refused:
        yield Step(name, refused=errors.UnreadableArchive(reason))
    for sequence in numbered_sequences(archive.sequences, session):
        for reference in sequence.frames[::every]:
            yield Step(archive.name_of(reference), sequence, reference)


def next_block(archive: Archive, steps: Sequence[Step], done: int) -> Sequence[Step]:
    """Return the next steps to add in one commit, at least one; the first `done` are complete."""
    count = size = 0
    for step in steps[done : done + _AT_ONCE]:
        size += 0 if step.reference is None else archive.size_of(step.reference)
        if count and size > _BYTES_AT_ONCE:
            break
        count += 1
    return steps[done : done + count]


def add_block(
    uploads: Uploads, task: LongJob, block: Sequence[tuple[str, Callable[[], Upload]]]
) -> list[ImportItem]:
    """Add frames in one commit, and return their results, which contain errors of single frames.

    Parameters
    ----------
    block : name and reading function of each frame

    Raises
    ------
    LostLease : If the job was cancelled.
    StoreError, Busy : If the store or the decoders cannot be used now; nothing was added.
    """
    outcomes: list[UploadResult | None] = []
    uploaded = []
    for _, read in block:
        try:
            uploaded.append(read())
            outcomes.append(None)
        except (errors.StoreError, errors.Busy):  # these are temporary, so repeat the slice
            raise
        except errors.SceneprintError as error:
            outcomes.append(UploadResult(None, error=error))
        except MemoryError:
            outcomes.append(_too_large())
    fence = partial(queue.check_held, held=task.job)
    rest = iter(_add_frames(uploads, task.of_map.name, uploaded, fence))
    return [
        import_item(name, outcome or next(rest))
        for (name, _), outcome in zip(block, outcomes, strict=True)
    ]


def _add_frames(
    uploads: Uploads, map_name: str, block: list[Upload], fence: Callable[[Connection], None]
) -> list[UploadResult]:
    """Add frames in one commit, or one by one if memory does not suffice; return their results."""
    if not block:
        return []
    try:
        return uploads.add_all(map_name, block, fence=fence)[0]
    except MemoryError:
        if len(block) == 1:
            return [_too_large()]
    return [_add_frames(uploads, map_name, [upload], fence)[0] for upload in block]


def _too_large() -> UploadResult:
    reason = "The frame needs more memory than a worker may use. Send a smaller frame."
    return UploadResult(None, error=errors.UnreadableFrame(reason))


def _upload(archive: Archive, step: Step, options: ImportOptions) -> Upload:
    try:
        if step.sequence is None or step.reference is None:
            raise step.refused or ValueError("neither a frame nor refused")
        meta = import_meta(step.reference, step.sequence, options)
        data = archive.data_of(step.reference)
    except errors.SceneprintError as error:
        raise type(error)(archive.message_of(error)) from error
    return Upload(data, meta, options.priority, options.if_novel)


def _summary_of(
    archive: Archive, steps: Sequence[Step], items: Sequence[dict[str, Any]], options: ImportOptions
) -> UploadSummary:
    """Return the summary of an import from the results `items` of its steps."""
    results = [ImportItem.model_validate(item) for item in items]
    without, frames = Counter[str](), 0
    for step, item in zip(steps, results, strict=True):
        if step.sequence is None:
            continue
        frames += 1
        if item.frame_id is None:
            without["refused"] += 1
        elif not item.has_pose:
            without[step.sequence.unposed if options.with_poses else "with_poses is false"] += 1
    notes = [sequence.note for sequence in archive.sequences if sequence.note]
    return upload_summary(
        frames, without, [item.samples for item in results if item.samples is not None], notes,
        lost=sum(sequence.lost for sequence in archive.sequences if options.with_poses),
    )  # fmt: skip


def import_item(name: str, outcome: UploadResult) -> ImportItem:
    """Convert the result of one upload to an item of an import."""
    item = item_of(outcome)
    own: dict[str, Any] = {"frame_id": None, "job_id": None}
    if item.frame is not None:
        own = item.frame.model_dump(include={"frame_id", "job_id", "samples", "has_pose"})
    return ImportItem(name=name, status=item.status, problem=item.problem, **own)


#: Job kind of an import, by the field `as` of the request.
KINDS = {"frames": "import", "map": "import-map", "recording": "import-bag"}
#: Seconds between removals of the archives of finished imports.
TIDY_S = 5.0
#: Maximum size of an inflated tar, as a multiple of the maximum size of an archive.
_UNPACKED = 4
#: Maximum number of ids in one statement.
_IDS_AT_ONCE = 500
#: Maximum number of pixels along the longer side of a rendered view.
_MOST_PIXELS = 640


class _FileBytes:
    """Filter that checks the format of a received map file or recording."""

    def __init__(self, name: str, *, is_map: bool) -> None:
        self._name, self._is_map, self._head, self._size = name, is_map, b"", 0

    def pieces(self, chunk: bytes) -> Iterator[bytes]:
        """Yield a chunk unchanged; raise InvalidRequest if the file is an archive."""
        if len(self._head) < HEAD:
            self._head += chunk[: HEAD - len(self._head)]
            if self._is_map and len(self._head) >= BLOCK and is_archive(self._head):
                raise errors.InvalidRequest(
                    "The file is an archive, but a map must be a single cloud or mesh. Unpack it, "
                    "or omit `as` to import the frames in it.",
                    (("as", "the file is an archive"),),
                )
        self._size += len(chunk)
        yield chunk

    def end(self) -> Iterator[bytes]:
        """Check the format of the complete file; yield nothing.

        Raises
        ------
        UnreadableCloud, UnreadableArchive : If the file is not a map, or not a recording.
        """
        form = format_at(self._head, "recording")
        if self._is_map:
            surface_format(self._head, self._name, self._size)
        elif form is None or form.name not in ("mcap", "rosbag1"):
            raise errors.UnreadableArchive(
                f"{self._name} is neither an MCAP file nor a ROS 1 bag. To send a rosbag2 folder "
                "or database, use `sceneprint upload MAP FOLDER`."
            )
        yield from ()


class Receiver:
    """An incoming file; see `Imports.receive`.

    Parameters
    ----------
    blob : blob to write; compressed tars are inflated
    source : filter that converts received bytes to stored bytes
    reserve : function that reserves bytes in the quota of the map before they are written
    """

    def __init__(
        self, blob: IncomingBlob, source: Inflater | _FileBytes, reserve: Callable[[int], None]
    ) -> None:
        self._blob, self._source, self._reserve = blob, source, reserve

    def write(self, chunk: bytes) -> None:
        """Write the next chunk of the file.

        Raises
        ------
        UnreadableArchive : If the file is damaged, too large, or not an archive.
        UnreadableCloud : If the file is not a map.
        QuotaExceeded : If the map has no room for the file.
        StoreFull, UnusableStore : If the blob cannot be written.
        """
        self._write(self._source.pieces(chunk))

    def end(self) -> queue.JobFile:
        """Write the blob to disk, and return its record; see `write` for errors."""
        self._write(self._source.end())
        return queue.JobFile(
            ARCHIVE, self._blob.keep(), self._blob.size, "application/octet-stream"
        )

    def _write(self, pieces: Iterator[bytes]) -> None:
        for piece in pieces:
            self._reserve(len(piece))
            self._blob.write(piece)


def states_of_import(connection: Connection, job: JobRow) -> Counter[str]:
    """Return the number of frames of an import in each state."""
    items = queue.items_of(connection, job.number)
    ids = [item["frame_id"] for item in items if item["frame_id"] is not None]
    counts = Counter[str]()
    for start in range(0, len(ids), _IDS_AT_ONCE):
        own = frames.c.map_number == job.map_number, frames.c.id.in_(ids[start:][:_IDS_AT_ONCE])
        statement = select(frames.c.state, func.count()).where(*own).group_by(frames.c.state)
        for state, count in connection.execute(statement):
            counts[state] += count
    return counts


def view_parameters_of(model: ModelParameters, options: ImportOptions) -> ViewParameters:
    """Return the sensor parameters for views of an imported map; a large camera is scaled down.

    Raise InvalidRequest if the options contain a camera, but the model is for 360-degree scans.
    """
    k = options.camera
    camera = None
    if k is not None:
        if not isinstance(view_parameters(model).camera, Intrinsics):
            raise errors.InvalidRequest(
                "The model of the map is for 360-degree scans, so `camera` would have no effect. "
                "Omit it, or import into a map with the model `depth`.",
                (("camera", "does not apply to a map of scans"),),
            )
        n = math.ceil(max(k.width, k.height) / _MOST_PIXELS)
        camera = Intrinsics(
            k.width // n, k.height // n, k.fx / n, k.fy / n, (k.cx + 0.5) / n - 0.5,
            (k.cy + 0.5) / n - 0.5,
        )  # fmt: skip
    return view_parameters(model, camera, options.heights or None)


class Imports:
    """Imports of archives; also receives and queues maps and recordings."""

    def __init__(self, context: Context, uploads: Uploads) -> None:
        self._store, self._bell, self._uploads = context.store, context.bell, uploads
        self._most = context.settings.max_import_bytes
        self._tidied = time.monotonic()

    @contextmanager
    def receive(self, map_name: str, options: ImportOptions) -> Iterator[Receiver]:
        """Yield a receiver for a file in chunks, which is removed unless `Receiver.end` is called.

        Received bytes count against the quota of the map until the context ends. Call `begin`
        within the context.

        Raises
        ------
        UnknownMap : If the map does not exist.
        InvalidRequest : If the options contain a camera, but the map is for 360-degree scans.
        ReadOnlyStore, StoreFull, UnusableStore : If the store cannot be written.
        """
        with self._store.database.read() as connection:
            row = find_map(connection, map_name)
            if options.camera is not None:
                content = model_content(connection, row.model_id)
                view_parameters_of(parse_model(content, row.model_id).parameters, options)
        self._store.database.require_writable()
        incoming, reserved = self._uploads.incoming, 0

        def reserve(size: int) -> None:
            nonlocal reserved
            reserved += size
            self._require_room(row, incoming.add(row.number, size))

        try:
            with self._store.blobs.incoming() as blob:
                if options.as_ == "frames":
                    yield Receiver(blob, Inflater(_UNPACKED * self._most), reserve)
                else:
                    source = _FileBytes(options.name, is_map=options.as_ == "map")
                    yield Receiver(blob, source, reserve)
        finally:
            incoming.add(row.number, -reserved)

    def _require_room(self, row: MapRow, incoming: int) -> None:
        """Make room for incoming bytes by purging tombstones, or raise QuotaExceeded."""
        with self._store.database.read() as connection:
            row = current_map(connection, row)
        if row.quota_bytes is None or row.used_bytes + incoming <= row.quota_bytes:
            return
        with self._store.database.write(map_number=row.number) as connection:
            unused = make_room(connection, current_map(connection, row), incoming, new=False)
        collect_deleted_blobs(self._store, unused)

    def begin(
        self, map_name: str, archive: queue.JobFile, options: ImportOptions,
        once: IdempotentRequest | None = None,
    ) -> tuple[Job, bool]:  # fmt: skip
        """Queue the job that imports a received file.

        Returns
        -------
        job : job of the import
        replayed : whether an earlier request with the key of `once` queued the job

        Raises
        ------
        UnknownMap, IdempotencyConflict, QuotaExceeded : See `queue_task`; the archive is removed.
        Conflict : If an import of the same file has just ended and removed the file.
        """
        data = options.model_dump(mode="json", by_alias=True)
        try:
            job, again = queue_task(
                self._store,
                self._bell,
                KINDS[options.as_],
                map_name,
                data,
                options.priority,
                [archive],
                once,
            )
        except Swept as error:
            raise errors.Conflict(
                "Another import of the same file ended during the transfer, and removed the file. "
                "Send the file again."
            ) from error
        except errors.SceneprintError:
            collect_deleted_blobs(self._store, [archive.blob])
            raise
        if again:
            collect_deleted_blobs(self._store, [archive.blob])
        return job, again

    def items(
        self, map_name: str, job_id: str, cursor: str | None = None, limit: int = 100
    ) -> Page[ImportItem]:
        """Return a page of the results of an import, in the order of its frames or views.

        Raises
        ------
        UnknownMap, UnknownJob : If the map or import does not exist.
        InvalidRequest : If the service did not issue the cursor.
        """
        first = row_of(cursor) or 0
        with self._store.database.read() as connection:
            row, job = find_map(connection, map_name), queue.find_job(connection, job_id)
            if job.kind not in KINDS.values() or job.map_number != row.number:
                raise queue.unknown_job(job_id)
            rows = queue.items_of(connection, job.number, first, limit + 1)
        more = str(first + limit) if len(rows) > limit else None
        return Page[ImportItem](items=[ImportItem(**row) for row in rows[:limit]], next_cursor=more)

    def handle(self, task: LongJob, is_over: IsOver) -> SliceResult:
        """Run a slice of an import, which adds at least one block of frames; return its results.

        Raise UnreadableArchive if the archive is missing, or is unreadable and was therefore
        removed.
        """
        options = ImportOptions.model_validate(task.data)
        with self._store.database.read() as connection:
            file = queue.files_of(connection, task.job.number).get(ARCHIVE)
        if file is None:
            raise errors.UnreadableArchive(
                "The archive was removed when its import failed or was cancelled. Send it again."
            )
        try:
            with self._open(file, options.name) as archive:
                return self._slice(task, archive, options, is_over)
        except errors.UnreadableArchive:  # a retry would fail too, so free the space
            with self._store.database.write() as connection:
                number = task.job.number
                unused = queue.remove_parts(connection, number, items=False, files=IMPORT_FILES)
            collect_deleted_blobs(self._store, unused)
            raise

    def tidy(self) -> int:
        """Remove the archives of finished imports, at most every TIDY_S seconds; return their
        number.

        Raise UnusableStore if the store cannot be written; a later call retries.
        """
        if time.monotonic() - self._tidied < TIDY_S:
            return 0
        self._tidied = time.monotonic()
        with self._store.database.read() as connection:  # usually none exist: avoid a write lock
            if not queue.finished_with_file(connection, ARCHIVE):
                return 0
        with self._store.database.write() as connection:
            unused = [
                blob
                for number in queue.finished_with_file(connection, ARCHIVE)
                for blob in queue.remove_parts(connection, number, items=False, files=IMPORT_FILES)
            ]
        collect_deleted_blobs(self._store, unused)
        return len(unused)

    @contextmanager
    def _open(self, file: queue.JobFile, name: str) -> Iterator[Archive]:
        try:
            opened = self._store.blobs.open(file.blob)
        except FileNotFoundError as error:
            raise errors.UnreadableArchive(
                "The archive is missing from the store. Send it again."
            ) from error
        except OSError as error:
            raise unusable("The archive cannot be read", error) from error
        try:
            with opened, open_archive(opened, Path(tempfile.gettempdir()), name) as archive:
                yield archive
        except OSError as error:
            raise unusable("The archive cannot be unpacked", error) from error

    def _slice(
        self, task: LongJob, archive: Archive, options: ImportOptions, is_over: IsOver
    ) -> SliceResult:
        steps = list(steps_of(archive, options.every, options.session))
        progress = {"done": 0, "received": 0, "there": 0, "refused": 0} | task.progress
        progress["total"] = len(steps)
        items: list[dict[str, Any]] = []
        while progress["done"] < len(steps) and (not items or not is_over()):
            block = next_block(archive, steps, progress["done"])
            reads = [(step.name, partial(_upload, archive, step, options)) for step in block]
            for item in add_block(self._uploads, task, reads):
                items.append(item.model_dump(mode="json"))
                progress[{202: "received", 200: "there"}.get(item.status, "refused")] += 1
            progress["done"] += len(block)
        over = progress["done"] >= len(steps)
        result: dict[str, Any] | None = None
        if over:
            counts = {name: progress[name] for name in ("received", "there", "refused")}
            with self._store.database.read() as connection:
                before = queue.items_of(connection, task.job.number)
            summary = _summary_of(archive, steps, [*before, *items], options)
            result = {
                "sequences": len(archive.sequences), **counts, "ignored": archive.ignored,
                "summary": summary.model_dump(mode="json"),
            }  # fmt: skip
        return SliceResult(
            over, progress, items, drop=[ARCHIVE] if over else (), result=result,
            event="import.done" if over else None,
        )  # fmt: skip
