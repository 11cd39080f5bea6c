"""Blobs: bytes kept under the SHA-256 of their content, durable before anything refers to them.

bytes  --put-->  digest  --get-->  the same bytes, or an error

In a folder (folders.py), or in an object store (object_blobs.py).
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Literal, Protocol

from sceneprint.store.incoming import IncomingBlob

#: What a blob is found to be.
Condition = Literal["sound", "missing", "damaged"]
DIGEST = re.compile(r"[0-9a-f]{64}")


def is_digest(given: object) -> bool:
    """Whether it is the name of a blob, whatever of."""
    return isinstance(given, str) and DIGEST.fullmatch(given) is not None


def require_digest(given: str) -> None:
    """ValueError for what is no digest: it must not become part of a path or a key."""
    if not DIGEST.fullmatch(given):
        raise ValueError(f"{given!r} is no digest")


@dataclass(frozen=True)
class BlobEntry:
    """What lies where blobs are kept.

    Parameters
    ----------
    place : file or key, for people
    digest : of the blob that it is; None where it is none
    changed_at : seconds since 1970
    unfinished : whether a writer writes it, or has left it
    """

    place: str
    digest: str | None
    changed_at: float
    unfinished: bool = False


class Blobs(Protocol):
    """Where blobs are kept; safe to share between threads."""

    def put(self, data: bytes) -> str:
        """Keep bytes; when this returns nothing that the store promises to survive loses them.

        Returns
        -------
        digest : 64 hexadecimal digits

        Raises
        ------
        StoreFull : there is no room; nothing is left behind.
        UnusableStore : it may not be written, or is not there.
        """

    def incoming(self) -> AbstractContextManager[IncomingBlob]:
        """Take a blob in parts, such as one that does not fit into memory.

        What is not kept by the end of it is removed.

        Raises
        ------
        StoreFull, UnusableStore : as `put`, also from `write` and `keep`.
        """

    def get(self, digest: str) -> bytes:
        """The bytes of a digest, checked against it.

        Raises
        ------
        DamagedBlob : they are missing, or others than were stored.
        UnusableStore : the store is away.
        """

    def open(self, digest: str) -> BinaryIO:
        """A blob as a file that can be sought in, unchecked; FileNotFoundError where it is missing.

        Raises
        ------
        OSError, UnusableStore : it cannot be read, now or later.
        """

    def holds(self, digest: str) -> bool:
        """Whether there is a blob of that digest."""

    def size(self, digest: str) -> int | None:
        """Bytes of a blob as it lies there, unchecked; None where it is missing."""

    def kept(self) -> AbstractContextManager[None]:
        """See that no blob is removed meanwhile; waits for who is removing some.

        The lock of a process that dies is free at once, however it dies.

        Raises
        ------
        UnusableStore : it cannot be locked.
        """

    def removing(self) -> AbstractContextManager[bool]:
        """Hold the right to remove blobs; False where somebody needs them kept, or removes some.

        Ask for it within a writing transaction: removers then come one after the other, and leave
        room between them for who waits in `kept`.
        """

    def remove(self, digest: str) -> None:
        """Forget a blob that nothing refers to; only within `removing`."""

    def condition(self, digest: str, *, quick: bool = False) -> Condition:
        """Whether a blob is as it was stored; read in parts, so that memory is bounded.

        Parameters
        ----------
        digest : of the blob; what is no digest names none
        quick : see only whether it is there

        Raises
        ------
        UnusableStore : it may not be read by this user, or the store is away.
        """

    def quarantine(self, digest: str, folder: Path) -> Path | None:
        """Move what lies under a digest out of the way, durably; None where there is nothing.

        Parameters
        ----------
        digest : of a blob that was found damaged; only within `removing`
        folder : to move it to; made where missing
        """

    def place(self, digest: str) -> str:
        """Where a blob lies, for people to look at."""

    def digests(self) -> Iterator[str]:
        """All blobs, in no order."""

    def entries(self) -> Iterator[BlobEntry]:
        """All that lies where blobs are kept, in no order."""

    def check(self) -> None:
        """See that a store on the network answers, or did two seconds ago; a folder has nothing
        to be asked.

        Raises
        ------
        UnusableStore : it does not.
        """

    def close(self) -> None:
        """Give back what it holds open."""
