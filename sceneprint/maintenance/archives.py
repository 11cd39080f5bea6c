"""Archives: an uncompressed tar of which every byte is accounted for.

name, bytes  --ArchiveWriter-->  file  --ArchiveReader-->  the same, or DamagedSnapshot

`tarfile` passes over much that is odd: links, sparse files, a header that ends the archive early.
Nothing of that can be in a snapshot, so the reader knows plain files only, and zeros between them.
"""

from __future__ import annotations

import os
import tarfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO

from sceneprint.errors import DamagedSnapshot

#: Bytes read or written at once.
CHUNK = 1 << 20
#: Bytes of the archive that are done.
Progress = Callable[[int], None]


def chunks_of(path: Path) -> Iterator[bytes]:
    """The bytes of a file, a part at a time."""
    with path.open("rb") as file:
        while chunk := file.read(CHUNK):
            yield chunk


def padded(size: int) -> int:
    """Bytes that a member of that size takes without its header."""
    return -(-size // tarfile.BLOCKSIZE) * tarfile.BLOCKSIZE


class ArchiveWriter:
    """Members one after the other; the first can be written again in its place.

    Parameters
    ----------
    file : open for writing, at its start
    mtime : of all members, seconds since 1970
    progress : told of the bytes written so far
    """

    def __init__(self, file: BinaryIO, mtime: int, progress: Progress) -> None:
        self._file, self._mtime, self._progress = file, mtime, progress

    def add(self, name: str, size: int, chunks: Iterator[bytes]) -> None:
        """Append a member.

        Raises
        ------
        ValueError : the chunks are not of that size.
        """
        member = tarfile.TarInfo(name)
        member.size, member.mtime, member.mode = size, self._mtime, 0o600
        self._file.write(member.tobuf(tarfile.GNU_FORMAT))
        written = 0
        for chunk in chunks:
            self._file.write(chunk)
            written += len(chunk)
            self._progress(self._file.tell())
        if written != size:
            raise ValueError(f"{name}: {written} bytes, where {size} were promised")
        self._file.write(bytes(padded(size) - size))

    @property
    def size(self) -> int:
        """Bytes of the archive, if it is finished now."""
        return self._file.tell() + 2 * tarfile.BLOCKSIZE

    def finish(self, first: bytes) -> None:
        """End the archive, and write the content of its first member again.

        Parameters
        ----------
        first : as many bytes as it has
        """
        self._file.write(bytes(2 * tarfile.BLOCKSIZE))
        self._file.seek(tarfile.BLOCKSIZE)
        self._file.write(first)
        self._file.flush()
        os.fsync(self._file.fileno())


class ArchiveReader:
    """Members one after the other, each read to its end.

    Parameters
    ----------
    file : open for reading, at its start
    path : of the file, for messages
    progress : told of the bytes read so far
    """

    def __init__(self, file: BinaryIO, path: Path, progress: Progress) -> None:
        self._file, self._path, self._progress = file, path, progress
        #: Bytes of the whole file.
        self.size = os.fstat(file.fileno()).st_size

    def next(self) -> tuple[str, int] | None:
        """Name and size of the next member; None at the end of the archive.

        Raises
        ------
        DamagedSnapshot : neither is there, or the member is no plain file.
        """
        block = self._read(tarfile.BLOCKSIZE)
        if not any(block):
            self._end()
            return None
        try:
            member = tarfile.TarInfo.frombuf(block, "ascii", "strict")
        except (tarfile.HeaderError, ValueError) as error:
            raise self.damaged("no member begins where one should") from error
        if member.type != tarfile.REGTYPE or member.size < 0:
            raise self.damaged("a member is no plain file")
        return member.name, member.size

    def content(self, size: int) -> Iterator[bytes]:
        """The bytes of the member that `next` has told of, to be read to their end."""
        left = size
        while left:
            chunk = self._read(min(left, CHUNK))
            left -= len(chunk)
            self._progress(self._file.tell())
            yield chunk
        if any(self._read(padded(size) - size)):
            raise self.damaged("there is something between two members")

    def damaged(self, what: str) -> DamagedSnapshot:
        """An error that says where the archive is damaged."""
        return DamagedSnapshot(
            f"{self._path}: the snapshot is damaged near byte {self._file.tell()}: {what}. "
            "Nothing was restored; take another snapshot, or another copy of this one."
        )

    def _end(self) -> None:
        while chunk := self._file.read(CHUNK):
            if any(chunk):
                raise self.damaged("something follows its end")

    def _read(self, size: int) -> bytes:
        data = self._file.read(size)
        if len(data) != size:
            raise self.damaged("it is cut short")
        return data
