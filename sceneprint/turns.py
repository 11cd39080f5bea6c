"""Fair scheduling of a limited number of turns among tenants, regardless of their request rates.

    enter  -->  waiting  --admit-->  holding  --release-->      TurnOrder
    ThreadTurns.acquire, release                                for threads

The next turn goes to the tenant that holds the fewest turns; among equals, to the one whose latest
turn is the oldest.
"""

from __future__ import annotations

import threading
import time
from collections import Counter, OrderedDict, deque
from collections.abc import Callable
from typing import Generic, TypeVar

Waiter = TypeVar("Waiter")

#: Seconds after its latest request for which a tenant counts as present, so that others leave turns
#: for it.
PRESENT_S = 60.0
#: Seconds after its latest request for which a tenant counts as active, so that others rest; also
#: the maximum rest.
ACTIVE_S = 1.0


class TurnOrder(Generic[Waiter]):
    """The tenants that wait for turns or hold turns, and the order of admission. Not thread-safe.

    If several tenants are present, each may hold at most `beside` turns, so that turns remain for
    the others. A single tenant may hold all turns.

    Parameters
    ----------
    count : total number of turns
    beside : maximum number of turns per tenant if several tenants are present; None selects half of
        `count`
    clock : monotonic clock, seconds
    rest : time for which a tenant rests after its turns while another tenant is active, as a
        multiple of their duration (at most ACTIVE_S); with 1, it uses at most half of the time
    """

    def __init__(
        self, count: int, beside: int | None = None, clock: Callable[[], float] = time.monotonic,
        *, rest: float = 0.0,
    ) -> None:  # fmt: skip
        self._count, self._clock, self._rest = count, clock, rest
        self._beside = max(count // 2, 1) if beside is None else beside
        self._held: Counter[str] = Counter()
        self._waiting: dict[str, deque[tuple[int, Waiter]]] = {}
        # time of each tenant's latest request, and number of its latest turn; oldest request first
        self._seen: OrderedDict[str, tuple[float, int]] = OrderedDict()
        self._turns = 0
        # start of each tenant's latest turn, and end of its rest
        self._began: dict[str, float] = {}
        self._resting: dict[str, float] = {}
        self._rested_at: float | None = None

    def enter(self, tenant: str, waiter: Waiter, weight: int = 1) -> int:
        """Add a waiter for `weight` turns (at most half of all) at once; return their number."""
        weight = min(weight, max(self._count // 2, 1))
        self.record_request(tenant)
        self._waiting.setdefault(tenant, deque()).append((weight, waiter))
        return weight

    def leave(self, tenant: str, waiter: Waiter) -> bool:
        """Remove a waiter; return False if it has already been admitted."""
        for entry in self._waiting.get(tenant, ()):
            if entry[1] is waiter:
                self._waiting[tenant].remove(entry)
                if not self._waiting[tenant]:
                    del self._waiting[tenant]
                return True
        return False

    def admit(self) -> list[Waiter]:
        """Admit and return the next waiters, in order."""
        admitted: list[Waiter] = []
        most = self._count if len(self._seen) < 2 else self._beside
        while True:
            now = self._clock()
            resting = {name for name in self._waiting if self._is_resting(name, now)}
            self._rested_at = min((self._resting[name] for name in resting), default=None)
            may = [
                (self._held[tenant], self._seen[tenant][1], tenant, queue[0][0])
                for tenant, queue in self._waiting.items()
                if tenant not in resting
                and (not self._held[tenant] or self._held[tenant] + queue[0][0] <= most)
            ]
            if not may:
                return admitted
            _, _, tenant, weight = min(may)
            if self._held.total() + weight > self._count:
                return admitted  # a waiter for several turns must not be overtaken
            self._turns += 1
            self._held[tenant] += weight
            self._began[tenant] = now
            self._seen[tenant] = self._seen[tenant][0], self._turns
            waiter = self._waiting[tenant][0][1]
            self.leave(tenant, waiter)
            admitted.append(waiter)

    def release(self, tenant: str, weight: int = 1) -> None:
        """Release `weight` turns of a tenant."""
        self._held[tenant] -= weight
        if not self._held[tenant]:
            del self._held[tenant]
            now, began = self._clock(), self._began.pop(tenant)
            if self._rest and self._others_are_active(tenant, now):
                self._resting[tenant] = now + min(self._rest * (now - began), ACTIVE_S)

    def rest_s(self) -> float | None:
        """Return the seconds until the first rest of a waiting tenant ends; None if none rests."""
        return None if self._rested_at is None else max(self._rested_at - self._clock(), 0.0)

    def waiters(self) -> list[Waiter]:
        """Return all waiters."""
        return [waiter for queue in self._waiting.values() for _, waiter in queue]

    def _is_resting(self, tenant: str, now: float) -> bool:
        until = self._resting.get(tenant)
        if until is None:
            return False
        if until <= now or not self._others_are_active(tenant, now):
            del self._resting[tenant]
            return False
        return True

    def _others_are_active(self, tenant: str, now: float) -> bool:
        """Return whether another tenant sent a request within the last ACTIVE_S."""
        others = (seen for other, (seen, _) in reversed(self._seen.items()) if other != tenant)
        latest = next(others, None)
        return latest is not None and latest > now - ACTIVE_S

    def record_request(self, tenant: str) -> None:
        """Record a request of a tenant, even without a turn, so that others share and rest."""
        now = self._clock()
        self._seen[tenant] = now, self._seen.pop(tenant, (now, 0))[1]
        while True:
            first, (seen, turn) = next(iter(self._seen.items()))
            if seen > now - PRESENT_S:
                return
            del self._seen[first]
            self._resting.pop(first, None)
            if first in self._held or first in self._waiting:
                self._seen[first] = now, turn


class ThreadTurns:
    """Turns for threads; see TurnOrder."""

    def __init__(self, count: int, beside: int | None = None) -> None:
        self._order: TurnOrder[threading.Lock] = TurnOrder(count, beside)
        self._lock = threading.Lock()
        self._closed = False

    def acquire(self, tenant: str, longest_s: float) -> bool:
        """Wait at most `longest_s` seconds for a turn; return whether the thread now holds one.

        Return False after `close`.
        """
        mine = threading.Lock()  # released when this thread is admitted
        mine.acquire()
        with self._lock:
            if self._closed:
                return False
            self._order.enter(tenant, mine)
            self._admit()
        try:
            mine.acquire(timeout=longest_s)
        except BaseException:  # such as Ctrl-C
            if not self._leave(tenant, mine):
                self.release(tenant)
            raise
        return not self._leave(tenant, mine)

    def release(self, tenant: str) -> None:
        """Release a turn of a tenant."""
        with self._lock:
            self._order.release(tenant)
            self._admit()

    def close(self) -> None:
        """Wake all waiting threads, and admit no more threads."""
        with self._lock:
            self._closed = True
            for waiter in self._order.waiters():
                waiter.release()

    def _leave(self, tenant: str, mine: threading.Lock) -> bool:
        with self._lock:
            if not self._order.leave(tenant, mine):
                return False
            self._admit()  # this waiter may have blocked others
            return True

    def _admit(self) -> None:
        if not self._closed:
            for waiter in self._order.admit():
                waiter.release()
