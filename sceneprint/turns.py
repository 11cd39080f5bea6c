"""Turns: what tenants share goes round among them, however much one of them asks for.

    enter  -->  waiting  --admit-->  holding  --release-->      TurnOrder: who is next
    ThreadTurns.acquire, release                                between threads

The next is who holds fewest, and of equals who was served the longest ago.
"""

from __future__ import annotations

import threading
import time
from collections import Counter, OrderedDict, deque
from collections.abc import Callable
from typing import Generic, TypeVar

Waiter = TypeVar("Waiter")

#: Seconds after it last asked in which a tenant counts as one to share turns with.
PRESENT_S = 60.0
#: Seconds after it last asked in which others rest after their turns for a tenant, and most that
#: they rest.
ACTIVE_S = 1.0


class TurnOrder(Generic[Waiter]):
    """Who waits, who holds turns, and who is next; not safe to share between threads.

    Beside another tenant one holds `beside` turns at most, so that the other need not wait for the
    work of the first to end; alone it has all.

    Parameters
    ----------
    count : of turns that are held at once
    beside : most that one tenant holds while there is another; default: half of them
    clock : seconds, never going back
    rests : whether a tenant waits after its turn as long as that took, a second at most, while
        another is active: its work has the processors that others need for half of the time
    """

    def __init__(
        self, count: int, beside: int | None = None, clock: Callable[[], float] = time.monotonic,
        *, rests: bool = False,
    ) -> None:  # fmt: skip
        self._count, self._clock, self._rests = count, clock, rests
        self._beside = max(count // 2, 1) if beside is None else beside
        self._held: Counter[str] = Counter()
        self._waiting: dict[str, deque[tuple[int, Waiter]]] = {}
        # when each tenant came last, and the number of its latest turn; the oldest first
        self._seen: OrderedDict[str, tuple[float, int]] = OrderedDict()
        self._given = 0
        # when each tenant got its latest turn, and until when it rests
        self._began: dict[str, float] = {}
        self._resting: dict[str, float] = {}
        self._rested_at: float | None = None

    def enter(self, tenant: str, waiter: Waiter, weight: int = 1) -> int:
        """Wait for a turn, or for several at once; returns how many those are."""
        weight = min(weight, max(self._count // 2, 1))
        self._see(tenant)
        self._waiting.setdefault(tenant, deque()).append((weight, waiter))
        return weight

    def leave(self, tenant: str, waiter: Waiter) -> bool:
        """Wait no longer; False for who does not wait: it was admitted."""
        for one in self._waiting.get(tenant, ()):
            if one[1] is waiter:
                self._waiting[tenant].remove(one)
                if not self._waiting[tenant]:
                    del self._waiting[tenant]
                return True
        return False

    def admit(self) -> list[Waiter]:
        """Give turns to those whose turn it is; they hold them from now on."""
        admitted: list[Waiter] = []
        most = self._count if len(self._seen) < 2 else self._beside
        while True:
            now = self._clock()
            resting = {one for one in self._waiting if self._is_resting(one, now)}
            self._rested_at = min((self._resting[one] for one in resting), default=None)
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
                return admitted  # nobody overtakes who waits for several
            self._given += 1
            self._held[tenant] += weight
            self._began[tenant] = now
            self._seen[tenant] = self._seen[tenant][0], self._given
            waiter = self._waiting[tenant][0][1]
            self.leave(tenant, waiter)
            admitted.append(waiter)

    def release(self, tenant: str, weight: int = 1) -> None:
        """Give turns back."""
        self._held[tenant] -= weight
        if not self._held[tenant]:
            del self._held[tenant]
            now, began = self._clock(), self._began.pop(tenant)
            if self._rests and self._is_beside(tenant, now):
                self._resting[tenant] = now + min(now - began, ACTIVE_S)

    def rest_s(self) -> float | None:
        """Seconds until `admit` should be called again for those who rested; None for none."""
        return None if self._rested_at is None else max(self._rested_at - self._clock(), 0.0)

    def waiters(self) -> list[Waiter]:
        """All who wait."""
        return [one for queue in self._waiting.values() for _, one in queue]

    def _is_resting(self, tenant: str, now: float) -> bool:
        """Whether a tenant rests yet."""
        until = self._resting.get(tenant)
        if until is None:
            return False
        if until <= now or not self._is_beside(tenant, now):
            del self._resting[tenant]
            return False
        return True

    def _is_beside(self, tenant: str, now: float) -> bool:
        """Whether another tenant asked a moment ago."""
        others = (seen for one, (seen, _) in reversed(self._seen.items()) if one != tenant)
        latest = next(others, None)
        return latest is not None and latest > now - ACTIVE_S

    def _see(self, tenant: str) -> None:
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
    """Turns of threads.

    Parameters
    ----------
    count, beside : see TurnOrder
    """

    def __init__(self, count: int, beside: int | None = None) -> None:
        self._order: TurnOrder[threading.Lock] = TurnOrder(count, beside)
        self._lock = threading.Lock()
        self._closed = False

    def acquire(self, tenant: str, longest_s: float) -> bool:
        """Wait for a turn; False where none comes in time, or none will: see `close`."""
        mine = threading.Lock()  # one that is held until somebody gives it the turn
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
        """Give a turn back."""
        with self._lock:
            self._order.release(tenant)
            self._admit()

    def close(self) -> None:
        """Give no more turns; who waits is told at once."""
        with self._lock:
            self._closed = True
            for one in self._order.waiters():
                one.release()

    def _leave(self, tenant: str, mine: threading.Lock) -> bool:
        with self._lock:
            if not self._order.leave(tenant, mine):
                return False
            self._admit()  # it may have been in the way of others
            return True

    def _admit(self) -> None:
        if not self._closed:
            for one in self._order.admit():
                one.release()
