"""Files of stored answers, named by query id, in a folder or an object store.

The database records which files are needed (`query_rows`). Files are not synced to disk, since
answers are not essential data.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path

from sceneprint.atomic_files import make_folder, write_whole
from sceneprint.store.blobs.folder import Blobs
from sceneprint.store.blobs.object_client import Objects
from sceneprint.store.blobs.object_store import ObjectBlobs


class AnswerFolder:
    """Answers in a folder that several processes may share; the first `put` creates the folder.

    Methods raise OSError or UnusableStore if the folder or the object store is not accessible.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def put(self, query_id: str, data: bytes) -> None:
        """Store the bytes of an answer."""
        make_folder(self._folder)
        write_whole(self._folder / query_id, data, private=True)

    def get(self, query_id: str) -> bytes:
        """Return the bytes of an answer; raise FileNotFoundError if it is missing."""
        return (self._folder / query_id).read_bytes()

    def delete(self, query_ids: Sequence[str]) -> None:
        """Remove answers, and ignore missing answers."""
        for name in query_ids:
            (self._folder / name).unlink(missing_ok=True)

    def list(self) -> Iterator[tuple[str, float]]:
        """Yield the name and modification time (seconds since 1970) of every file, including
        unfinished files of killed processes.
        """
        with suppress(FileNotFoundError), os.scandir(self._folder) as entries:
            for entry in entries:
                with suppress(FileNotFoundError):
                    yield entry.name, entry.stat(follow_symlinks=False).st_mtime


class AnswerObjects:
    """Answers in an object store, below `queries/` of its prefix; see AnswerFolder."""

    def __init__(self, objects: Objects) -> None:
        self._objects = objects

    def put(self, query_id: str, data: bytes) -> None:
        """Store the bytes of an answer."""
        self._objects.put(f"queries/{query_id}", data)

    def get(self, query_id: str) -> bytes:
        """Return the bytes of an answer; raise FileNotFoundError if it is missing."""
        return self._objects.get(f"queries/{query_id}")

    def delete(self, query_ids: Sequence[str]) -> None:
        """Remove answers, and ignore missing answers."""
        self._objects.delete(*(f"queries/{query_id}" for query_id in query_ids))

    def list(self) -> Iterator[tuple[str, float]]:
        """Yield the name and modification time (seconds since 1970) of every answer."""
        for entry in self._objects.list("queries/"):
            yield entry.key.removeprefix("queries/"), entry.changed_at


AnswerFiles = AnswerFolder | AnswerObjects


def open_answers(blobs: Blobs, folder: Path) -> AnswerFiles:
    """Return the answer files: in the object store that contains the blobs, or else in a folder.

    Parameters
    ----------
    folder : folder for the answers if the blobs are in a folder
    """
    return AnswerObjects(blobs.objects) if isinstance(blobs, ObjectBlobs) else AnswerFolder(folder)
