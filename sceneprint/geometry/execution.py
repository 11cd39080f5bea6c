"""What saves time and changes no bit of a result: values of one frame kept, halves side by side.

What depends on one frame alone is computed once for as long as the frame is in memory: a query is
compared with ten frames, and each of these with it on several views. Its samples, the weights of
its planes and its symmetries are the same each time.

    with cores.lent():  both(first, second)  -->  both results

Validation refines two directions that know nothing of each other, and a frame's signature and its
artifact are made of one surface. Kernels hold no lock of the interpreter, so the halves of a query
take little more than half of its time, while answers stay the same to the bit. Queries share the
cores: once as many run as there are cores, each does its halves in turn.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Hashable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from functools import wraps
from typing import Concatenate, ParamSpec, TypeVar
from weakref import WeakKeyDictionary

# Values that depend on one frame alone.

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


# Two halves of a computation at once, where a core is free for the second.

A = TypeVar("A")
B = TypeVar("B")


class Cores:
    """Cores that computations of this process share.

    Parameters
    ----------
    count : of them; with 1 nothing runs at once
    """

    def __init__(self, count: int) -> None:
        self._count = count
        self._busy = 0
        self._lock = threading.Lock()
        self._pool = ThreadPoolExecutor(max(count - 1, 1), thread_name_prefix="half")

    @contextmanager
    def lent(self) -> Iterator[None]:
        """What runs within may take a second core wherever `both` is called."""
        with self._lock:
            self._busy += 1
        token = _lent.set(self)
        try:
            yield
        finally:
            _lent.reset(token)
            with self._lock:
                self._busy -= 1

    def both(self, first: Callable[[], A], second: Callable[[], B]) -> tuple[A, B]:
        """See `both` of this module."""
        with self._lock:
            free = self._busy < self._count
            self._busy += free
        if not free:
            return first(), second()
        try:
            later = self._pool.submit(second)
            try:
                return first(), later.result()
            finally:
                if not later.cancel():
                    later.exception()  # it ends before its arguments do
        finally:
            with self._lock:
                self._busy -= 1

    def close(self) -> None:
        """End the threads."""
        self._pool.shutdown()


_lent: ContextVar[Cores | None] = ContextVar("cores", default=None)


def both(first: Callable[[], A], second: Callable[[], B]) -> tuple[A, B]:
    """The results of two computations that share nothing they write.

    They run at once where `Cores.lent` allows and a core is free, else one after the other. What
    the first raises is raised, else what the second does.
    """
    cores = _lent.get()
    return (first(), second()) if cores is None else cores.both(first, second)
