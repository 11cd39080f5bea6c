"""A blob that comes in parts, such as one that does not fit into memory."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from io import FileIO
from typing import BinaryIO

from sceneprint.store.faults import unusable


class IncomingBlob:
    """A blob that comes in parts; see `Blobs.incoming`.

    Parameters
    ----------
    file : that it is written to
    what : to say where that fails
    keep : makes it durable under its digest
    """

    def __init__(self, file: BinaryIO | FileIO, what: str, keep: Callable[[str], None]) -> None:
        self._file, self._what, self._keep = file, what, keep
        self._hashed = hashlib.sha256()
        #: Bytes so far.
        self.size = 0

    def write(self, data: bytes) -> None:
        """Add to it."""
        try:
            left = memoryview(data)
            while left:  # a file without a buffer may take a part alone
                left = left[self._file.write(left) or 0 :]
        except OSError as error:
            raise unusable(self._what, error) from error
        self._hashed.update(data)
        self.size += len(data)

    def keep(self) -> str:
        """End it; when this returns it survives the loss of power. Returns its digest."""
        digest = self._hashed.hexdigest()
        try:
            self._keep(digest)
        except OSError as error:
            raise unusable(self._what, error) from error
        return digest
