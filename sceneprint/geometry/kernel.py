"""How this package compiles its loops: one decorator, one set of promises.

`nogil` lets threads of the service run kernels side by side. `cache` compiles once per
installation. Never `parallel` (a forked child dies in OpenMP), and never `fastmath`: the
compiler may then neither reorder sums nor fuse products, so that one frame gives the same
bytes on every processor. Division follows IEEE, as numpy's does: a check before each would
keep the compiler from working on eight or sixteen numbers at once, so kernels guard their
divisors themselves. For the same reason inner loops write one array each.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar, cast

import numba

P = ParamSpec("P")
R = TypeVar("R")


def kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a loop over arrays to machine code on its first call; cached on disk."""
    compiled: Any
    try:
        compiled = numba.njit(nogil=True, cache=True, error_model="numpy")(function)
    except RuntimeError:  # no folder to keep the code in: compile in every process instead
        compiled = numba.njit(nogil=True, error_model="numpy")(function)
    return cast(Callable[P, R], compiled)


def cached_at(function: Any) -> tuple[str, str]:
    """Folder and name pattern of a kernel's machine code, there once it has been compiled."""
    folder = getattr(function.stats, "cache_path", None) or ""
    return folder, f"*.{function.__name__}-*.nbi"
