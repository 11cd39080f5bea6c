"""Waits for conditions, with a deadline that a busy machine does not reach."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable
from typing import TypeVar

import httpx

T = TypeVar("T")

#: Time after which a wait has failed, seconds. With 20 busy processes on two cores, an operation of
#: 2 s takes 30 s.
PATIENCE_S = 240.0


def until(condition: Callable[[], T], seconds: float = PATIENCE_S, pause_s: float = 0.02) -> T:
    """Return the first true value of a condition; raise AssertionError after the deadline."""
    end = time.monotonic() + seconds
    while not (value := condition()):
        if time.monotonic() > end:
            raise AssertionError(f"{condition} did not become true within {seconds:g} s")
        time.sleep(pause_s)
    return value


def answers(url: str) -> bool:
    """Return whether a server answers a GET with success."""
    try:
        return httpx.get(url, trust_env=False, timeout=5).is_success
    except httpx.TransportError:
        return False


def free_port() -> int:
    """Return a port of 127.0.0.1 without a listener."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
