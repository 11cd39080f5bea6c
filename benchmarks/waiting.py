"""Wait for conditions until a deadline that a crowded machine does not reach."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable
from typing import TypeVar

import httpx

T = TypeVar("T")

#: Seconds until a wait counts as a failure. Only a wait in vain lasts this long: with 20 busy
#: processes on two cores, what takes 2 s alone takes 30 s.
PATIENCE_S = 240.0


def until(condition: Callable[[], T], seconds: float = PATIENCE_S, pause_s: float = 0.02) -> T:
    """Return the first true value of a condition; raise AssertionError if none comes in time."""
    end = time.monotonic() + seconds
    while not (value := condition()):
        if time.monotonic() > end:
            raise AssertionError(f"{condition} did not come true within {seconds:g} s")
        time.sleep(pause_s)
    return value


def answers(url: str) -> bool:
    """Return whether a server answers a GET with success."""
    try:
        return httpx.get(url, trust_env=False, timeout=5).is_success
    except httpx.TransportError:
        return False


def free_port() -> int:
    """Return a port of 127.0.0.1 on which nobody listens."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
