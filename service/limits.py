"""Limits: shares of tenants, request rates, and the size and speed of request bodies.

Tenants share turns, places in queues, and bytes. If no key is required, the only tenant is NOBODY,
which has no limits.

A rate limit is a token bucket per caller: each request consumes one or more tokens, and tokens are
added at a constant rate. Without enough tokens, the response is 429. A full bucket equals a missing
bucket, so the buckets of inactive callers can be dropped.
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
    """Amounts of a limited resource in use by tenants, at most three quarters per tenant."""

    def __init__(self) -> None:
        self._held: Counter[str] = Counter()
        self.total = 0

    def take(self, tenant: str, amount: int, room: int) -> bool:
        """Allocate an amount to a tenant; return False if its share of `room` does not allow it."""
        if not self.allows(tenant, amount, room):
            return False
        self._held[tenant] += amount
        self.total += amount
        return True

    def allows(self, tenant: str, amount: int, room: int) -> bool:
        """Return whether a tenant may use `amount` more within its share of `room`."""
        return tenant == NOBODY or self._held[tenant] + amount <= share(room)

    def by_tenant(self) -> dict[str, int]:
        """Return the amount in use by each tenant, without zeros."""
        return {tenant: self._held[tenant] for tenant in list(self._held)}

    def give(self, tenant: str, amount: int) -> None:
        """Release an amount of a tenant."""
        self._held[tenant] -= amount
        self.total -= amount
        if not self._held[tenant]:
            del self._held[tenant]


def share(room: int) -> int:
    """Return the amount of `room` that one tenant may use; the rest is for other tenants."""
    return max(3 * room // 4, 1)


class Turns:
    """Turns of asynchronous requests, in the order of TurnOrder."""

    def __init__(
        self, count: int, beside: int | None = None, clock: Callable[[], float] = time.monotonic,
        *, rest: float = 0.0,
    ) -> None:  # fmt: skip
        self.order: TurnOrder[asyncio.Future[None]] = TurnOrder(count, beside, clock, rest=rest)
        self._timer: asyncio.TimerHandle | None = None

    async def acquire(self, tenant: str, weight: int = 1) -> int:
        """Wait for `weight` turns; return the number of turns to release."""
        turn: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        weight = self.order.enter(tenant, turn, weight)
        self._admit()
        try:
            await turn
        except asyncio.CancelledError:
            if self.order.leave(tenant, turn):
                self._admit()  # other requests may have waited for the cancelled one
            else:
                self.release(tenant, weight)
            raise
        return weight

    def release(self, tenant: str, weight: int = 1) -> None:
        """Release turns."""
        self.order.release(tenant, weight)
        self._admit()

    def _admit(self) -> None:
        for turn in self.order.admit():
            if not turn.cancelled():
                turn.set_result(None)
        if self._timer is not None:
            self._timer.cancel()
        rest_s = self.order.rest_s()
        if rest_s is None:
            self._timer = None
        else:
            self._timer = asyncio.get_running_loop().call_later(rest_s, self._admit)


class SharedChecks:
    """Results of slow checks, shared by concurrent requests and reused for `most_s` seconds."""

    def __init__(self, most_s: float) -> None:
        self._most_s = most_s
        self._locks = defaultdict[str, asyncio.Lock](asyncio.Lock)
        self._results: dict[str, tuple[float, Any]] = {}

    async def get(self, name: str, check: Callable[[], T]) -> T:
        """Return the result of the check `name`, or raise its error. Without a recent result, run
        `check` in a thread; requests that wait for it occupy no thread.
        """
        arrived = time.monotonic()
        async with self._locks[name]:
            began, result = self._results.get(name, (-math.inf, None))
            # Also reuse a check that began after the request arrived, even if it took long.
            if began < arrived and time.monotonic() - began > self._most_s:
                began = time.monotonic()
                result = await to_thread.run_sync(_outcome, check)
                self._results[name] = began, result
        if isinstance(result, Exception):
            raise result.with_traceback(None)
        return cast(T, result)


def _outcome(do: Callable[[], object]) -> object:
    """Return the result of a call, or the exception that it raises."""
    try:
        return do()
    except Exception as error:
        return error


class Gate:
    """A limit on concurrent computations: some run, some wait, and all others are refused.

    Parameters
    ----------
    running : maximum number of running calls
    waiting : maximum number of requests that wait for their bodies or for a turn
    longest_s : maximum wait for a turn, seconds
    beside : maximum number of running calls of a tenant while others wait; default: half
    rest : pause of a tenant between turns; see TurnOrder
    """

    def __init__(
        self, running: int, waiting: int, longest_s: float, beside: int | None = None,
        *, rest: float = 0.0,
    ) -> None:  # fmt: skip
        self._turns = Turns(running, beside, rest=rest)
        self._threads = anyio.CapacityLimiter(running)
        self._longest_s = longest_s
        self._places = running + waiting
        self._taken = Holdings()

    @asynccontextmanager
    async def place(self) -> AsyncIterator[None]:
        """Hold a place. Use this before reading the body, so that refused requests spool nothing.
        Raise Busy if all places are in use, and RateLimited if the tenant has reached its share.
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
        """Return the result of a function, run while holding a place; see `place` and `run`."""
        async with self.place():
            return await self.run(do)

    async def run(self, do: Callable[[], T], *, patient: bool = False) -> T:
        """Return the result of a function, run in a thread after a wait for a turn. Needs a place.

        Parameters
        ----------
        patient : whether to wait without a limit, for requests that are expensive to repeat

        Raises
        ------
        Busy : If no turn becomes free in time; the function was not called.
        """
        tenant = current_tenant()
        await take_turn(self._turns, tenant, None if patient else self._longest_s)
        try:
            return await to_thread.run_sync(do, limiter=self._threads)
        finally:
            self._turns.release(tenant)


async def take_turn(turns: Turns, tenant: str, longest_s: float | None, weight: int = 1) -> int:
    """Return the result of `Turns.acquire`; raise Busy if it takes over `longest_s` seconds."""
    try:
        with anyio.fail_after(longest_s):
            return await turns.acquire(tenant, weight)
    except TimeoutError:
        raise Busy(
            f"The service cannot start this request within {longest_s:g} s. Nothing was stored. "
            "Retry in a second."
        ) from None


def too_many_requests(most: int) -> RateLimited:
    """Return the error for a tenant that has reached its limit of requests in progress."""
    return RateLimited(
        f"{most} requests of this key's tenant are in progress, which is the limit. Wait for "
        "their responses."
    )


#: Cost of a query, in requests, and number of rows of a list that cost one more request.
QUERY_COST, ROWS_PER_COST = 5.0, 50
#: Number of rows of a list if the request sets no limit.
_USUAL_ROWS = 100
_QUERIES = re.compile(r"/(queries|queries/records|localize|localize/sequence|similarity)$")


class TokenBucket:
    """Token buckets of callers; thread-safe.

    Parameters
    ----------
    subject : noun phrase for the error, such as "requests"
    per_s : number of tokens added per second; 0 for no limit
    burst : number of tokens in a full bucket
    most : maximum number of callers; the least recent callers are dropped
    clock : monotonic clock, seconds
    """

    def __init__(
        self, subject: str, per_s: float, burst: float, most: int = 10_000,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:  # fmt: skip
        self.subject, self._per_s, self._burst = subject, per_s, max(burst, 1.0)
        self._most, self._clock = most, clock
        self._buckets: OrderedDict[str, tuple[float, float]] = OrderedDict()
        self._lock = threading.Lock()

    def take(self, caller: str, cost: float = 1.0) -> int:
        """Consume `cost` tokens and return 0; without enough tokens, return the number of seconds
        until there are enough.
        """
        if self._per_s <= 0:
            return 0
        with self._lock:
            now = self._clock()
            tokens, at = self._buckets.pop(caller, (self._burst, now))
            tokens = min(tokens + (now - at) * self._per_s, self._burst)
            cost = min(cost, self._burst)
            lacking = max(cost - tokens, 0.0)
            self._buckets[caller] = (tokens if lacking else tokens - cost, now)
            if len(self._buckets) > self._most:
                self._buckets.popitem(last=False)
        return math.ceil(lacking / self._per_s)


#: Number of refusals without a delay, at once and per second, and delay of the others in seconds.
REFUSALS, REFUSALS_PER_S, REFUSAL_S = 20, 10.0, 1.0
#: Maximum number of concurrently delayed refusals, each of which occupies a connection.
_MOST_HELD_BACK = 100


class RefusalDelays:
    """Delays of refusals for callers that repeat refused requests without a pause."""

    def __init__(self) -> None:
        self._bucket = TokenBucket("refusals", REFUSALS_PER_S, REFUSALS)
        self._held_back = 0

    async def wait(self, whose: str) -> None:
        """Wait before a refusal is sent to a tenant or an address."""
        if self._bucket.take(whose) == 0 or self._held_back >= _MOST_HELD_BACK:
            return
        self._held_back += 1
        try:
            await asyncio.sleep(REFUSAL_S)
        finally:
            self._held_back -= 1


def page_rows(request: Request) -> int:
    """Return the number of requested rows; 0 if the response is not a page."""
    model = getattr(request.scope.get("route"), "response_model", None)
    if not (isinstance(model, type) and issubclass(model, Page)):
        return 0
    limit = request.query_params.get("limit", "")
    return int(limit) if re.fullmatch(r"[0-9]{1,4}", limit, re.ASCII) else _USUAL_ROWS


def request_cost(request: Request) -> float:
    """Return the cost of a request: 1, or more for a query or a list with many rows."""
    if request.method == "POST" and _QUERIES.search(request.url.path):
        return QUERY_COST
    return 1 + page_rows(request) / ROWS_PER_COST


def enforce_rate_limit(
    request: Request, bucket: TokenBucket, whose: str, cost: float = 1.0
) -> None:
    """Count a request, before its body is read; raise RateLimited if there are too many."""
    wait_s = bucket.take(whose, cost)
    if wait_s:
        request.state.wait_s = wait_s
        raise RateLimited(f"Too many {bucket.subject}. Retry in {wait_s} s.")


def network_of(address: str) -> str:
    """Return an IPv4 address, or the /64 network of an IPv6 address, which has one owner."""
    try:
        ip = ipaddress.ip_address(address.partition("%")[0])
    except ValueError:
        return "unknown"  # shared by all connections without an IP address
    if isinstance(ip, ipaddress.IPv6Address):
        if ip.ipv4_mapped is not None:
            return str(ip.ipv4_mapped)
        return str(ipaddress.ip_network((ip, 64), strict=False))
    return str(ip)


#: Maximum seconds without data in a body, for a whole body, and in addition for each MiB of it.
IDLE_S, BODY_S, S_PER_MIB = 10.0, 30.0, 4.0
_IMPORTS = re.compile(r"/v1/maps/[^/]+/imports")
#: Number of bytes of a body in memory; the rest is spooled to disk. Tenants are charged for disk
#: space in steps of this size.
IN_MEMORY = 1 << 20


class Broken(Exception):
    """Exception that stops reading a body; `RequestMiddleware` catches it."""


class BodySpool:
    """Disk space in the temporary folder used by spooled bodies, by tenant."""

    def __init__(self) -> None:
        self._held = Holdings()

    def require_room(self, tenant: str, size: int) -> None:
        """Raise RateLimited if a tenant may not spool a body of this size."""
        if size > IN_MEMORY and not self._held.allows(tenant, size - IN_MEMORY, self._room()):
            raise self._full(self._room())

    def take(self, tenant: str, size: int) -> None:
        """Charge a tenant for bytes before they are written; raise RateLimited beyond its share."""
        room = self._room()
        if not self._held.take(tenant, size, room):
            raise self._full(room)

    def give(self, tenant: str, size: int) -> None:
        """Refund a tenant for bytes that were deleted."""
        self._held.give(tenant, size)

    def by_tenant(self) -> dict[str, int]:
        """Return the number of spooled bytes of each tenant, without zeros."""
        return self._held.by_tenant()

    def _room(self) -> int:
        """Return the maximum number of spooled bytes of all tenants."""
        disk = os.statvfs(tempfile.gettempdir())
        return disk.f_bavail * disk.f_frsize + self._held.total

    @staticmethod
    def _full(room: int) -> RateLimited:
        return RateLimited(
            f"Bodies of this key's tenant would take more than {share(room) >> 20} MiB of the "
            "service's temporary folder, which is its share. Wait for the responses, or send "
            "smaller bodies."
        )


class RequestBody:
    """The body of one request, read within limits of size and time.

    The time limit grows with the received bytes, not with the announced length. Only time spent
    waiting for the client counts.

    Parameters
    ----------
    receive : function that returns the next message
    most : maximum size, bytes
    """

    def __init__(self, receive: Receive, most: int) -> None:
        self._receive, self._most, self._waited_s, self._whole = receive, most, 0.0, False
        self.received = 0  # bytes
        #: Error for which reading was stopped.
        self.fault: SceneprintError | None = None
        self._spool: BodySpool | None = None
        self._tenant, self._charged = "", 0

    def charge(self, spool: BodySpool, tenant: str) -> None:
        """Charge a tenant for spooled bytes of the body from now on."""
        self._spool, self._tenant = spool, tenant

    def close(self) -> None:
        """Refund the tenant, after the body was read or abandoned."""
        if self._spool is not None and self._charged:
            self._spool.give(self._tenant, self._charged)
            self._charged = 0

    async def next(self) -> Message:
        """Return the next message. Raise Broken, with the reason in `fault`, if the body is too
        large or too slow, or exceeds the tenant's disk space.
        """
        if self._whole:
            return await self._receive()
        left_s = BODY_S + S_PER_MIB * self.received / (1 << 20) - self._waited_s
        start = time.monotonic() - self._waited_s
        try:
            async with asyncio.timeout(min(IDLE_S, left_s)):
                message = await self._receive()
        except TimeoutError:
            self.fault = SlowBody(
                f"The body arrived too slowly: {self.received} bytes in "
                f"{time.monotonic() - start:.0f} s. It may take {BODY_S:g} s plus {S_PER_MIB:g} s "
                f"for each MiB, and pause for {IDLE_S:g} s. Send less, or use a faster link."
            )
            raise Broken from None
        self._waited_s = time.monotonic() - start
        self.received += len(message.get("body", b""))
        self._whole = not message.get("more_body", False)
        if self.received > self._most:
            self.fault = too_large(self._most)
            raise Broken
        more = IN_MEMORY * math.ceil(self.received / IN_MEMORY - 1) - self._charged
        if self._spool is not None and more > 0:
            try:
                self._spool.take(self._tenant, more)
            except RateLimited as error:
                self.fault = error
                raise Broken from None
            self._charged += more
        return message


def is_import(scope: Scope) -> bool:
    """Return whether the body of a request is an archive, which is not spooled."""
    return scope["method"] == "POST" and _IMPORTS.fullmatch(scope["path"]) is not None


def too_large(most: int) -> TooLarge:
    """Return the error for a body above the size limit."""
    return TooLarge(
        f"The body exceeds the limit of {most} bytes. Send the image at a lower resolution, or "
        "fewer frames at a time."
    )
