"""How this package compiles its loops: one decorator, one set of promises.

`nogil` lets threads of the service run kernels side by side. `cache` compiles once per
installation. Never `parallel` (a forked child dies in OpenMP), and never `fastmath`: the
compiler may then neither reorder sums nor fuse products, so that one frame gives the same
bytes on every processor.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar, cast

import numba

P = ParamSpec("P")
R = TypeVar("R")


def kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a loop over arrays to machine code on its first call; cached on disk."""
    return cast(Callable[P, R], numba.njit(nogil=True, cache=True)(function))


def cached_at(function: Any) -> tuple[str, str]:
    """Folder and name pattern of a kernel's machine code, there once it has been compiled."""
    return function.stats.cache_path, f"*.{function.__name__}-*.nbi"
