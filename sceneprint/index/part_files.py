"""The parts of indexes: files that are named by the SHA-256 of their bytes.

Therefore, the names in a manifest are checksums, manifests with the same part share a file, and
files never change.
"""

from __future__ import annotations

import hashlib
import mmap
import os
import re
import secrets
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sceneprint.atomic_files import create_private, sync_folder
from sceneprint.errors import DamagedIndex
from sceneprint.types import Bytes

#: Suffixes of the parts of a segment: keys, FAISS indexes of signatures and of sketches, means for
#: the sketches, and removed keys.
KINDS = ("keys", "faiss", "sketches", "means", "gone")
#: Pattern of the name of a part: digest and kind.
PART_NAME = rf"^[0-9a-f]{{64}}\.({'|'.join(KINDS)})$"
#: Number of bytes to read at once when a part is verified.
BLOCK_BYTES = 8 << 20
#: Pattern of the names of parts and of unfinished parts.
_OURS = re.compile(rf"{PART_NAME}|^\.[0-9a-f]{{12}}\.part$")

Keys = NDArray[np.int64]
#: Keys (n,) int64 and signatures (n, D) uint8 of frames.
Block = tuple[Keys, Bytes]


def is_ours(name: str) -> bool:
    """Return whether a name belongs to a part or an unfinished part."""
    return _OURS.match(name) is not None


def put(
    folder: Path, kind: str, write: Callable[[Callable[[bytes], None]], object]
) -> tuple[str, int]:
    """Write a part durably; return its name and size in bytes.

    Parameters
    ----------
    folder : existing folder
    kind : one of KINDS
    write : function that passes the bytes of the part to its argument, block by block

    Raises
    ------
    OSError : If the part cannot be written; no file remains.
    """
    part, digest = folder / f".{secrets.token_hex(6)}.part", hashlib.sha256()
    try:
        with os.fdopen(create_private(part), "wb") as file:

            def take(data: bytes) -> None:
                file.write(data)
                digest.update(data)

            write(take)
            size = file.tell()
            file.flush()
            os.fsync(file.fileno())  # the content must be durable before its name
        name = f"{digest.hexdigest()}.{kind}"
        os.replace(part, folder / name)  # noqa: PTH105  (the one call that is atomic by contract)
        sync_folder(folder)
    except BaseException:
        part.unlink(missing_ok=True)
        raise
    return name, size


def verify(folder: Path, name: str, size: int) -> Iterator[None]:
    """Verify the checksum of a part; yield after each block, so that the caller may stop.

    Raises
    ------
    DamagedIndex : If the part is missing, unreadable or damaged.
    """
    path, digest = folder / name, hashlib.sha256()
    try:
        with path.open("rb") as file:
            actual = os.fstat(file.fileno()).st_size
            if actual != size:
                raise DamagedIndex(f"{path}: the file has {actual} bytes instead of {size}.")
            while block := file.read(BLOCK_BYTES):
                digest.update(block)
                yield
    except OSError as error:
        raise unreadable(path, error) from error
    if digest.hexdigest() != path.stem:
        raise DamagedIndex(f"{path}: the bytes are damaged.")


def mapped(path: Path) -> mmap.mmap | bytes:
    """Map a file into shared memory; the memory remains valid after the file is unlinked.

    Raises
    ------
    DamagedIndex : If the file is missing or unreadable.
    """
    try:
        with path.open("rb") as file:
            if os.fstat(file.fileno()).st_size == 0:
                return b""
            return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    except OSError as error:
        raise unreadable(path, error) from error


def unreadable(path: Path, error: OSError) -> DamagedIndex:
    """Return the error for a missing or unreadable file."""
    return DamagedIndex(f"{path}: cannot be read ({error.strerror or error}).")


def check_block(keys: Keys, signatures: Bytes, length: int) -> None:
    """Raise ValueError unless arrays are keys and signatures of `length` bytes."""
    if keys.dtype != np.int64 or signatures.dtype != np.uint8:
        raise ValueError(f"keys of {keys.dtype} and signatures of {signatures.dtype}")
    if keys.ndim != 1 or length < 1 or signatures.shape != (len(keys), length):
        raise ValueError(f"keys {keys.shape} and signatures {signatures.shape} of {length} bytes")
