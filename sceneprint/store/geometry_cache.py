"""Geometry artifacts of frames that were read lately, decoded, in memory.

digest  --read-->  Geometry

A query compares itself with ten to twenty frames of the map, and a robot's next query with mostly
the same ones. What depends on a frame alone (`geometry.frame_cache`) is kept along with it.
"""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from sceneprint.formats.artifact import read_geometry
from sceneprint.store.blobs.folder import Blobs
from sceneprint.types import Geometry

#: Memory of a frame over that of its arrays: samples, plane weights and symmetries are kept too,
#: 0.2 of them where queries have used all of it.
_OVERHEAD = 1.25


@dataclass(frozen=True, eq=False)
class _Entry:
    geometry: Geometry
    size: int
    read_at: float


class GeometryCache:
    """Bounded in bytes, least recently used first; safe to share between threads.

    Entries are known by the hash of their content, so that none is ever out of date.

    Parameters
    ----------
    blobs : what artifacts are read from
    most_bytes : of all entries together; 0 keeps none
    """

    def __init__(self, blobs: Blobs, most_bytes: int) -> None:
        self._blobs, self._most_bytes = blobs, most_bytes
        self._lock = threading.Lock()
        self._entries: OrderedDict[str, _Entry] = OrderedDict()
        self._bytes = 0

    def read(self, digest: str) -> Geometry:
        """The artifact of a digest, which callers must not change.

        Raises
        ------
        DamagedBlob : it is missing, or not what it was.
        UnreadableGeometry : it is no artifact of this version.
        """
        with self._lock:
            entry = self._entries.get(digest)
            if entry is not None:
                self._entries.move_to_end(digest)
                return entry.geometry
        geometry = read_geometry(self._blobs.get(digest))
        entry = _Entry(geometry, int(_OVERHEAD * _array_bytes(geometry)), time.monotonic())
        with self._lock:
            self._remove(digest)  # another thread has read it meanwhile
            self._entries[digest] = entry
            self._bytes += entry.size
            while self._bytes > self._most_bytes:
                self._remove(next(iter(self._entries)))
        return geometry

    def forget(self, digests: Iterable[str]) -> None:
        """Drop entries whose frames were deleted."""
        with self._lock:
            for digest in digests:
                self._remove(digest)

    def forget_older(self, seconds: float) -> None:
        """Drop what was read longer ago: another process may have deleted its frame since."""
        until = time.monotonic() - seconds
        with self._lock:
            for digest in [d for d, entry in self._entries.items() if entry.read_at <= until]:
                self._remove(digest)

    @property
    def bytes_held(self) -> int:
        """Memory of all entries, estimated."""
        return self._bytes

    def _remove(self, digest: str) -> None:
        entry = self._entries.pop(digest, None)
        if entry is not None:
            self._bytes -= entry.size


def _array_bytes(geometry: Geometry) -> int:
    values = [*vars(geometry.surface).values(), *vars(geometry.patches).values()]
    arrays = [value for value in values if isinstance(value, np.ndarray)]
    return sum(array.nbytes for array in arrays) + geometry.descriptors.nbytes
