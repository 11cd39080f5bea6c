"""Limits: what tenants share, how often a caller may ask, and what a body may be while it arrives.

Tenants share turns at work, places to wait, and bytes. Where no key is asked for there is one
tenant, NOBODY, which shares with nobody.

A rate is a bucket of tokens for each caller: every request takes one or more, and they come back
at a steady rate; beyond, 429. A full bucket and no bucket are the same, so that those not seen for
long may be forgotten.
"""

from __future__ import annotations

import asyncio
import ipaddress
import math
import os
import re
import tempfile
import threading
import time
from collections import Counter, OrderedDict, defaultdict
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import Any, TypeVar, cast

import anyio
from anyio import to_thread
from starlette.requests import Request
from starlette.types import Message, Receive, Scope

from sceneprint.errors import Busy, RateLimited, SceneprintError, SlowBody, TooLarge
from sceneprint.process import NOBODY, current_tenant
from sceneprint.turns import TurnOrder
from sceneprint_client.api import Page

T = TypeVar("T")


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

    def by_tenant(self) -> dict[str, int]:
        """What each tenant holds that holds anything."""
        return {tenant: self._held[tenant] for tenant in list(self._held)}

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
    """Turns of requests: see TurnOrder."""

    def __init__(
        self, count: int, beside: int | None = None, clock: Callable[[], float] = time.monotonic,
        *, rests: bool = False,
    ) -> None:  # fmt: skip
        self._order: TurnOrder[asyncio.Future[None]] = TurnOrder(count, beside, clock, rests=rests)
        self._timer: asyncio.TimerHandle | None = None

    async def acquire(self, tenant: str, weight: int = 1) -> int:
        """Wait for a turn, or for several at once; returns how many: give them back."""
        turn: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        weight = self._order.enter(tenant, turn, weight)
        self._admit()
        try:
            await turn
        except asyncio.CancelledError:
            if self._order.leave(tenant, turn):
                self._admit()  # who gave up may have been in the way of others
            else:
                self.release(tenant, weight)
            raise
        return weight

    def release(self, tenant: str, weight: int = 1) -> None:
        """Give turns back."""
        self._order.release(tenant, weight)
        self._admit()

    def _admit(self) -> None:
        for turn in self._order.admit():
            if not turn.cancelled():
                turn.set_result(None)
        if self._timer is not None:
            self._timer.cancel()
        rest_s = self._order.rest_s()
        if rest_s is None:
            self._timer = None
        else:
            self._timer = asyncio.get_running_loop().call_later(rest_s, self._admit)


class SharedLooks:
    """Results of slow looks that concurrent requests share, until they are `most_s` seconds old."""

    def __init__(self, most_s: float) -> None:
        self._most_s = most_s
        self._locks = defaultdict[str, asyncio.Lock](asyncio.Lock)
        self._found: dict[str, tuple[float, Any]] = {}

    async def get(self, name: str, look: Callable[[], T]) -> T:
        """Return what a look found, or raise what it raised. `look` runs in a thread if no result
        of this name is young enough; who waits meanwhile holds no thread.
        """
        arrived = time.monotonic()
        async with self._locks[name]:
            began, found = self._found.get(name, (-math.inf, None))
            # a look that began after the request arrived is new enough, however long it took
            if began < arrived and time.monotonic() - began > self._most_s:
                began = time.monotonic()
                found = await to_thread.run_sync(_outcome, look)
                self._found[name] = began, found
        if isinstance(found, Exception):
            raise found.with_traceback(None)
        return cast(T, found)


def _outcome(do: Callable[[], object]) -> object:
    """Return what a call returns, or the exception that it raises."""
    try:
        return do()
    except Exception as error:
        return error


class Gate:
    """Lets a few pieces of heavy work run at once, some wait, and sends the rest away.

    Parameters
    ----------
    running : at once
    waiting : at most, be it for their bodies or for their turn
    longest_s : seconds to wait for a turn: an answer that comes later helps no robot
    beside : of a tenant that run at once beside another; default: half
    rests : whether tenants rest between turns: see TurnOrder
    """

    def __init__(
        self, running: int, waiting: int, longest_s: float, beside: int | None = None,
        *, rests: bool = False,
    ) -> None:  # fmt: skip
        self._turns = Turns(running, beside, rests=rests)
        self._threads = anyio.CapacityLimiter(running)
        self._longest_s = longest_s
        self._places = running + waiting
        self._taken = Holdings()

    @asynccontextmanager
    async def place(self) -> AsyncIterator[None]:
        """Hold a place. Take it before reading the body: a rejected request has then spooled
        nothing. Raise Busy if all are taken, and RateLimited if the tenant has its share.
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

    async def enter(self, do: Callable[[], T]) -> T:
        """Take a place, and do the work when it is its turn; see `place` and `run`."""
        async with self.place():
            return await self.run(do)

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


#: Requests that a query counts for, and rows of a list that count for one more.
QUERY_COST, ROWS_PER_COST = 5.0, 50
#: Rows of a list that is asked for without a limit.
_USUAL_ROWS = 100
_QUERIES = re.compile(r"/(queries|queries/records|localize|localize/sequence|similarity)$")


@dataclass(frozen=True)
class RateState:
    """How a caller stands after a request, as the RateLimit headers of the IETF draft tell it.

    Parameters
    ----------
    quota : requests that a rested caller may make at once
    window_s : seconds after which an empty bucket is full again
    left : requests that may be made now
    wait_s : seconds until there is one more
    allowed : whether this request was within the limit
    """

    name: str
    quota: int
    window_s: int
    left: int
    wait_s: int
    allowed: bool

    def headers(self) -> list[tuple[bytes, bytes]]:
        """Of draft-ietf-httpapi-ratelimit-headers-10."""
        return [
            (b"ratelimit-policy", f'"{self.name}";q={self.quota};w={self.window_s}'.encode()),
            (b"ratelimit", f'"{self.name}";r={self.left};t={self.wait_s}'.encode()),
        ]


class TokenBucket:
    """A bucket of tokens for each caller; may be used by several threads.

    Parameters
    ----------
    name : told to callers
    per_s : tokens that come back each second; 0 for no limit
    burst : tokens of a full bucket
    most : callers that are remembered; beyond, who was not seen for longest is forgotten
    clock : seconds, never going back
    """

    def __init__(
        self, name: str, per_s: float, burst: float, most: int = 10_000,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:  # fmt: skip
        self._name, self._per_s, self._burst = name, per_s, max(burst, 1.0)
        self._most, self._clock = most, clock
        self._buckets: OrderedDict[str, tuple[float, float]] = OrderedDict()
        self._lock = threading.Lock()

    def take(self, caller: str, cost: float = 1.0) -> RateState | None:
        """Take so many tokens, if they are there; None where nothing is limited."""
        if self._per_s <= 0:
            return None
        with self._lock:
            now = self._clock()
            tokens, seen = self._buckets.pop(caller, (self._burst, now))
            tokens = min(tokens + (now - seen) * self._per_s, self._burst)
            cost = min(cost, self._burst)
            allowed = tokens >= cost
            tokens -= cost * allowed
            self._keep(caller, tokens, now)
        return RateState(
            self._name,
            int(self._burst),
            math.ceil(self._burst / self._per_s),
            max(int(tokens), 0),
            math.ceil(((1 - tokens % 1) if allowed else (cost - tokens)) / self._per_s),
            allowed,
        )

    def _keep(self, caller: str, tokens: float, now: float) -> None:
        self._buckets[caller] = (tokens, now)
        if len(self._buckets) > self._most:
            self._buckets.popitem(last=False)

    @property
    def name(self) -> str:
        """What callers are told it is called."""
        return self._name

    @property
    def what(self) -> str:
        """What is limited, in words."""
        return self._name.replace("-", " ")

    def __len__(self) -> int:
        return len(self._buckets)


class RateLimits:
    """Rate limits of one service: requests of each tenant, with bursts of five seconds, and wrong
    keys of each address.
    """

    def __init__(self, requests_per_s: float, failed_per_minute: float) -> None:
        self.requests = TokenBucket("requests", requests_per_s, requests_per_s * 5)
        self.failed_keys = TokenBucket("wrong-keys", failed_per_minute / 60, failed_per_minute)


#: Refusals that a caller gets at once, then a second, and how late the others come.
REFUSALS, REFUSALS_PER_S, REFUSAL_S = 20, 10.0, 1.0
#: Refusals that are held back at once, of all callers: each holds a connection.
_MOST_HELD_BACK = 100


class RefusalDelays:
    """Holds refusals back from callers who go on asking without a pause: each costs the same to
    answer, and hundreds a second would cost others their time.
    """

    def __init__(self) -> None:
        self._bucket = TokenBucket("refusals", REFUSALS_PER_S, REFUSALS)
        self._held_back = 0

    async def wait(self, whose: str) -> None:
        """Wait before a refusal is sent to a tenant, or an address."""
        state = self._bucket.take(whose)
        if state is None or state.allowed or self._held_back >= _MOST_HELD_BACK:
            return
        self._held_back += 1
        try:
            await asyncio.sleep(REFUSAL_S)
        finally:
            self._held_back -= 1


def page_rows(request: Request) -> int:
    """Rows that a request asks for; 0 where its answer is no page."""
    model = getattr(request.scope.get("route"), "response_model", None)
    if not (isinstance(model, type) and issubclass(model, Page)):
        return 0
    given = request.query_params.get("limit", "")
    return int(given) if re.fullmatch(r"[0-9]{1,4}", given, re.ASCII) else _USUAL_ROWS


def request_cost(request: Request) -> float:
    """What a request counts for: 1, a query more, and a list by the rows that it asks for."""
    if request.method == "POST" and _QUERIES.search(request.url.path):
        return QUERY_COST
    return 1 + page_rows(request) / ROWS_PER_COST


def enforce_rate_limit(
    request: Request, bucket: TokenBucket, whose: str, cost: float = 1.0
) -> None:
    """Count a request, before its body is read; RateLimited where there are too many."""
    state = bucket.take(whose, cost)
    request.state.rate = state
    if state is not None and not state.allowed:
        raise RateLimited(
            f"Too many {bucket.what}: {state.quota} at once and then "
            f"{state.quota / state.window_s:g} a second are allowed. Retry in "
            f"{state.wait_s} s."
        )


def network_of(address: str) -> str:
    """Whose an address is: of IPv6, whoever has one has the 2^64 of its network."""
    try:
        found = ipaddress.ip_address(address.partition("%")[0])
    except ValueError:
        return "unknown"  # a socket without one: all of them together
    if isinstance(found, ipaddress.IPv6Address):
        if found.ipv4_mapped is not None:
            return str(found.ipv4_mapped)
        return str(ipaddress.ip_network((found, 64), strict=False))
    return str(found)


#: Longest silence within a body, seconds.
IDLE_S = 10.0
#: Seconds that each MiB adds to the time for a body: 2 Mbit/s, a poor radio link.
S_PER_MIB = 4.0


_IMPORTS = re.compile(r"/v1/maps/[^/]+/imports")
#: Bytes of a body that are kept in memory until they are read; the rest waits on disk. Also
#: those by which tenants are charged for that.
IN_MEMORY = 1 << 20


class Broken(Exception):
    """Stops the reading of a body; nobody but `RequestMiddleware` sees it."""


class BodySpool:
    """The temporary folder, where bodies wait to be read, and what each tenant holds of it."""

    def __init__(self) -> None:
        self._held = Holdings()

    def require_room(self, tenant: str, size: int) -> None:
        """See that a tenant may have a body of so many bytes here; RateLimited."""
        if size > IN_MEMORY and not self._held.allows(tenant, size - IN_MEMORY, self._room()):
            raise self._full(self._room())

    def take(self, tenant: str, size: int) -> None:
        """Charge a tenant for bytes that are about to be written; RateLimited beyond its share."""
        room = self._room()
        if not self._held.take(tenant, size, room):
            raise self._full(room)

    def give(self, tenant: str, size: int) -> None:
        """Take them off its account: they are removed."""
        self._held.give(tenant, size)

    def by_tenant(self) -> dict[str, int]:
        """Bytes on disk of each tenant that has any."""
        return self._held.by_tenant()

    def _room(self) -> int:
        """Bytes that all bodies together may have."""
        found = os.statvfs(tempfile.gettempdir())
        return found.f_bavail * found.f_frsize + self._held.total

    @staticmethod
    def _full(room: int) -> RateLimited:
        return RateLimited(
            f"Bodies of this key's tenant would take more than {share(room) >> 20} MiB of the "
            "service's temporary folder, which is its share. Wait for their answers, or send "
            "smaller bodies."
        )


class RequestBody:
    """The body of one request.

    The time for it grows with what has come, not with what was announced. Only time in which we
    wait for the caller counts.

    Parameters
    ----------
    receive : gives the next part
    most : bytes
    body_s : seconds for a body of hardly any bytes
    """

    def __init__(self, receive: Receive, most: int, body_s: float) -> None:
        self._receive, self._most, self._body_s = receive, most, body_s
        self._waited_s, self._bytes, self._whole = 0.0, 0, False
        #: Why no more of it is read.
        self.fault: SceneprintError | None = None
        self._spool: BodySpool | None = None
        self._tenant, self._charged = "", 0

    def charge(self, spool: BodySpool, tenant: str) -> None:
        """Charge a tenant for what is written of it to disk, before it is."""
        self._spool, self._tenant = spool, tenant

    def close(self) -> None:
        """Give back what it took: it was read, or is read no more."""
        if self._spool is not None and self._charged:
            self._spool.give(self._tenant, self._charged)
            self._charged = 0

    @property
    def received(self) -> int:
        """Bytes that have come."""
        return self._bytes

    async def next(self) -> Message:
        """Return the next part, and after the last one every further message; raise Broken, with
        the reason in `fault`.
        """
        if self._whole:
            return await self._receive()
        start = time.monotonic()
        left = self._body_s + S_PER_MIB * self._bytes / (1 << 20) - self._waited_s
        try:
            async with asyncio.timeout(min(IDLE_S, max(left, 0.0))):
                message = await self._receive()
        except TimeoutError:
            self.fault = self._slow(left)
            raise Broken from None
        self._waited_s += time.monotonic() - start
        self._bytes += len(message.get("body", b""))
        self._whole = not message.get("more_body", False)
        if self._bytes > self._most:
            self.fault = too_large(self._most)
            raise Broken
        if self._spool is not None:
            self._pay(self._spool)
        return message

    def _pay(self, spool: BodySpool) -> None:
        more = IN_MEMORY * math.ceil(self._bytes / IN_MEMORY - 1) - self._charged
        if more <= 0:
            return
        try:
            spool.take(self._tenant, more)
        except RateLimited as error:
            self.fault = error
            raise Broken from None
        self._charged += more

    def _slow(self, left: float) -> SlowBody:
        why = (
            f"no data arrived for {IDLE_S:g} s" if left >= IDLE_S else "the transfer took too long"
        )
        return SlowBody(
            f"The body arrived too slowly: {why}, after {self._bytes} bytes. The limit is "
            f"{self._body_s:g} s plus {S_PER_MIB:g} s for each MiB. Send less at once, or use a "
            "faster link."
        )


def is_import(scope: Scope) -> bool:
    """Whether the body of a request is an archive, which is written where it stays."""
    return scope["method"] == "POST" and _IMPORTS.fullmatch(scope["path"]) is not None


def too_large(most: int) -> TooLarge:
    """A body of more bytes than are taken."""
    return TooLarge(
        f"The body exceeds the limit of {most} bytes. Send the image at a lower resolution, or "
        "fewer frames at a time."
    )
