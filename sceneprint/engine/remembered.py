"""Signatures that this node read from the database lately, as far as memory is given to them."""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from collections.abc import Iterable, Mapping

from sceneprint.store.vectors import Head

#: Memory for them: of 25 kB each, the shortlists of twenty places.
MOST_BYTES = 256 << 20


class Remembered:
    """Signatures by frame and model; safe to share between threads.

    Each is used only for a frame that the database has just told of, with that checksum: a frame
    that was deleted finds none.

    Parameters
    ----------
    longest_s : seconds after its last use until a signature is forgotten: a deleted frame has none
    most_bytes : of all of them
    """

    def __init__(self, longest_s: float, most_bytes: int = MOST_BYTES) -> None:
        self._longest_s, self._most = longest_s, most_bytes
        self._lock = threading.Lock()
        # by frame and model, the one used longest ago first: checksum, bytes, when
        self._held: OrderedDict[tuple[int, str], tuple[int, bytes, float]] = OrderedDict()
        self._bytes = 0

    def __len__(self) -> int:
        return len(self._held)

    @property
    def bytes_held(self) -> int:
        """Memory that they take."""
        return self._bytes

    def get(self, heads: Iterable[Head], model_id: str) -> dict[int, bytes]:
        """Those that are remembered of some that the database has."""
        found, now = {}, time.monotonic()
        with self._lock:
            for head in heads:
                key = (head.number, model_id)
                held = self._held.get(key)
                if held is not None and held[0] == head.checksum:
                    found[head.number] = held[1]
                    self._held[key] = (held[0], held[1], now)
                    self._held.move_to_end(key)
        return found

    def put(self, read: Mapping[Head, bytes], model_id: str) -> None:
        """Remember signatures that were just read."""
        now = time.monotonic()
        with self._lock:
            for head, vector in read.items():
                self._drop((head.number, model_id))
                self._held[head.number, model_id] = (head.checksum, vector, now)
                self._bytes += len(vector)
            while self._held and self._bytes > self._most:
                self._drop(next(iter(self._held)))
        self.tidy()

    def tidy(self) -> None:
        """Forget what was not used for long."""
        since = time.monotonic() - self._longest_s
        with self._lock:
            while self._held:
                key, (_, _, used) = next(iter(self._held.items()))
                if used >= since:
                    return
                self._drop(key)

    def _drop(self, key: tuple[int, str]) -> None:
        held = self._held.pop(key, None)
        if held is not None:
            self._bytes -= len(held[1])
