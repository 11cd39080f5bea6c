"""Blobs: bytes kept under the SHA-256 of their content, durable before anything refers to them.

bytes  --put-->  digest  --get-->  the same bytes, or an error
"""

from __future__ import annotations

import errno
import hashlib
import os
import re
from collections.abc import Iterator
from pathlib import Path

from sceneprint.errors import DamagedBlob, UnusableStore
from sceneprint.writing import write_durable

_DIGEST = re.compile(r"[0-9a-f]{64}")


class Blobs:
    """A folder of blobs, in 256 folders by their first two digits.

    Parameters
    ----------
    folder : made where missing

    Raises
    ------
    UnusableStore : it cannot be made.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UnusableStore(
                f"{folder}: the folder cannot be made ({error.strerror}). Name another with "
                "--data, or check its permissions."
            ) from error

    def put(self, data: bytes) -> str:
        """Keep bytes; when this returns they survive the loss of power.

        Returns
        -------
        digest : 64 hexadecimal digits

        Raises
        ------
        UnusableStore : the disk is full or may not be written; nothing is left behind.
        """
        digest = hashlib.sha256(data).hexdigest()
        path = self._path(digest)
        try:  # also where it is there: that one may be damaged, not yet durable, or being removed
            path.parent.mkdir(exist_ok=True)
            write_durable(path, data)
        except OSError as error:
            full = error.errno in (errno.ENOSPC, errno.EDQUOT)
            advice = "Free some space." if full else "Check the folder and its permissions."
            raise UnusableStore(
                f"{self._folder}: a blob cannot be written ({error.strerror}). {advice}"
            ) from error
        return digest

    def get(self, digest: str) -> bytes:
        """The bytes of a digest, checked against it.

        Raises
        ------
        DamagedBlob : they are missing, or others than were stored.
        """
        try:
            data = self._path(digest).read_bytes()
        except OSError as error:
            raise DamagedBlob(
                f"The blob {digest[:12]} cannot be read ({error.strerror}). Restore the data "
                "folder from a copy, or delete the frame and upload it again."
            ) from error
        if hashlib.sha256(data).hexdigest() != digest:
            raise DamagedBlob(
                f"The blob {digest[:12]} is damaged: its content has another hash. Restore the "
                "data folder from a copy, or delete the frame and upload it again."
            )
        return data

    def holds(self, digest: str) -> bool:
        """Whether there is a blob of that digest."""
        return self._path(digest).exists()

    def remove(self, digest: str) -> None:
        """Forget a blob that nothing refers to."""
        self._path(digest).unlink(missing_ok=True)

    def digests(self) -> Iterator[str]:
        """All blobs, in no order."""
        for folder in self._folder.iterdir():
            if folder.is_dir():
                for name in os.listdir(folder):  # noqa: PTH208  (a path for each would cost)
                    if _DIGEST.fullmatch(name):
                        yield name

    def _path(self, digest: str) -> Path:
        if not _DIGEST.fullmatch(digest):
            raise ValueError(f"{digest!r} is no digest")
        return self._folder / digest[:2] / digest
