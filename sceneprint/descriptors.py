"""How many files a process may have open: each mapped segment of an index takes a descriptor."""

from __future__ import annotations

import resource

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
