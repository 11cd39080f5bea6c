"""Blobs as a snapshot takes them along: in a row, several at once where each is waited for.

digests  --taken-->  Taken | Untaken, in the same order
"""

from __future__ import annotations

import hashlib
from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from itertools import islice
from typing import Literal

from sceneprint.errors import DamagedBlob, SnapshotError
from sceneprint.store import Blobs
from sceneprint.store.blobs import is_digest

#: Blobs that are read at once, and bytes above which one is read alone and in parts.
_AT_ONCE, _LARGE = 8, 8 << 20
_CHUNK = 1 << 20
#: Blobs of which the size is asked; of more, the rest is taken to be like them.
_MEASURED = 10_000


@dataclass(frozen=True)
class Taken:
    """A blob, and its bytes in parts: to be read to their end before the next is taken."""

    digest: str
    size: int
    chunks: Iterator[bytes]


@dataclass(frozen=True)
class Untaken:
    """A blob that could not be taken along."""

    digest: str
    why: Literal["missing", "damaged"]


def taken(blobs: Blobs, digests: Iterable[str]) -> Iterator[Taken | Untaken]:
    """Blobs, each checked against its digest before anything of it is given.

    Raises
    ------
    SnapshotError : a large one was changed while it was read.
    UnusableStore : they cannot be read.
    """
    wanted = iter(digests)
    with ThreadPoolExecutor(_AT_ONCE, thread_name_prefix="take") as pool:
        waiting: deque[Future[Taken | Untaken]] = deque()
        try:
            for digest in islice(wanted, 2 * _AT_ONCE):
                waiting.append(pool.submit(_take, blobs, digest))
            while waiting:
                yield waiting.popleft().result()
                for digest in islice(wanted, 1):
                    waiting.append(pool.submit(_take, blobs, digest))
        finally:
            for one in waiting:
                one.cancel()


def total_bytes(blobs: Blobs, digests: Iterable[str], count: int) -> int:
    """Bytes of all blobs, missing ones left out; about, where there are many.

    Parameters
    ----------
    blobs, digests : which
    count : of the digests
    """
    step = max(-(-count // _MEASURED), 1)
    with ThreadPoolExecutor(_AT_ONCE, thread_name_prefix="measure") as pool:
        sizes = pool.map(blobs.size, filter(is_digest, islice(digests, 0, None, step)))
        return step * sum(size or 0 for size in sizes)


def _take(blobs: Blobs, digest: str) -> Taken | Untaken:
    if not is_digest(digest):  # of a database that somebody has edited
        return Untaken(digest, "missing")
    size = blobs.size(digest)
    if size is not None and size > _LARGE:
        condition = blobs.condition(digest)
        if condition == "sound":
            return Taken(digest, size, _parts(blobs, digest))
        return Untaken(digest, condition)
    try:
        data = blobs.get(digest)
    except DamagedBlob:
        return Untaken(digest, "damaged" if blobs.holds(digest) else "missing")
    return Taken(digest, len(data), iter([data]))


def _parts(blobs: Blobs, digest: str) -> Iterator[bytes]:
    hashed = hashlib.sha256()
    with closing(blobs.open(digest)) as file:
        while chunk := file.read(_CHUNK):
            hashed.update(chunk)
            yield chunk
    if hashed.hexdigest() != digest:
        raise SnapshotError(f"The blob {digest[:12]} was changed while it was read. Try again.")
