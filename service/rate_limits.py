"""Rate limits: how often a caller may ask; beyond, 429.

A bucket of tokens for each: every request takes one, and they come back at a steady rate. A full
bucket and no bucket are the same, so that those not seen for long may be forgotten.
"""

from __future__ import annotations

import ipaddress
import math
import re
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass

from starlette.requests import Request

from sceneprint.errors import RateLimited
from sceneprint_client.api import Page

#: Requests that a query counts for, and rows of a list that count for one more.
QUERY_COST, ROWS_PER_COST = 5.0, 50
#: Rows of a list that is asked for without a limit.
_USUAL_ROWS = 100
_QUERIES = re.compile(r"/(queries|localize|localize/sequence|similarity)$")


@dataclass(frozen=True)
class RateState:
    """How a caller stands after a request, as the RateLimit headers of the IETF draft tell it.

    Parameters
    ----------
    name : of the limit
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
            self._buckets[caller] = (tokens, now)
            if len(self._buckets) > self._most:
                self._buckets.popitem(last=False)
        return RateState(
            self._name,
            int(self._burst),
            math.ceil(self._burst / self._per_s),
            int(tokens),
            math.ceil(((1 - tokens % 1) if allowed else (cost - tokens)) / self._per_s),
            allowed,
        )

    @property
    def what(self) -> str:
        """What is limited, in words."""
        return self._name.replace("-", " ")

    def __len__(self) -> int:
        return len(self._buckets)


class RateLimits:
    """What callers of one service are held to.

    Parameters
    ----------
    requests_per_s : of each tenant; it may make those of five seconds at once
    failed_per_minute : wrong keys from each address
    """

    def __init__(self, requests_per_s: float, failed_per_minute: float) -> None:
        self.requests = TokenBucket("requests", requests_per_s, requests_per_s * 5)
        self.failed_keys = TokenBucket("wrong-keys", failed_per_minute / 60, failed_per_minute)


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
