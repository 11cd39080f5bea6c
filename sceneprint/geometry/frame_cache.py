"""What depends on one frame alone, worked out once for as long as the frame is in memory.

A query is compared with ten frames, and each of these with it on several views. Its samples, the
weights of its planes and its symmetries are the same each time.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable
from functools import wraps
from typing import Concatenate, ParamSpec, TypeVar
from weakref import WeakKeyDictionary

F = TypeVar("F")
P = ParamSpec("P")
R = TypeVar("R")


def cached_per_frame(
    function: Callable[Concatenate[F, P], R],
) -> Callable[Concatenate[F, P], R]:
    """Keep what a function returns of a surface, patches, or geometry, until that is freed.

    The first argument is known by its identity and must not change; the others must be hashable.
    What is returned is shared, so callers must not write into it.
    """
    kept: WeakKeyDictionary[F, dict[Hashable, R]] = WeakKeyDictionary()

    @wraps(function)
    def cached(frame: F, /, *args: P.args, **kwargs: P.kwargs) -> R:
        own = kept.setdefault(frame, {})
        key = args, tuple(kwargs.items())
        if key not in own:  # two threads may both work it out, and get the same
            own[key] = function(frame, *args, **kwargs)
        return own[key]

    return cached
