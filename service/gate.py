"""How tenants share what a service has only so much of: turns at work, places to wait, bytes.

Where no key is asked for there is one tenant, NOBODY, which shares with nobody.
"""

from __future__ import annotations

import asyncio
import time
from collections import Counter, OrderedDict, deque
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import TypeVar

import anyio
from anyio import to_thread

from sceneprint.errors import Busy, RateLimited
from sceneprint.store.tenants import NOBODY, current_tenant

T = TypeVar("T")

#: Seconds after its last request in which a tenant counts as one to share turns with.
PRESENT_S = 60.0


class Holdings:
    """What each tenant holds of something that there is so much of: three quarters at most."""

    def __init__(self) -> None:
        self._held: Counter[str] = Counter()
        self.total = 0

    def take(self, tenant: str, amount: int, room: int) -> bool:
        """Let a tenant hold more, where its share of all the room allows; whether it does."""
        if not self.allows(tenant, amount, room):
            return False
        self._held[tenant] += amount
        self.total += amount
        return True

    def allows(self, tenant: str, amount: int, room: int) -> bool:
        """Whether a tenant may hold so much more."""
        return tenant == NOBODY or self._held[tenant] + amount <= share(room)

    def give(self, tenant: str, amount: int) -> None:
        """Take back from a tenant what it held."""
        self._held[tenant] -= amount
        self.total -= amount
        if not self._held[tenant]:
            del self._held[tenant]


def share(room: int) -> int:
    """How much of some room a tenant may hold; the rest is for others."""
    return max(3 * room // 4, 1)


class Turns:
    """Turns at work: who holds fewest is next, and of equals who was served the longest ago.

    Beside another tenant one has half of them at most, so that the other need not wait for the
    work of the first to end; alone it has all.

    Parameters
    ----------
    count : of turns that are held at once
    clock : seconds, never going back
    """

    def __init__(self, count: int, clock: Callable[[], float] = time.monotonic) -> None:
        self._count, self._clock = count, clock
        self._held: Counter[str] = Counter()
        self._waiting: dict[str, deque[tuple[int, asyncio.Future[None]]]] = {}
        # when each tenant came last, and the number of its latest turn; the oldest first
        self._seen: OrderedDict[str, tuple[float, int]] = OrderedDict()
        self._given = 0

    async def acquire(self, tenant: str, weight: int = 1) -> int:
        """Wait for a turn, or for several at once; returns how many: give them back."""
        weight = min(weight, max(self._count // 2, 1))
        turn: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._see(tenant)
        self._waiting.setdefault(tenant, deque()).append((weight, turn))
        self._admit()
        try:
            await turn
        except asyncio.CancelledError:
            if turn.done() and not turn.cancelled():
                self.release(tenant, weight)
            else:
                self._admit()  # who gave up may have been in the way of others
            raise
        return weight

    def release(self, tenant: str, weight: int = 1) -> None:
        """Give turns back."""
        self._held[tenant] -= weight
        if not self._held[tenant]:
            del self._held[tenant]
        self._admit()

    def _see(self, tenant: str) -> None:
        now = self._clock()
        _, turn = self._seen.pop(tenant, (now, 0))
        self._seen[tenant] = now, turn
        while True:
            first, (seen, _) = next(iter(self._seen.items()))
            if seen > now - PRESENT_S:
                return
            if first in self._held or first in self._waiting:
                self._seen[first] = now, self._seen.pop(first)[1]
            else:
                del self._seen[first]

    def _admit(self) -> None:
        most = self._count if len(self._seen) < 2 else max(self._count // 2, 1)
        while True:
            for tenant in list(self._waiting):
                queue = self._waiting[tenant]
                while queue and queue[0][1].cancelled():
                    queue.popleft()
                if not queue:
                    del self._waiting[tenant]
            may = [
                (self._held[tenant], self._seen[tenant][1], tenant, queue[0][0])
                for tenant, queue in self._waiting.items()
                if self._held[tenant] + queue[0][0] <= most
            ]
            if not may:
                return
            _, _, tenant, weight = min(may)
            if sum(self._held.values()) + weight > self._count:
                return  # nobody overtakes who waits for several
            self._given += 1
            self._held[tenant] += weight
            self._seen[tenant] = self._seen[tenant][0], self._given
            self._waiting[tenant].popleft()[1].set_result(None)


class Gate:
    """Lets a few pieces of heavy work run at once, some wait, and sends the rest away.

    Parameters
    ----------
    running : at once
    waiting : at most, be it for their bodies or for their turn
    longest_s : seconds to wait for a turn: an answer that comes later helps no robot
    """

    def __init__(self, running: int, waiting: int, longest_s: float) -> None:
        self._turns, self._threads = Turns(running), anyio.CapacityLimiter(running)
        self._longest_s = longest_s
        self._places = running + waiting
        self._taken = Holdings()

    @asynccontextmanager
    async def place(self) -> AsyncIterator[None]:
        """A place inside. Take it before the body is read: who is sent away has spooled nothing.

        Raises
        ------
        Busy : as many are inside as may.
        RateLimited : as many of the tenant are.
        """
        tenant = current_tenant()
        if self._taken.total >= self._places:
            raise Busy("The queue of uploads and queries is full. Retry in a second.")
        if not self._taken.take(tenant, 1, self._places):
            raise too_many_requests(share(self._places))
        try:
            yield
        finally:
            self._taken.give(tenant, 1)

    async def run(self, do: Callable[[], T], *, patient: bool = False) -> T:
        """Do it in a thread, off the event loop, when it is its turn; for who has a place.

        Parameters
        ----------
        do : the work
        patient : wait for as long as it takes: much would have to be sent again

        Raises
        ------
        Busy : its turn did not come in time; nothing was begun.
        """
        tenant = current_tenant()
        await take_turn(self._turns, tenant, None if patient else self._longest_s)
        try:
            return await to_thread.run_sync(do, limiter=self._threads)
        finally:
            self._turns.release(tenant)


async def take_turn(turns: Turns, tenant: str, longest_s: float | None, weight: int = 1) -> int:
    """Wait for a turn, but not for too long: see `Turns.acquire`; Busy where none came in time."""
    try:
        with anyio.fail_after(longest_s):
            return await turns.acquire(tenant, weight)
    except TimeoutError:
        raise Busy(
            f"The service cannot start this request within {longest_s:g} s. Nothing was stored. "
            "Retry in a second."
        ) from None


def too_many_requests(most: int) -> RateLimited:
    """That a tenant has as many requests in progress as it may."""
    return RateLimited(
        f"{most} requests of this key's tenant are in progress, which is the limit. Wait for "
        "their answers."
    )
