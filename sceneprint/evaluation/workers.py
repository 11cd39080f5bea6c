"""A map over tasks in this process or in several, with the same answers.

tasks  --map_over-->  results, in order
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from typing import Any, Protocol, TypeVar

S = TypeVar("S")
T = TypeVar("T")
R = TypeVar("R")


class Watch(Protocol):
    """Shows how far a stage has come: passes on what it is given."""

    def __call__(self, items: Iterable[T], stage: str, total: int) -> Iterable[T]:
        """Pass the items on, one by one."""
        ...


def unwatched(items: Iterable[T], stage: str, total: int) -> Iterable[T]:  # noqa: ARG001
    """Pass the items on and show nothing."""
    return items


def map_over(
    tasks: Sequence[T],
    do: Callable[[S, T], R],
    opening: Callable[[], S],
    jobs: int,
) -> Iterator[R]:
    """Do every task with what `opening` returns, which each process calls once.

    Each process holds its libraries to one thread: sums then have one order, and processes
    do not compete.

    Parameters
    ----------
    tasks : picklable, as is what comes of them
    do : a function of a module
    opening : the same, or a partial of one
    jobs : processes; 1 for this one alone

    Yields
    ------
    results : in the order of the tasks
    """
    from threadpoolctl import threadpool_limits

    jobs = min(jobs, len(tasks))
    if jobs <= 1:
        with threadpool_limits(1):
            opened = opening() if tasks else None
            for task in tasks:
                yield do(opened, task)  # type: ignore[arg-type]
        return
    context = get_context("spawn")
    with ProcessPoolExecutor(jobs, context, _start, (opening,)) as pool:
        try:
            yield from pool.map(partial(_call, do), tasks)
        finally:  # stopped half way: what is not begun is not done
            pool.shutdown(wait=True, cancel_futures=True)


#: What this process opened, if it is one of several.
_opened: list[Any] = []


def _start(opening: Callable[[], Any]) -> None:
    from threadpoolctl import threadpool_limits

    threadpool_limits(1)
    _opened[:] = [opening()]


def _call(do: Callable[[Any, Any], Any], task: Any) -> Any:
    return do(_opened[0], task)
