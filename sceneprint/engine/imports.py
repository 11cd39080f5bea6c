"""Archives of sequences into a map: taken whole at the door, and frame by frame by a worker.

    chunks  --Receiver-->  a blob that can be sought in  --begin-->  job  --handler-->  items

What is taken of one at once: members.py.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from sceneprint.datasets.archives import Archive, open_archive
from sceneprint.datasets.inflating import Inflater
from sceneprint.engine.cursors import row_of
from sceneprint.engine.jobs import get_job
from sceneprint.engine.members import next_of, steps_of, take
from sceneprint.engine.slices import Outcome, Swept, Task
from sceneprint.engine.sweeping import sweep_deleted
from sceneprint.engine.tasks import Tasks
from sceneprint.engine.uploads import Uploads
from sceneprint.errors import SceneprintError, UnreadableArchive, UnusableStore
from sceneprint.schemas import Job, Page
from sceneprint.schemas.ingest import ImportItem, ImportOptions
from sceneprint.store import Store
from sceneprint.store.faults import unusable
from sceneprint.store.idempotency import Once
from sceneprint.store.incoming import IncomingBlob
from sceneprint.store.listing import find_job, unknown_job
from sceneprint.store.maps import find_map
from sceneprint.store.parts import JobFile, files_of, given_up, items_of, remove_parts

KIND, FILE = "import", "archive"
#: Seconds for which the archive of an import that was given up is kept for another try, and
#: between two looks for those.
KEPT_S, TIDY_S = 86_400.0, 60.0
#: How much more a compressed tar may hold than the largest archive that is taken.
_UNPACKED = 4


class Receiver:
    """An archive on its way in; see `Imports.receive`.

    Parameters
    ----------
    blob : that it becomes, compressed tars inflated
    most_bytes : that it may have
    """

    def __init__(self, blob: IncomingBlob, most_bytes: int) -> None:
        self._blob, self._inflater = blob, Inflater(most_bytes)

    def write(self, chunk: bytes) -> None:
        """Take the next part.

        Raises
        ------
        UnreadableArchive : it is no archive, is damaged, or holds more than it may.
        StoreFull, UnusableStore : it cannot be written.
        """
        for piece in self._inflater.pieces(chunk):
            self._blob.write(piece)

    def end(self) -> JobFile:
        """Keep it, durable; raises as `write`."""
        for piece in self._inflater.end():
            self._blob.write(piece)
        return JobFile(FILE, self._blob.keep(), self._blob.size, "application/octet-stream")


class Imports:
    """Imports of archives.

    Parameters
    ----------
    store, tasks, uploads : see there
    most_bytes : of an archive, as it is sent
    """

    def __init__(self, store: Store, tasks: Tasks, uploads: Uploads, most_bytes: int) -> None:
        self._store, self._tasks, self._uploads = store, tasks, uploads
        self._most = most_bytes
        self._tidied = time.monotonic()
        tasks.register(KIND, self.handle)

    @contextmanager
    def receive(self, map_name: str) -> Iterator[Receiver]:
        """Take an archive in parts; what is not kept by `Receiver.end` is removed.

        Raises
        ------
        UnknownMap : no such map.
        ReadOnlyStore, StoreFull, UnusableStore : nothing can be kept.
        """
        with self._store.database.read() as connection:
            find_map(connection, map_name)
        self._store.database.require_writable()
        with self._store.blobs.incoming() as blob:
            yield Receiver(blob, _UNPACKED * self._most)

    def begin(
        self, map_name: str, archive: JobFile, options: ImportOptions, once: Once | None = None
    ) -> tuple[Job, bool]:
        """Queue the import of an archive that was received.

        Returns
        -------
        job : that imports it
        replayed : whether `once` began it before

        Raises
        ------
        UnknownMap, IdempotencyConflict : see `Tasks.begin_once`; the archive is removed.
        UnusableStore : an import of the same archive has just ended, and removed it.
        """
        data = options.model_dump(mode="json")
        try:
            job, again = self._tasks.begin_once(
                KIND, map_name, data, options.priority, [archive], once
            )
        except Swept as error:
            raise UnusableStore(f"{error} Send the archive once more.") from error
        except SceneprintError:
            sweep_deleted(self._store, [archive.blob])
            raise
        if again:
            sweep_deleted(self._store, [archive.blob])
        return job, again

    def get(self, map_name: str, job_id: str) -> Job:
        """An import of a map; UnknownMap or UnknownJob where there is none."""
        with self._store.database.read() as connection:
            find_map(connection, map_name)
        job = get_job(self._store, job_id)
        if job.kind != KIND or job.map != map_name:
            raise unknown_job(job_id)
        return job

    def items(
        self, map_name: str, job_id: str, cursor: str | None = None, limit: int = 100
    ) -> Page[ImportItem]:
        """What came of the members of an archive so far, in their order.

        Raises
        ------
        UnknownMap, UnknownJob : there is none.
        InvalidRequest : a cursor that was not given out.
        """
        self.get(map_name, job_id)
        first = row_of(cursor) or 0
        with self._store.database.read() as connection:
            number = find_job(connection, job_id).number
            found = items_of(connection, number, first, limit + 1)
        more = str(first + limit) if len(found) > limit else None
        return Page[ImportItem](
            items=[ImportItem(**one) for one in found[:limit]], next_cursor=more
        )

    def handle(self, task: Task, until: float) -> Outcome:
        """Import a part of an archive: frames until the time is over, at least some."""
        options = ImportOptions.model_validate(task.data)
        with self._store.database.read() as connection:
            file = files_of(connection, task.claim.job.number).get(FILE)
        if file is None:
            raise UnreadableArchive(
                "The archive was removed, as its import failed, or was given up long ago. Send it "
                "anew."
            )
        try:
            with self._opened(file, options.name) as archive:
                return self._slice(task, archive, options, until)
        except UnreadableArchive:  # trying again cannot help, and it may be large
            with self._store.database.write() as connection:
                number = task.claim.job.number
                gone = remove_parts(connection, number, items=False, files=[FILE])
            sweep_deleted(self._store, gone)
            raise

    def tidy(self) -> int:
        """Remove archives of imports that were given up long ago, if it is time; returns how many.

        Raises
        ------
        UnusableStore : it cannot be written; it is tried again the next time.
        """
        if time.monotonic() - self._tidied < TIDY_S:
            return 0
        self._tidied = time.monotonic()
        long_ago = time.time() - KEPT_S
        with self._store.database.read() as connection:  # most often there is none: no lock
            if not given_up(connection, KIND, FILE, long_ago):
                return 0
        with self._store.database.write() as connection:
            gone = [
                blob
                for number in given_up(connection, KIND, FILE, long_ago)
                for blob in remove_parts(connection, number, items=False, files=[FILE])
            ]
        sweep_deleted(self._store, gone)
        return len(gone)

    @contextmanager
    def _opened(self, file: JobFile, name: str) -> Iterator[Archive]:
        try:
            opened = self._store.blobs.open(file.blob)
        except FileNotFoundError as error:
            raise UnreadableArchive(
                "The archive is gone from the store. Send it once more."
            ) from error
        except OSError as error:
            raise unusable("The archive cannot be read", error) from error
        try:
            with opened, open_archive(opened, Path(tempfile.gettempdir()), name) as archive:
                yield archive
        except OSError as error:
            raise unusable("The archive cannot be unpacked", error) from error

    def _slice(self, task: Task, archive: Archive, options: ImportOptions, until: float) -> Outcome:
        steps = list(steps_of(archive, options.every))
        progress = {"done": 0, "received": 0, "there": 0, "refused": 0} | task.progress
        progress["total"] = len(steps)
        items: list[dict[str, Any]] = []
        while progress["done"] < len(steps) and (not items or time.monotonic() < until):
            some = next_of(archive, steps, progress["done"])
            for item in take(self._uploads, task, archive, some, options):
                items.append(item.model_dump(mode="json"))
                what = {202: "received", 200: "there"}.get(item.status, "refused")
                progress[what] += 1
            progress["done"] += len(some)
        over = progress["done"] >= len(steps)
        counts = {name: progress[name] for name in ("received", "there", "refused")}
        result = {"sequences": len(archive.sequences), **counts, "ignored": archive.ignored}
        return Outcome(
            over, progress, items, drop=[FILE] if over else (), result=result if over else None,
            event="import.done" if over else None,
        )  # fmt: skip
