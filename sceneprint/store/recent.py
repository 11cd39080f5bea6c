"""Blobs that were read lately, in memory: a query reads ten artifacts, each a request otherwise."""

from __future__ import annotations

import threading
import time
from collections import OrderedDict

#: Bytes of all together, and the most of one.
MOST, LARGEST = 64 << 20, 2 << 20


class Recent:
    """Bounded in bytes and in age; safe to share between threads.

    Parameters
    ----------
    seconds : after which nothing is left of one, whether it is asked for or not: what was deleted
        elsewhere must go here too
    """

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds
        self._lock = threading.Lock()
        self._held: OrderedDict[str, tuple[float, bytes]] = OrderedDict()  # the oldest first
        self._bytes = 0
        self._timer: threading.Timer | None = None

    def get(self, digest: str) -> bytes | None:
        """The bytes, where they are held."""
        with self._lock:
            found = self._held.get(digest)
        return None if found is None or found[0] <= time.monotonic() else found[1]

    def put(self, digest: str, data: bytes) -> None:
        """Hold them; the oldest go."""
        if len(data) > LARGEST:
            return
        with self._lock:
            self._remove(digest)
            self._held[digest] = (time.monotonic() + self._seconds, data)
            self._bytes += len(data)
            while self._bytes > MOST:
                self._remove(next(iter(self._held)))
            self._wind()

    def remove(self, digest: str) -> None:
        """Hold them no more."""
        with self._lock:
            self._remove(digest)

    def close(self) -> None:
        """Hold nothing."""
        with self._lock:
            self._held.clear()
            self._bytes = 0
            if self._timer is not None:
                self._timer.cancel()
                self._timer = None

    def _remove(self, digest: str) -> None:
        found = self._held.pop(digest, None)
        if found is not None:
            self._bytes -= len(found[1])

    def _wind(self) -> None:
        if self._timer is None and self._held:
            until, _ = next(iter(self._held.values()))
            self._timer = threading.Timer(max(until - time.monotonic(), 0.01), self._expire)
            self._timer.daemon = True
            self._timer.start()

    def _expire(self) -> None:
        with self._lock:
            self._timer = None
            now = time.monotonic()
            while self._held and next(iter(self._held.values()))[0] <= now:
                self._remove(next(iter(self._held)))
            self._wind()
