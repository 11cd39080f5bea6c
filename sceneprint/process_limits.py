"""How many files a process may have open: each mapped segment of an index takes a descriptor."""

from __future__ import annotations

import os
import re
import resource
import select
import signal
from pathlib import Path
from types import FrameType

#: Enough for any number of maps; some systems allow a billion, and programs that close them all
#: one by one then take minutes to start.
MOST = 1 << 20


def raise_descriptors() -> int:
    """Let this process have as many files open as the system lets it; returns how many."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = MOST if hard == resource.RLIM_INFINITY else min(hard, MOST)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
        return wanted
    return MOST if soft == resource.RLIM_INFINITY else soft


# What a worker process may take, and how it is told to stop.


def limit_memory(more: int) -> None:
    """Let this process take so many bytes more than it has; what needs more raises MemoryError.

    Counted is what it writes to itself, on the heap or not: tables and indexes are mapped from
    files, and cost nobody anything.

    Parameters
    ----------
    more : bytes; 0 for no limit
    """
    if more == 0:
        return
    found = re.search(r"^VmData:\s+(\d+) kB", Path("/proc/self/status").read_text(), re.MULTILINE)
    if found is None:
        return
    wanted, (_, most) = int(found[1]) * 1024 + more, resource.getrlimit(resource.RLIMIT_DATA)
    if most != resource.RLIM_INFINITY:
        wanted = min(wanted, most)
    resource.setrlimit(resource.RLIMIT_DATA, (wanted, most))


class StopSignal:
    """Whether SIGTERM or SIGINT has come; made once, in the main thread.

    Attributes
    ----------
    asked : whether one has
    descriptor : readable from then on
    """

    def __init__(self) -> None:
        self.asked = False
        self.descriptor, told = os.pipe()
        os.set_blocking(told, False)
        signal.set_wakeup_fd(told, warn_on_full_buffer=False)
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._ask)

    def wait(self, seconds: float) -> None:
        """Until one has come, or the time is over."""
        select.select([self.descriptor], [], [], seconds)

    def _ask(self, _number: int, _frame: FrameType | None) -> None:
        self.asked = True
