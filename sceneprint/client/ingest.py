"""Uploads beyond the plain one: under an id of the caller, many at once, whole archives.

A topic of the client: what it needs of a backend, both backends, and the calls of `Client`.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, Protocol

from sceneprint.client.frames import checked, sendable
from sceneprint.client.sending import PAGE, Sender, given
from sceneprint.errors import InvalidRequest, UnreadableArchive
from sceneprint.schemas import Added, Job, Page
from sceneprint.schemas.frames import MOST_PRIORITY, FrameMeta
from sceneprint.schemas.ingest import (
    MOST_OF_BATCH,
    Batch,
    BatchItem,
    ImportItem,
    ImportOptions,
    check_frame_id,
)
from sceneprint.schemas.novelty import novelty_of

if TYPE_CHECKING:
    from sceneprint.client.backend import Backend
    from sceneprint.datasets import FrameReference
    from sceneprint.engine import Engine

#: Bytes of an archive that are sent at once.
_CHUNK = 1 << 20


class IngestBackend(Protocol):
    """What this topic needs of whoever does the work."""

    def put_frame(
        self, map_name: str, frame_id: str, data: bytes, meta: FrameMeta, wait_s: float,
        priority: int, if_novel: float | None,
    ) -> tuple[Added, bool]:  # fmt: skip
        """Take a frame into a map under an id; whether it is new."""

    def add_batch(
        self, map_name: str, frames: Sequence[tuple[bytes, FrameMeta]], priority: int,
        if_novel: float | None,
    ) -> Batch:  # fmt: skip
        """Take frames into a map in one commit."""

    def begin_import(self, map_name: str, archive: BinaryIO, options: ImportOptions) -> Job:
        """Send an archive."""

    def get_import(self, map_name: str, job_id: str) -> Job:
        """An import of a map."""

    def list_import_items(self, map_name: str, job_id: str, cursor: str | None) -> Page[ImportItem]:
        """A page of what came of its members."""


class RemoteIngest(Sender):
    """Over HTTP."""

    def put_frame(
        self, map_name: str, frame_id: str, data: bytes, meta: FrameMeta, wait_s: float,
        priority: int, if_novel: float | None,
    ) -> tuple[Added, bool]:  # fmt: skip
        """Take a frame into a map under an id."""
        from sceneprint.client.messages import form, frame_path, read

        wait = min(int(wait_s), 60)
        sent = form(data, meta)
        sent["data"] |= _said(priority, if_novel)
        response = self._send(
            "PUT", frame_path(map_name, frame_id),
            headers={"Prefer": f"wait={wait}"} if wait else {}, timeout=self._timeout_s + wait,
            **sent,
        )  # fmt: skip
        return read(Added, response), response.status_code != 200

    def add_batch(
        self, map_name: str, frames: Sequence[tuple[bytes, FrameMeta]], priority: int,
        if_novel: float | None,
    ) -> Batch:  # fmt: skip
        """Take frames into a map in one commit."""
        from sceneprint.client.messages import map_path, said_of

        metas = [said_of(meta) for _, meta in frames]
        files = [("frame", ("frame", data, "application/octet-stream")) for data, _ in frames]
        data = {"metas": json.dumps(metas), **_said(priority, if_novel)}
        path = f"{map_path(map_name)}/frames/batch"
        return self._ask(Batch, "POST", path, files=files, data=data)

    def begin_import(self, map_name: str, archive: BinaryIO, options: ImportOptions) -> Job:
        """Send an archive, from its start at each try."""
        import httpx

        from sceneprint.client.messages import map_path, read
        from sceneprint.client.problems import refusal
        from sceneprint.client.retrying import persist

        said = options.model_dump_json(exclude_defaults=True)

        def send() -> httpx.Response:
            archive.seek(0)
            return self._http.request(
                "POST", f"{map_path(map_name)}/imports", content=_chunks(archive),
                params={"options": said}, timeout=self._timeout_s,
                headers={"Content-Type": "application/octet-stream"},
            )  # fmt: skip

        response, _ = persist(send, self._url, met=self._met)
        self._met = True
        if not response.is_success:
            raise refusal(response)
        return read(Job, response)

    def get_import(self, map_name: str, job_id: str) -> Job:
        """An import of a map."""
        return self._ask(Job, "GET", _import_path(map_name, job_id))

    def list_import_items(self, map_name: str, job_id: str, cursor: str | None) -> Page[ImportItem]:
        """A page of what came of its members."""
        parameters = given(cursor=cursor, limit=str(PAGE))
        path = f"{_import_path(map_name, job_id)}/items"
        return self._ask(Page[ImportItem], "GET", path, params=parameters)


class EmbeddedIngest:
    """In this process."""

    _engine: Engine

    def put_frame(
        self, map_name: str, frame_id: str, data: bytes, meta: FrameMeta, wait_s: float,
        priority: int, if_novel: float | None,
    ) -> tuple[Added, bool]:  # fmt: skip
        """Take a frame into a map under an id."""
        from sceneprint.engine.uploads import Upload

        del wait_s  # nobody but who waits would sign it
        upload = Upload(data, meta, priority, if_novel, frame_id)
        outcome, _ = self._engine.uploads.add(map_name, upload)
        return outcome.taken, outcome.new

    def add_batch(
        self, map_name: str, frames: Sequence[tuple[bytes, FrameMeta]], priority: int,
        if_novel: float | None,
    ) -> Batch:  # fmt: skip
        """Take frames into a map in one commit."""
        from sceneprint.engine.replaying import item_of
        from sceneprint.engine.uploads import Upload

        uploads = [Upload(data, meta, priority, if_novel) for data, meta in frames]
        outcomes, _ = self._engine.uploads.add_all(map_name, uploads)
        return Batch(items=[item_of(one) for one in outcomes])

    def begin_import(self, map_name: str, archive: BinaryIO, options: ImportOptions) -> Job:
        """Take an archive."""
        with self._engine.imports.receive(map_name) as receiver:
            for chunk in _chunks(archive):
                receiver.write(chunk)
            kept = receiver.end()
        return self._engine.imports.begin(map_name, kept, options)[0]

    def get_import(self, map_name: str, job_id: str) -> Job:
        """An import of a map."""
        return self._engine.imports.get(map_name, job_id)

    def list_import_items(self, map_name: str, job_id: str, cursor: str | None) -> Page[ImportItem]:
        """A page of what came of its members."""
        return self._engine.imports.items(map_name, job_id, cursor, PAGE)


class Ingest:
    """The calls."""

    _backend: Backend

    def put_frame(
        self, map_name: str, frame_id: str, frame: bytes | Path | FrameReference,
        meta: FrameMeta | None = None, *, wait_s: float | None = None, priority: int = 0,
        if_novel: float | bool | None = None,
    ) -> Added:  # fmt: skip
        """Take a frame into a map under an id of your own; sent again, it is the one there.

        Parameters
        ----------
        map_name : of the map
        frame_id : up to 64 letters, digits, dots, hyphens and underscores, the first a letter or
            digit
        frame, meta, wait_s, priority, if_novel : as for `upload`

        Raises
        ------
        UnknownMap, FrameError, DatasetError : as `upload`.
        FrameConflict : there is a frame of that id with other content or metadata.
        InvalidRequest : an id that is none; a priority or `if_novel` out of its range.
        """
        from sceneprint.client.waiting import settle

        check_frame_id(frame_id)
        until = time.monotonic() + (wait_s or 0.0)
        data, known = sendable(frame, meta, with_pose=True)
        added, _ = self._backend.put_frame(
            map_name, frame_id, data, known, wait_s or 0.0, _priority(priority),
            novelty_of(if_novel),
        )  # fmt: skip
        return settle(self._backend, map_name, added, until)

    def upload_batch(
        self, map_name: str, frames: Sequence[bytes | Path | FrameReference],
        metas: Sequence[FrameMeta] | FrameMeta | None = None, *, priority: int = 0,
        if_novel: float | bool | None = None,
    ) -> list[BatchItem]:  # fmt: skip
        """Take up to 64 frames into a map in one commit; what is wrong with one costs no other.

        Parameters
        ----------
        map_name : of the map
        frames, metas : as for `upload`; one for all, or one for each
        priority, if_novel : of all

        Returns
        -------
        items : of each frame in their order

        Raises
        ------
        UnknownMap : no such map.
        UnreadableFrame, DatasetError : a file cannot be read; nothing was sent.
        InvalidRequest : too many frames, or not as many metadata.
        """
        if isinstance(metas, FrameMeta):
            metas = [metas] * len(frames)
        if not 1 <= len(frames) <= MOST_OF_BATCH or (metas and len(metas) != len(frames)):
            raise InvalidRequest(
                f"The batch has {len(frames)} frames. Give 1 to {MOST_OF_BATCH}, and one `meta` "
                "for all or for each.",
                (("frames", "too many or too few"),),
            )
        known = [None] * len(frames) if metas is None else metas
        sent = [sendable(*one, with_pose=True) for one in zip(frames, known, strict=True)]
        return self._backend.add_batch(
            map_name, sent, _priority(priority), novelty_of(if_novel)
        ).items

    def import_archive(
        self, map_name: str, archive: Path | BinaryIO, options: ImportOptions | None = None
    ) -> Job:
        """Take an archive of sequences into a map; a worker takes its frames one by one.

        Parameters
        ----------
        map_name : of the map
        archive : a zip, or a tar (plain, .gz, .bz2 or .xz), of a 7-Scenes scene or sequence, a TUM
            RGB-D folder, or depth images with their intrinsics.json
        options : what is said of all its frames; default: named as the file is

        Returns
        -------
        job : wait for it with `wait_for_import`, and see what came of it with `import_items`

        Raises
        ------
        UnknownMap : no such map.
        UnreadableArchive : no archive, or the file cannot be read.
        """
        if not isinstance(archive, Path):
            return self._backend.begin_import(map_name, archive, options or ImportOptions())
        try:
            with archive.open("rb") as file:
                name = archive.name.partition(".")[0][:64] or "import"
                own = options or checked(ImportOptions, "The archive's name", name=name)
                return self._backend.begin_import(map_name, file, own)
        except OSError as error:
            raise UnreadableArchive(
                f"{archive}: The file cannot be read ({error.strerror}). Check its name."
            ) from error

    def import_job(self, map_name: str, job_id: str) -> Job:
        """An import of a map; UnknownMap or UnknownJob where there is none."""
        return self._backend.get_import(map_name, job_id)

    def import_items(self, map_name: str, job_id: str) -> Iterator[ImportItem]:
        """What came of each member of an archive so far, in their order."""
        page = self._backend.list_import_items(map_name, job_id, None)
        yield from page.items
        while page.next_cursor is not None:
            page = self._backend.list_import_items(map_name, job_id, page.next_cursor)
            yield from page.items


def _priority(priority: int) -> int:
    if abs(priority) > MOST_PRIORITY:
        raise InvalidRequest(
            f"The priority is {priority}. Give one from {-MOST_PRIORITY} to {MOST_PRIORITY}.",
            (("priority", "out of its range"),),
        )
    return priority


def _said(priority: int, if_novel: float | None) -> dict[str, str]:
    said = {"priority": str(priority)} if priority else {}
    return said if if_novel is None else {**said, "if_novel": repr(if_novel)}


def _import_path(map_name: str, job_id: str) -> str:
    from sceneprint.client.messages import job_path, map_path

    return f"{map_path(map_name)}/imports/{job_path(job_id).rpartition('/')[2]}"


def _chunks(file: BinaryIO) -> Iterator[bytes]:
    while chunk := file.read(_CHUNK):
        yield chunk
