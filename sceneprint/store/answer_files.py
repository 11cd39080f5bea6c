"""Files of stored answers by query id: in a folder, or in an object store of a fleet.

The database records which files are needed (`query_rows`). Files are not synced to disk, since
answers are not essential data.
"""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path

from sceneprint.atomic_files import make_folder, write_whole
from sceneprint.store.blobs.folder import Blobs
from sceneprint.store.blobs.object_client import Objects
from sceneprint.store.blobs.object_store import ObjectBlobs


class AnswerFiles(ABC):
    """Stored answers by query id, shared by several processes.

    Methods raise OSError or UnusableStore if the folder or the object store is not accessible.
    """

    @abstractmethod
    def put(self, query_id: str, data: bytes) -> None:
        """Store the bytes of an answer."""

    @abstractmethod
    def get(self, query_id: str) -> bytes:
        """Return the bytes of an answer; raise FileNotFoundError if it is missing."""

    @abstractmethod
    def delete(self, query_ids: Sequence[str]) -> None:
        """Remove answers; ignore missing answers."""

    @abstractmethod
    def list(self) -> Iterator[tuple[str, float]]:
        """Yield the name and modification time (seconds since 1970) of every file."""


class AnswerFolder(AnswerFiles):
    """Answers in a folder, which is created with the first answer."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def put(self, query_id: str, data: bytes) -> None:
        """See AnswerFiles."""
        make_folder(self._folder)
        write_whole(self._folder / query_id, data, private=True)

    def get(self, query_id: str) -> bytes:
        """See AnswerFiles."""
        return (self._folder / query_id).read_bytes()

    def delete(self, query_ids: Sequence[str]) -> None:
        """See AnswerFiles."""
        for name in query_ids:
            (self._folder / name).unlink(missing_ok=True)

    def list(self) -> Iterator[tuple[str, float]]:
        """See AnswerFiles; unfinished files of killed processes are included."""
        with suppress(FileNotFoundError), os.scandir(self._folder) as entries:
            for entry in entries:
                with suppress(FileNotFoundError):
                    yield entry.name, entry.stat(follow_symlinks=False).st_mtime


class AnswerObjects(AnswerFiles):
    """Answers in an object store, below `queries/` of its prefix."""

    def __init__(self, objects: Objects) -> None:
        self._objects = objects

    def put(self, query_id: str, data: bytes) -> None:
        """See AnswerFiles."""
        self._objects.put(f"queries/{query_id}", data)

    def get(self, query_id: str) -> bytes:
        """See AnswerFiles."""
        return self._objects.get(f"queries/{query_id}")

    def delete(self, query_ids: Sequence[str]) -> None:
        """See AnswerFiles."""
        self._objects.delete(*(f"queries/{query_id}" for query_id in query_ids))

    def list(self) -> Iterator[tuple[str, float]]:
        """See AnswerFiles."""
        for entry in self._objects.list("queries/"):
            yield entry.key.removeprefix("queries/"), entry.changed_at


def open_answers(blobs: Blobs, folder: Path) -> AnswerFiles:
    """Return the answer files at the location of the blobs, which all processes share.

    Parameters
    ----------
    folder : folder for the answers, if the blobs are in a folder too
    """
    return AnswerObjects(blobs.objects) if isinstance(blobs, ObjectBlobs) else AnswerFolder(folder)
