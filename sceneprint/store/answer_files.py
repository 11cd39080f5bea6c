"""Files of stored answers, each under the id of its query: a folder, or objects of a fleet.

The database says which of them are needed (`query_rows`). They are not synced to disk: an answer
that is lost costs a look at it, and no data.
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
    """Stored answers by their ids; several processes share them.

    Methods raise OSError or UnusableStore where the folder or the object store cannot be used.
    """

    @abstractmethod
    def put(self, query_id: str, data: bytes) -> None:
        """Store the bytes of an answer."""

    @abstractmethod
    def get(self, query_id: str) -> bytes:
        """Return the bytes of an answer; FileNotFoundError where there are none."""

    @abstractmethod
    def delete(self, query_ids: Sequence[str]) -> None:
        """Remove answers; of no consequence where there are none."""

    @abstractmethod
    def list(self) -> Iterator[tuple[str, float]]:
        """Yield the names of all files, and when each was written, seconds since 1970."""


class AnswerFolder(AnswerFiles):
    """Answers in a folder, which is created with the first of them."""

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
        """See AnswerFiles; unfinished files of processes that died are among them."""
        with suppress(FileNotFoundError), os.scandir(self._folder) as entries:
            for entry in entries:
                with suppress(FileNotFoundError):  # another process has removed it
                    yield entry.name, entry.stat(follow_symlinks=False).st_mtime


class AnswerObjects(AnswerFiles):
    """Answers in an object store, under `queries/` of its prefix."""

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
        self._objects.delete(*(f"queries/{one}" for one in query_ids))

    def list(self) -> Iterator[tuple[str, float]]:
        """See AnswerFiles."""
        for one in self._objects.list("queries/"):
            yield one.key.removeprefix("queries/"), one.changed_at


def open_answers(blobs: Blobs, folder: Path) -> AnswerFiles:
    """Return where answers are stored: beside the blobs, so that who shares those finds them.

    Parameters
    ----------
    blobs : of the store
    folder : for the answers, where blobs are in a folder as well
    """
    return AnswerObjects(blobs.objects) if isinstance(blobs, ObjectBlobs) else AnswerFolder(folder)
