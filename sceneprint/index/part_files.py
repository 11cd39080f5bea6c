"""Parts of an index: files in a folder, each named by the SHA-256 of its bytes.

A name that is the checksum needs no second place to keep it: a manifest that lists names lists
checksums, two manifests that share a part name one file, and no file ever changes.
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

#: Endings of the parts of a segment: its keys, FAISS indexes of its signatures and of their
#: sketches, the means by which those were made, and the deleted keys.
KINDS = ("keys", "faiss", "sketches", "means", "gone")
#: The name of a part: its digest and its kind.
PART_NAME = rf"^[0-9a-f]{{64}}\.({'|'.join(KINDS)})$"
#: Bytes that are read at once where a part is verified.
BLOCK_BYTES = 8 << 20
#: A part, or what a killed builder left of one.
_OURS = re.compile(rf"{PART_NAME}|^\.[0-9a-f]{{12}}\.part$")

Keys = NDArray[np.int64]
#: Keys (n,) int64 of frames, and their signatures (n, D) uint8.
Block = tuple[Keys, Bytes]


def is_ours(name: str) -> bool:
    """Return whether a file was made here, and may be removed where no manifest needs it."""
    return _OURS.match(name) is not None


def unfinished(folder: Path) -> Path:
    """Return a new name for a file that is not yet whole."""
    return folder / f".{secrets.token_hex(6)}.part"


def put(
    folder: Path, kind: str, write: Callable[[Callable[[bytes], None]], object]
) -> tuple[str, int]:
    """Write a part durably; return its name and its bytes.

    Parameters
    ----------
    folder : must exist
    kind : one of KINDS
    write : is called with a function that takes the bytes of the part, block by block

    Raises
    ------
    OSError : it cannot be written; nothing is left behind.
    """
    part, digest = unfinished(folder), hashlib.sha256()
    try:
        with os.fdopen(create_private(part), "wb") as file:

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


def verify(folder: Path, name: str, size: int) -> Iterator[None]:
    """Read a part, and check its bytes; yields after each block, so that the caller may stop.

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
        raise unreadable(path, error) from error
    if digest.hexdigest() != path.stem:
        raise DamagedIndex(f"{path}: its bytes are not those that were written.")


def mapped(path: Path) -> mmap.mmap | bytes:
    """Map a file into memory that processes share, also after it is unlinked.

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
        raise unreadable(path, error) from error


def unreadable(path: Path, error: OSError) -> DamagedIndex:
    """Return the error of a file that is missing or cannot be read."""
    return DamagedIndex(f"{path}: cannot be read ({error.strerror or error}).")


def check_block(keys: Keys, signatures: Bytes, length: int) -> None:
    """Raise ValueError where these are not keys, and signatures of that many bytes."""
    if keys.dtype != np.int64 or signatures.dtype != np.uint8:
        raise ValueError(f"keys of {keys.dtype} and signatures of {signatures.dtype}")
    if keys.ndim != 1 or length < 1 or signatures.shape != (len(keys), length):
        raise ValueError(f"keys {keys.shape} and signatures {signatures.shape} of {length} bytes")
