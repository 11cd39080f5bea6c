"""Segments: files of stored signatures, written once and mapped into memory.

Little-endian. One page of header: magic, schema, bytes of a signature, number of signatures,
SHA-256 of the signatures, SHA-256 of what follows them, zeros. Then the signatures, row by row;
zeros up to a multiple of 8; the keys, int64. The file's name is the SHA-256 of its header, and so
vouches for every byte.
"""

from __future__ import annotations

import hashlib
import mmap
import os
import struct
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sceneprint.errors import DamagedIndex
from sceneprint.index.files import name_of, unfinished
from sceneprint.types import Bytes
from sceneprint.writing import sync_folder

#: Keys (n,) int64 of frames, and their signatures (n, D) uint8.
Block = tuple[NDArray[np.int64], Bytes]

MAGIC, SCHEMA_VERSION = b"SPSEG\0", 1
#: Rows begin on a page of memory.
_PAGE, _HEAD = 4096, struct.Struct("<6sHIQ32s32s")
#: Bytes of signatures that are handled at once where all are read.
BLOCK_BYTES = 8 << 20


@dataclass(frozen=True, eq=False)
class Segment:
    """Stored signatures, mapped into memory: nothing is read before it is used.

    Parameters
    ----------
    name : of the file, from its content
    size : of the file, bytes
    inode : of the file that is mapped: one of the same name may have replaced it
    digest : SHA-256 that the signatures had when they were written
    keys : (n,) int64, of the frames
    signatures : (n, D) uint8, read-only; keeps the mapping alive, also after the file is unlinked
    """

    name: str
    size: int
    inode: int
    digest: bytes
    keys: NDArray[np.int64]
    signatures: Bytes

    def __len__(self) -> int:
        return len(self.keys)

    def is_sound(self) -> bool:
        """Whether the signatures are those that were written: reads them all."""
        return hashlib.sha256(self.signatures.data).digest() == self.digest


def write_segment(folder: Path, blocks: Iterable[Block]) -> str:
    """Write signatures as they come, durably; memory holds one block.

    Parameters
    ----------
    folder : must exist
    blocks : see Block; of one length of signature

    Returns
    -------
    name of the file

    Raises
    ------
    ValueError : no signatures at all, or blocks that are not keys and signatures of one length.
    OSError : it cannot be written; nothing is left behind.
    """
    part = unfinished(folder)
    try:
        with part.open("xb") as file:
            file.seek(_PAGE)
            digest, keys, length = hashlib.sha256(), [], 0
            for own, signatures in blocks:
                length = length or signatures.shape[-1]
                check_block(own, signatures, length)
                rows = np.ascontiguousarray(signatures)
                file.write(rows.data)
                digest.update(rows.data)
                keys.append(own.astype("<i8"))
            n = sum(map(len, keys))
            if n == 0:
                raise ValueError("a segment of no signatures")
            rest = bytes(-n * length % 8) + np.concatenate(keys).tobytes()
            file.write(rest)
            head = _HEAD.pack(
                MAGIC, SCHEMA_VERSION, length, n, digest.digest(), hashlib.sha256(rest).digest()
            ).ljust(_PAGE, b"\0")
            file.seek(0)
            file.write(head)
            file.flush()
            os.fsync(file.fileno())  # before its name: a name must never lead to half a file
        name = name_of(head, "segment")
        os.replace(part, folder / name)  # noqa: PTH105  (the one call that is atomic by contract)
        sync_folder(folder)
    except BaseException:
        part.unlink(missing_ok=True)
        raise
    return name


def check_block(keys: NDArray[np.int64], signatures: Bytes, length: int) -> None:
    """See that these are keys and signatures of that many bytes.

    Raises
    ------
    ValueError : they are not.
    """
    if keys.dtype != np.int64 or signatures.dtype != np.uint8:
        raise ValueError(f"keys of {keys.dtype} and signatures of {signatures.dtype}")
    if keys.ndim != 1 or length < 1 or signatures.shape != (len(keys), length):
        raise ValueError(f"keys {keys.shape} and signatures {signatures.shape} of {length} bytes")


def open_segment(path: Path, *, verify: bool) -> Segment:
    """Map a segment into memory.

    Parameters
    ----------
    path : of the file, under the name that `write_segment` gave
    verify : read all signatures and check them too; else header, size and keys alone

    Raises
    ------
    DamagedIndex : not a segment, of another schema, cut short, or changed.
    """
    try:
        with path.open("rb") as file:
            status = os.fstat(file.fileno())
            size = status.st_size
            if size < _PAGE:
                raise DamagedIndex(f"{path}: {size} bytes are no segment.")
            mapped = mmap.mmap(file.fileno(), size, access=mmap.ACCESS_READ)
    except OSError as error:
        raise DamagedIndex(f"{path}: cannot be read ({error.strerror or error}).") from error
    head = mapped[:_PAGE]
    magic, schema, length, n, rows_digest, rest_digest = _HEAD.unpack_from(head)
    if magic != MAGIC or schema != SCHEMA_VERSION or name_of(head, "segment") != path.name:
        raise DamagedIndex(f"{path}: no segment of schema {SCHEMA_VERSION}, or a changed header.")
    end = _PAGE + n * length
    keys_at = end + -end % 8
    if size != keys_at + 8 * n:
        raise DamagedIndex(f"{path}: {size} bytes, where {keys_at + 8 * n} were written.")
    rest = mapped[end:]
    if hashlib.sha256(rest).digest() != rest_digest:
        raise DamagedIndex(f"{path}: its keys are not those that were written.")
    if hasattr(mapped, "madvise"):  # rows are read in their order, most often all of them
        mapped.madvise(mmap.MADV_SEQUENTIAL)
    # plain arrays: a memmap pays for its class on every slice
    stored: Bytes = np.frombuffer(mapped, np.uint8, n * length, _PAGE)
    keys = np.frombuffer(rest, "<i8", offset=keys_at - end).astype(np.int64)
    rows = stored.reshape(n, length)
    segment = Segment(path.name, size, status.st_ino, rows_digest, keys, rows)
    if verify and not segment.is_sound():
        raise DamagedIndex(f"{path}: its signatures are not those that were written.")
    return segment


def gather(segments: Sequence[Segment], rows: NDArray[np.int64]) -> Bytes:
    """Signatures of some rows: a view where they are neighbours in one segment, else a copy.

    Parameters
    ----------
    segments : one or more, of one length of signature
    rows : (r,) counted through all segments, in any order

    Returns
    -------
    (r, D) uint8, in the order of `rows`
    """
    starts = np.cumsum([0, *map(len, segments)])
    owners = np.searchsorted(starts, rows, side="right") - 1
    different = np.unique(owners)
    if len(different) == 1:
        stored, own = segments[different[0]].signatures, rows - starts[different[0]]
        if (np.diff(own) == 1).all():
            result: Bytes = stored[own[0] : own[0] + len(own)]
        else:
            result = stored[own]
        return result
    result = np.empty((len(rows), segments[0].signatures.shape[1]), np.uint8)
    for owner in different:
        own = np.flatnonzero(owners == owner)
        result[own] = segments[owner].signatures[rows[own] - starts[owner]]
    return result


def blocks_of(rows: NDArray[np.int64], length: int, size: int) -> Iterator[NDArray[np.int64]]:
    """Cut rows into runs whose signatures, of `length` bytes, fill at most `size` bytes."""
    step = max(size // length, 1)
    for start in range(0, len(rows), step):
        yield rows[start : start + step]
