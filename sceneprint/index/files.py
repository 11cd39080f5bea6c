"""Files of a cache folder, each named by the SHA-256 of what it holds, and the folder's lock.

A name that is the checksum needs no second place to keep it: a manifest that lists names lists
checksums, a file that two generations share is one file, and no file ever changes.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import re
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sceneprint.errors import DamagedIndex
from sceneprint.writing import write_durable

#: What a segment, a FAISS index, the rows it stands for, and a code are called.
KINDS = ("segment", "faiss", "rows", "code")
_NAME = re.compile(rf"[0-9a-f]{{64}}\.({'|'.join(KINDS)})")
_PART = re.compile(r"\.[0-9a-f]{12}\.part")


def name_of(data: bytes, kind: str) -> str:
    """The name of the file that holds these bytes."""
    return f"{hashlib.sha256(data).hexdigest()}.{kind}"


def is_name(name: str, kind: str) -> bool:
    """Whether a file of this kind can have this name: nothing else is opened."""
    found = _NAME.fullmatch(name)
    return found is not None and found[1] == kind


def is_ours(name: str) -> bool:
    """Whether a file was made here and may be removed: by content, or left by a killed builder."""
    return bool(_NAME.fullmatch(name) or _PART.fullmatch(name))


def unfinished(folder: Path) -> Path:
    """A new name for a file that is not yet whole; `is_ours` knows it."""
    return folder / f".{secrets.token_hex(6)}.part"


def put(folder: Path, data: bytes, kind: str) -> str:
    """Write a file durably under the name that its bytes give.

    Parameters
    ----------
    folder : must exist
    data : all of the file
    kind : one of KINDS

    Returns
    -------
    the name

    Raises
    ------
    OSError : it cannot be written.
    """
    name = name_of(data, kind)
    try:
        get(folder, name, len(data))
    except DamagedIndex:  # absent, or something happened to it
        write_durable(folder / name, data)
    return name


def get(folder: Path, name: str, size: int) -> bytes:
    """The bytes of a file, checked against its name.

    Parameters
    ----------
    folder, name : of the file
    size : that it must have, bytes; another is refused unread

    Raises
    ------
    DamagedIndex : missing, unreadable, of another size, or with bytes that give another name.
    """
    path = folder / name
    try:
        with path.open("rb") as file:
            found = os.fstat(file.fileno()).st_size
            data = file.read() if found == size else b""
    except OSError as error:
        raise DamagedIndex(f"{path}: cannot be read ({error.strerror or error}).") from error
    if found != size:
        raise DamagedIndex(f"{path}: {found} bytes, where {size} were written.")
    if name_of(data, name.rpartition(".")[2]) != name:
        raise DamagedIndex(f"{path}: its bytes are not those that were written.")
    return data


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
