"""Many files written durably in a row, without waiting for each."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import TracebackType
from typing import BinaryIO

from sceneprint.writing import sync_folder

#: Files that are synced together, and threads that wait for it: on ext4 16 are done in the time
#: of five, as one journal commit serves several.
BATCH, THREADS = 64, 8


class DurableFiles:
    """Files of a folder; all are durable after the end of the `with` block.

    Parameters
    ----------
    folder : made here; None: nothing is written
    """

    def __init__(self, folder: Path | None) -> None:
        self._folder = folder
        self._open: list[BinaryIO] = []
        self._folders: set[Path] = set()
        self._pool = ThreadPoolExecutor(THREADS, thread_name_prefix="sync")
        if folder is not None:
            folder.mkdir()

    def __enter__(self) -> DurableFiles:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:  # fmt: skip
        with self._pool:
            if self._folder is not None and error is None:
                self._sync()
                list(self._pool.map(sync_folder, [*self._folders, self._folder]))
        for file in self._open:
            file.close()

    def write(self, path: Path, chunks: Iterable[bytes]) -> str:
        """Write a file.

        Parameters
        ----------
        path : in the folder, not there yet
        chunks : its bytes

        Returns
        -------
        digest : the SHA-256 of them
        """
        hashed = hashlib.sha256()
        if self._folder is None:
            for chunk in chunks:
                hashed.update(chunk)
            return hashed.hexdigest()
        whole = self._folder / path
        if whole.parent not in self._folders:
            whole.parent.mkdir()
            self._folders.add(whole.parent)
        file = whole.open("xb", buffering=0)
        self._open.append(file)
        for chunk in chunks:
            hashed.update(chunk)
            _write_all(file, chunk)
        if len(self._open) >= BATCH:
            self._sync()
        return hashed.hexdigest()

    def _sync(self) -> None:
        list(self._pool.map(os.fsync, [file.fileno() for file in self._open]))
        while self._open:
            self._open.pop().close()


def _write_all(file: BinaryIO, data: bytes) -> None:
    left = memoryview(data)
    while left:
        left = left[file.write(left) :]
