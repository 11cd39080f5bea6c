"""A file that lies elsewhere and is fetched a range at a time."""

from __future__ import annotations

import io
import os
from collections.abc import Callable
from typing import TYPE_CHECKING, BinaryIO, cast

if TYPE_CHECKING:
    from _typeshed import WriteableBuffer

#: Bytes that are fetched at once at least.
AHEAD = 1 << 20


class RangeFile(io.RawIOBase):
    """To be read and sought in; see `buffered`.

    Parameters
    ----------
    size : bytes of it
    fetch : its bytes from a place on, so many
    """

    def __init__(self, size: int, fetch: Callable[[int, int], bytes]) -> None:
        super().__init__()
        self._size, self._fetch, self._place = size, fetch, 0

    @classmethod
    def buffered(cls, size: int, fetch: Callable[[int, int], bytes]) -> BinaryIO:
        """With a buffer, so that small reads cost no request each."""
        return cast("BinaryIO", io.BufferedReader(cls(size, fetch), AHEAD))

    def readable(self) -> bool:
        """It is."""
        return True

    def seekable(self) -> bool:
        """It is."""
        return True

    def seek(self, offset: int, whence: int = os.SEEK_SET, /) -> int:
        """Go elsewhere; beyond the end there is nothing to read."""
        base = {os.SEEK_SET: 0, os.SEEK_CUR: self._place, os.SEEK_END: self._size}[whence]
        if base + offset < 0:
            raise ValueError("before the beginning")
        self._place = base + offset
        return self._place

    def tell(self) -> int:
        """The place that is read next."""
        return self._place

    def readinto(self, buffer: WriteableBuffer, /) -> int:
        """Read what there is, as much as the buffer takes."""
        view = memoryview(buffer).cast("B")
        length = min(len(view), self._size - self._place)
        if length <= 0:
            return 0
        view[:length] = self._fetch(self._place, length)
        self._place += length
        return length
