"""When a query must be answered, and whether there is time for one more candidate."""

from __future__ import annotations

import time

#: Seconds that the first candidate is expected to take; the next ones, as long as the longest.
FIRST_S = 0.03


class Deadline:
    """A point in time after which nothing more is begun.

    Parameters
    ----------
    milliseconds : after `since`; None for no deadline
    since : when the request came, by `time.perf_counter`; default: now
    """

    def __init__(self, milliseconds: int | None, since: float | None = None) -> None:
        since = time.perf_counter() if since is None else since
        self._ends = None if milliseconds is None else since + milliseconds / 1e3
        self._longest, self._began = FIRST_S, 0.0
        self.reached: bool | None = None if milliseconds is None else False

    def allows(self) -> bool:
        """Whether one more candidate would likely be over in time; ask before each."""
        if self._ends is None:
            return True
        now = time.perf_counter()
        if self._began:
            self._longest = max(self._longest, now - self._began)
        self._began = now
        self.reached = now + self._longest > self._ends
        return not self.reached
