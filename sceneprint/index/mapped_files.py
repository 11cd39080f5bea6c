"""Files of a cache folder, each named by the SHA-256 of what it holds, and the folder's lock.

A name that is the checksum needs no second place to keep it: a manifest that lists names lists
checksums, a file that two generations share is one file, and no file ever changes.
"""

from __future__ import annotations

import fcntl
import hashlib
import mmap
import os
import re
import secrets
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sceneprint.atomic_files import sync_folder
from sceneprint.errors import DamagedIndex
from sceneprint.types import Bytes

#: What the keys, the FAISS index and the inverted file of a generation are called.
KINDS = ("keys", "faiss", "lists")
#: Bytes that are read at once where a file is checked.
BLOCK_BYTES = 8 << 20
_NAME = re.compile(rf"[0-9a-f]{{64}}\.({'|'.join(KINDS)})")
#: What version 0.1 left, manifests too, and what a killed builder left.
_LEFT = re.compile(
    r"[0-9a-f]{64}\.(segment|rows|code)|\d{10}-[0-9a-f]{32}\.json|\.[0-9a-f]{12}\.part"
)


def is_name(name: str, kind: str) -> bool:
    """Whether a file of this kind can have this name: nothing else is opened."""
    found = _NAME.fullmatch(name)
    return found is not None and found[1] == kind


def is_ours(name: str) -> bool:
    """Whether a file was made here, and may be removed where no manifest needs it."""
    return bool(_NAME.fullmatch(name) or _LEFT.fullmatch(name))


def unfinished(folder: Path) -> Path:
    """A new name for a file that is not yet whole; `is_ours` knows it."""
    return folder / f".{secrets.token_hex(6)}.part"


def put(
    folder: Path, kind: str, write: Callable[[Callable[[bytes], None]], object]
) -> tuple[str, int]:
    """Write a file durably under the name that its bytes give.

    Parameters
    ----------
    folder : must exist
    kind : one of KINDS
    write : is called with what takes the bytes of the file, one block after the other

    Returns
    -------
    the name, and how many bytes it has

    Raises
    ------
    OSError : it cannot be written; nothing is left behind.
    """
    part, digest = unfinished(folder), hashlib.sha256()
    try:
        with part.open("xb") as file:

            def take(data: bytes) -> None:
                file.write(data)
                digest.update(data)

            write(take)
            size = file.tell()
            file.flush()
            os.fsync(file.fileno())  # before its name: a name must never lead to half a file
        name = f"{digest.hexdigest()}.{kind}"
        os.replace(part, folder / name)  # noqa: PTH105  (the one call that is atomic by contract)
        sync_folder(folder)
    except BaseException:
        part.unlink(missing_ok=True)
        raise
    return name, size


def check(folder: Path, name: str, size: int) -> Iterator[None]:
    """Read a file, and see that its bytes are those that its name was given for.

    Yields
    ------
    None after each block that was read, so that the caller may stop in between

    Raises
    ------
    DamagedIndex : missing, unreadable, of another size, or with bytes that give another name.
    """
    path, digest = folder / name, hashlib.sha256()
    try:
        with path.open("rb") as file:
            found = os.fstat(file.fileno()).st_size
            if found != size:
                raise DamagedIndex(f"{path}: {found} bytes, where {size} were written.")
            while block := file.read(BLOCK_BYTES):
                digest.update(block)
                yield
    except OSError as error:
        raise DamagedIndex(f"{path}: cannot be read ({error.strerror or error}).") from error
    if digest.hexdigest() != name.partition(".")[0]:
        raise DamagedIndex(f"{path}: its bytes are not those that were written.")


def mapped(path: Path) -> mmap.mmap | bytes:
    """A file in memory that processes share, also after it is unlinked.

    Raises
    ------
    DamagedIndex : missing or unreadable.
    """
    try:
        with path.open("rb") as file:
            if os.fstat(file.fileno()).st_size == 0:
                return b""
            return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    except OSError as error:
        raise DamagedIndex(f"{path}: cannot be read ({error.strerror or error}).") from error


@contextmanager
def building(folder: Path) -> Iterator[bool]:
    """Hold the right to build in a folder, which is made if need be; False where another has it.

    The kernel releases the lock of a process that dies, however it dies.
    """
    folder.mkdir(parents=True, exist_ok=True)
    # of this call alone: flock then keeps out other threads as well as other processes
    descriptor = os.open(folder / ".lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            yield False
        else:
            yield True
    finally:
        os.close(descriptor)


# Keys of frames, and where they stand in a list of keys.

Keys = NDArray[np.int64]
#: Keys (n,) int64 of frames, and their signatures (n, D) uint8.
Block = tuple[Keys, Bytes]


class Places:
    """The places of keys in a list, found by bisection.

    Parameters
    ----------
    keys : (n,) in their order; a rising list is not copied

    Raises
    ------
    ValueError : a key is there twice.
    """

    def __init__(self, keys: Keys) -> None:
        self._order: NDArray[np.intp] | None = None
        self._rising = keys
        if (keys[1:] <= keys[:-1]).any():
            self._order = np.argsort(keys)
            self._rising = keys[self._order]
            again = self._rising[1:] == self._rising[:-1]
            if again.any():
                raise ValueError(f"the keys {self._rising[1:][again][:5].tolist()} are there twice")

    def of(self, keys: Keys) -> NDArray[np.int64]:
        """Places (m,) of keys (m,); -1 for a key that is not there."""
        if len(self._rising) == 0:
            return np.full(len(keys), -1, np.int64)
        at = np.minimum(np.searchsorted(self._rising, keys), len(self._rising) - 1)
        places = at if self._order is None else self._order[at]
        return np.where(self._rising[at] == keys, places, -1)


def check_block(keys: Keys, signatures: Bytes, length: int) -> None:
    """See that these are keys and signatures of that many bytes.

    Raises
    ------
    ValueError : they are not.
    """
    if keys.dtype != np.int64 or signatures.dtype != np.uint8:
        raise ValueError(f"keys of {keys.dtype} and signatures of {signatures.dtype}")
    if keys.ndim != 1 or length < 1 or signatures.shape != (len(keys), length):
        raise ValueError(f"keys {keys.shape} and signatures {signatures.shape} of {length} bytes")


def draw(n: int, limit: int, seed: int) -> NDArray[np.int64]:
    """At most `limit` of n rows: one at random from each of as many equal stretches.

    Even, so that every place of a map counts alike; at random, so that nothing periodic in the
    order of the frames (two robots in turn) is missed.
    """
    if n <= limit:
        return np.arange(n)
    edges = np.arange(limit + 1) * n // limit
    return np.random.default_rng(seed).integers(edges[:-1], edges[1:])
