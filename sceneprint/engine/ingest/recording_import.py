"""Import of the keyframes of a ROS recording.

    file  --read-->  outline and index  --add-->  items

The first slice scans the recording, and stores an index of the selected frames. The other slices
read single messages. In all slices, a confined process reads the file.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

from sceneprint.decoders.pool import inheritable
from sceneprint.decoders.recording_decoder import RecordingDecoder, RecordingIndex
from sceneprint.engine.context import Context
from sceneprint.engine.ingest.archive_import import add_block
from sceneprint.engine.ingest.uploads import Upload, Uploads
from sceneprint.engine.jobs.tasks import SLICE_S, IsOver, LongJob, SliceResult
from sceneprint.errors import UnreadableArchive
from sceneprint.formats.recording.bag import require_rosbags
from sceneprint.store import queue
from sceneprint.store.database_errors import unusable
from sceneprint.store.tables import ARCHIVE, IMPORT_FILES
from sceneprint_client.api import FrameMeta
from sceneprint_client.api.frames import ImportItem, ImportOptions, upload_summary

_INDEX = IMPORT_FILES[1]
#: Maximum number of frames in one commit, and their maximum total size in bytes.
_AT_ONCE, _BYTES_AT_ONCE = 16, 128 << 20


class RecordingImporter:
    """Handler of jobs that import ROS recordings."""

    def __init__(self, context: Context, uploads: Uploads) -> None:
        # limit of processor time, which leaves a quarter of the timeout for writing
        self._seconds = 0.75 * context.settings.job_timeout_s
        self._store, self._uploads = context.store, uploads

    def __call__(self, task: LongJob, is_over: IsOver) -> SliceResult:
        """Scan the recording, or add one or more blocks of its frames; return the slice."""
        require_rosbags()
        options = ImportOptions.model_validate(task.data)
        with self._store.database.read() as connection:
            files = queue.files_of(connection, task.job.number)
        if ARCHIVE not in files:
            raise UnreadableArchive(
                "The recording was removed when its import failed or was cancelled. Send it again."
            )
        if _INDEX not in files:
            with self._decoder(files[ARCHIVE], options.name) as decoder:
                return self._read(decoder, options)
        with self._store.blobs.open(files[_INDEX].blob) as stored:
            index = RecordingIndex.parse(stored.read())
        if index.outline.problem is not None:
            raise UnreadableArchive(index.outline.problem)
        assert index.topic is not None
        with self._decoder(files[ARCHIVE], options.name) as decoder:
            read = partial(decoder.frame, index.topic)
            return self._add(task, options, read, index, is_over)

    @contextmanager
    def _decoder(self, file: queue.JobFile, name: str) -> Iterator[RecordingDecoder]:
        try:
            source = self._store.blobs.open(file.blob)
        except OSError as error:
            raise unusable("The recording cannot be read", error) from error
        with source, inheritable(source) as descriptor:
            decoder = RecordingDecoder(descriptor, name, self._seconds)
            try:
                yield decoder
            finally:
                decoder.close()

    def _read(self, decoder: RecordingDecoder, options: ImportOptions) -> SliceResult:
        """Scan the recording; return a slice with its index as file and outline as progress."""
        text, index = decoder.outline(options)
        progress = {
            "done": 0, "total": len(index.frames), "phase": "add", "received": 0, "there": 0,
            "refused": 0, "largest": 0, "recording": index.outline.model_dump(mode="json"),
        }  # fmt: skip
        with self._store.blobs.incoming() as blob:
            blob.write(text)
            file = queue.JobFile(_INDEX, blob.keep(), blob.size, "application/json")
        return SliceResult(False, progress, files=[file])

    def _add(
        self, task: LongJob, options: ImportOptions, read: Callable[[list[Any]], bytes],
        index: RecordingIndex, is_over: IsOver,
    ) -> SliceResult:  # fmt: skip
        frames, progress = index.frames, dict(task.progress)
        items = list[dict[str, Any]]()

        def upload(frame: dict[str, Any]) -> Upload:
            meta = FrameMeta.model_validate(frame["meta"])
            data = read(frame["place"])
            progress["largest"] = max(len(data), progress["largest"])
            return Upload(data, meta, options.priority, options.if_novel)

        frame_s = math.inf  # seconds per frame of the last block
        while progress["done"] < len(frames) and (not items or not is_over()):
            start = time.monotonic()
            # the first block is a single frame, since sizes and durations are unknown
            room = _BYTES_AT_ONCE // (progress["largest"] or _BYTES_AT_ONCE)
            count = max(1, min(_AT_ONCE, room, int(SLICE_S / frame_s)))
            block = frames[progress["done"] :][:count]
            reads = [(str(frame["name"]), partial(upload, frame)) for frame in block]
            for item in add_block(self._uploads, task, reads):
                items.append(item.model_dump(mode="json"))
                progress[{202: "received", 200: "there"}.get(item.status, "refused")] += 1
            progress["done"] += len(block)
            frame_s = (time.monotonic() - start) / len(block)
        if progress["done"] < len(frames):
            return SliceResult(False, progress, items)
        result = self._result(task, options, index, progress, items)
        return SliceResult(
            True, progress, items, drop=IMPORT_FILES, result=result, event="import.done"
        )

    def _result(
        self, task: LongJob, options: ImportOptions, index: RecordingIndex,
        progress: dict[str, Any], items: list[dict[str, Any]],
    ) -> dict[str, Any]:  # fmt: skip
        with self._store.database.read() as connection:
            before = queue.items_of(connection, task.job.number)
        results = [ImportItem.model_validate(item) for item in [*before, *items]]
        without = Counter(
            "refused" if item.frame_id is None else "" if options.with_poses else
            "with_poses is false"
            for item in results if item.frame_id is None or not item.has_pose
        )  # fmt: skip
        ranges = [item.samples for item in results if item.samples is not None]
        summary = upload_summary(
            len(results), without, ranges, index.notes, lost=index.outline.lost
        )
        counts = {name: progress[name] for name in ("received", "there", "refused")}
        return {
            "sequences": index.sequences, **counts, "ignored": 0,
            "summary": summary.model_dump(mode="json"),
        }  # fmt: skip
