"""A compressed tar taken apart as it comes, so that its members can be sought in afterwards.

chunks  --Inflater.pieces-->  bytes of a zip or of a plain tar

What it holds in memory is bounded whatever the bytes say; a bomb is refused while it bursts.
"""

from __future__ import annotations

import bz2
import lzma
import zlib
from collections.abc import Iterator
from typing import Protocol

from sceneprint.datasets.tars import BLOCK, is_tar_header
from sceneprint.errors import UnreadableArchive

PIECE = 1 << 20  #: bytes that are inflated at once
#: How much more an archive may hold than it weighs, once it holds `FREE` bytes. Depth images are
#: compressed already, and NPY files of noisy depth give a fifth.
MOST_RATIO, FREE = 50, 64 << 20
_MAXIMUM_STREAMS = 65_536  #: one after the other, as parallel packers write them
_XZ_MEMORY = 192 << 20  #: as `xz -9` needs, and more

_MAGIC = (b"PK\x03\x04", b"\x1f\x8b", b"BZh", b"\xfd7zXZ\x00")
_KINDS = "a zip, or a tar (plain, .gz, .bz2 or .xz)"
_NO_TAR = f"What is compressed here is no tar. Send {_KINDS}."


class _Stream(Protocol):
    @property
    def eof(self) -> bool: ...

    @property
    def unused_data(self) -> bytes: ...

    def decompress(self, data: bytes, max_length: int, /) -> bytes: ...


def is_archive(head: bytes) -> bool:
    """Whether a file that begins so is one of the archives read here; its content decides."""
    return head.startswith(_MAGIC) or is_tar_header(head[:BLOCK])


class Inflater:
    """Takes an archive in chunks of any size, and gives it in pieces, compressed tars inflated.

    Parameters
    ----------
    most_bytes : that it may give
    """

    def __init__(self, most_bytes: int) -> None:
        self._most = most_bytes
        self._head: bytes | None = b""
        self._packing: bytes | None = None  # magic of what packs the tar
        self._stream: _Stream | None = None
        self._streams = 0
        self._start = b""  # of the tar
        #: Bytes that came, and that were given.
        self.taken, self.given = 0, 0

    def pieces(self, chunk: bytes) -> Iterator[bytes]:
        """What a chunk adds to the archive.

        Raises
        ------
        UnreadableArchive : it is none, is damaged, or holds more than it may.
        """
        self.taken += len(chunk)
        if self._head is not None:
            self._head += chunk
            if len(self._head) < BLOCK:
                return
            chunk, self._head = self._head, None
            self._open(chunk)
        yield from self._given(chunk)

    def end(self) -> Iterator[bytes]:
        """What is left when all has come; raises as `pieces`."""
        if self._head is not None:  # all of it is shorter than a block: an empty zip, or nothing
            chunk, self._head = self._head, None
            self._open(chunk)
            yield from self._given(chunk)
        if self._stream is not None:
            raise UnreadableArchive("The archive ends early. Copy or pack it again.")
        if self._packing is not None and len(self._start) < BLOCK:
            raise UnreadableArchive(_NO_TAR)

    def _open(self, head: bytes) -> None:
        if not is_archive(head):
            raise UnreadableArchive(
                f"This is no archive that is read. Send {_KINDS} of a sequence; one frame is sent "
                "as a frame."
            )
        for magic in _MAGIC[1:]:
            if head.startswith(magic):
                self._packing, self._stream = magic, _opened(magic)

    def _given(self, chunk: bytes) -> Iterator[bytes]:
        for piece in [chunk] if self._packing is None else self._inflated(chunk):
            self.given += len(piece)
            if self.given > self._most or self.given > FREE + MOST_RATIO * self.taken:
                raise UnreadableArchive(
                    f"The archive holds more than {self._most} bytes, or {MOST_RATIO} times what "
                    "it weighs, which no depth images do. Send it in parts, or packed less."
                )
            if self._packing is not None and len(self._start) < BLOCK:
                self._start += piece[: BLOCK - len(self._start)]
                if len(self._start) == BLOCK and not is_tar_header(self._start):
                    raise UnreadableArchive(_NO_TAR)
            yield piece

    def _inflated(self, chunk: bytes) -> Iterator[bytes]:
        data = chunk
        while True:
            if self._stream is None:  # between two, or behind the last one
                data = data.lstrip(b"\0")
                if not data:
                    return
                assert self._packing is not None
                self._streams += 1
                if self._streams > _MAXIMUM_STREAMS:
                    raise UnreadableArchive(
                        "The archive is packed in too many small parts. Pack it again, as one."
                    )
                self._stream = _opened(self._packing)
            try:
                piece = self._stream.decompress(data, PIECE)
            except (zlib.error, OSError, EOFError, ValueError, lzma.LZMAError) as cause:
                raise UnreadableArchive(
                    f"The archive is damaged ({cause}). Copy or pack it again."
                ) from cause
            if piece:
                yield piece
            if self._stream.eof:
                data, self._stream = self._stream.unused_data, None
                continue
            # zlib keeps what it has not taken beside itself, the others within
            data = getattr(self._stream, "unconsumed_tail", b"")
            if not data and len(piece) < PIECE:
                return


def _opened(magic: bytes) -> _Stream:
    if magic == _MAGIC[1]:
        return zlib.decompressobj(16 + zlib.MAX_WBITS)
    if magic == _MAGIC[2]:
        return bz2.BZ2Decompressor()
    return lzma.LZMADecompressor(lzma.FORMAT_XZ, memlimit=_XZ_MEMORY)
