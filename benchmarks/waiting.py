"""Wait for a condition until a deadline that a crowded machine does not reach; tests do so, too."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")

#: Seconds until a wait counts as a failure. Nothing waits this long unless it waits in vain: with
#: 20 busy processes on two cores, what takes 2 s alone takes 30 s.
PATIENCE_S = 240.0


def until(condition: Callable[[], T], seconds: float = PATIENCE_S, pause_s: float = 0.02) -> T:
    """Return the first true value of a condition; AssertionError where none comes in time."""
    end = time.monotonic() + seconds
    while not (value := condition()):
        if time.monotonic() > end:
            raise AssertionError(f"{condition} did not come true within {seconds:g} s")
        time.sleep(pause_s)
    return value
