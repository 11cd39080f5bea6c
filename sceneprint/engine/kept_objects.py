"""Answers that are kept in the object store of a fleet: any API process finds what another gave.

    PREFIX/queries/ID       an answer, as kept.py writes it
    PREFIX/queries/.looked  when they were last gone through

Each process removes its own when they are too old or too many, without listing; what processes
left that have died goes when somebody goes through all of them, which one of the fleet does at a
time.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import deque

from sceneprint.engine.kept import (
    DAMAGED,
    HEAD,
    ID,
    MOST_QUERIES,
    Kept,
    Stands,
    read,
    read_head,
    unknown_query,
    written,
)
from sceneprint.errors import UnusableStore
from sceneprint.store.objects import Found, Objects

log = logging.getLogger(__name__)

_FOLDER, _LOOKED = "queries/", "queries/.looked"
#: Seconds that a query waits for its answer to be kept; then it goes on without.
WAIT_S = 0.5
#: Answers on their way at once; more are not kept.
_UNDER_WAY = 16
#: Objects that one request removes, and share of the time between two looks that others wait.
_AT_ONCE, _SHARE = 500, 0.9


class KeptObjects:
    """Answers under the prefix of an object store.

    Parameters
    ----------
    objects : of the prefix
    seconds : how long each is kept
    most_bytes : of those of each process, and of all when they are gone through; 0 keeps none
    purge_s : seconds after which nothing is left of what does not stand
    stands : whether one that is found may still be looked at
    """

    def __init__(
        self, objects: Objects, seconds: float, most_bytes: int, purge_s: float = 3600.0,
        stands: Stands = lambda _: True,
    ) -> None:  # fmt: skip
        self._objects, self._seconds, self._most = objects, seconds, most_bytes
        self._purge_s, self._stands = purge_s, stands
        self._slots = threading.BoundedSemaphore(_UNDER_WAY)
        self._lock = threading.Lock()
        self._own: deque[Found] = deque()  # the oldest first
        self._bytes = 0  # of those
        self._refused = False  # whether the last answer could not be kept

    def keep(self, kept: Kept) -> bool:
        """Keep an answer; False where that is not done in time. See `KeptQueries.keep`."""
        data = written(kept)
        if len(data) > self._most or not self._slots.acquire(blocking=False):
            return False
        done: list[bool] = []
        # of its own, and nobody waits for it in the end: a store that hangs costs no query more
        sending = threading.Thread(
            target=self._send, args=(kept.answer.query_id, data, done), daemon=True, name="keep"
        )
        try:
            sending.start()
        except RuntimeError:  # no more threads
            self._slots.release()
            return False
        sending.join(WAIT_S)
        return bool(done)

    def _send(self, query_id: str, data: bytes, done: list[bool]) -> None:
        try:
            self._objects.put(_FOLDER + query_id, data)
            done.append(True)
            self._refused = False
            gone = self._surplus(Found(_FOLDER + query_id, len(data), time.time()))
            if gone:
                self._objects.delete(*gone)
        except UnusableStore as error:
            if not self._refused:  # once, and not with every query
                log.warning("answers cannot be kept", extra={"error": str(error)})
            self._refused = True
        finally:
            self._slots.release()

    def _surplus(self, new: Found) -> list[str]:
        """Keys of this process's that are too old or too many, beside a new one."""
        gone = []
        with self._lock:
            self._own.append(new)
            self._bytes += new.size
            old = new.changed_at - self._seconds
            while len(self._own) > 1 and (
                self._bytes > self._most
                or len(self._own) > MOST_QUERIES
                or self._own[0].changed_at < old
            ):
                one = self._own.popleft()
                self._bytes -= one.size
                gone.append(one.key)
        return gone

    def find(self, query_id: str) -> Kept:
        """The answer of that id; see `KeptQueries.find`."""
        if ID.fullmatch(query_id):
            try:
                found = read(self._objects.get(_FOLDER + query_id))
                if found.at + self._seconds > time.time() and self._stands(found):
                    return found
            except (FileNotFoundError, *DAMAGED):
                pass
        raise unknown_query(query_id)

    def forget(self, stands: Stands) -> int:
        """Remove what is too old, too much, or does not stand; see `KeptQueries.forget`.

        Called everywhere every half of `purge_s`, and done once in the fleet: what would go by its
        age before the next time is not read.
        """
        now = time.time()
        last = self._objects.look(_LOOKED)
        if last is not None and now - last.changed_at < _SHARE * self._purge_s / 2:
            return 0
        self._objects.put(_LOOKED, b"")
        gone, total = list[str](), 0
        every = [one for one in self._objects.list(_FOLDER) if one.key != _LOOKED]
        for place, one in enumerate(sorted(every, key=lambda each: -each.changed_at)):
            total += one.size
            spent = one.changed_at + self._seconds <= now
            stays = one.changed_at + self._seconds > now + self._purge_s / 2
            if (
                spent
                or total > self._most
                or place >= MOST_QUERIES
                or (stays and not self._keeps(one, stands))
            ):
                gone.append(one.key)
        for start in range(0, len(gone), _AT_ONCE):
            self._objects.delete(*gone[start : start + _AT_ONCE])
        return len(gone)

    def _keeps(self, one: Found, stands: Stands) -> bool:
        try:
            if one.size == 0:
                return False
            beginning = self._objects.part(one.key, 0, min(HEAD, one.size))
            return stands(read_head(beginning, lambda n: self._begin(one, n)))
        except FileNotFoundError:
            return True  # another has removed it
        except DAMAGED:
            return False

    def _begin(self, one: Found, length: int) -> bytes:
        if length > one.size:
            raise ValueError("damaged: it is shorter than it says")
        return self._objects.part(one.key, 0, length)
