"""Descriptors that turn one coroutine into a method of the blocking and the asynchronous client.

class MapMethods(ServiceConnection):
    @Call
    async def map(self, name: str) -> Map: ...

AsyncClient.map  is the coroutine
Client.map       runs the coroutine to its end; with httpx.Client, the coroutine never suspends
"""

from __future__ import annotations

import inspect
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine, Iterator
from functools import wraps
from types import MethodType
from typing import Any, Concatenate, Generic, ParamSpec, TypeVar, cast, overload

P = ParamSpec("P")
T = TypeVar("T")


class Blocking:
    """Base class of clients whose methods block."""


class _Method(Generic[P, T]):
    """Descriptor of a coroutine function, or, on a Blocking client, of its blocking version."""

    def __init__(self, function: Callable[..., Any], finish: Callable[[Any], object]) -> None:
        self._function = function

        @wraps(function)
        def blocking(client: Any, /, *args: Any, **kwargs: Any) -> object:
            return finish(function(client._core, *args, **kwargs))

        signature = inspect.signature(function)
        returned = str(signature.return_annotation).replace("AsyncIterator[", "Iterator[")
        blocking.__signature__ = signature.replace(return_annotation=returned)  # type: ignore[attr-defined]
        self._blocking = blocking

    def _bound(self, client: object, owner: type) -> Callable[..., Any]:
        is_core = client is not None and getattr(client, "_core", None) is None
        is_blocking = issubclass(owner, Blocking) and not is_core
        function = self._blocking if is_blocking else self._function
        return function if client is None else MethodType(function, client)


class Call(_Method[P, T]):
    """A method that sends requests and returns one result."""

    def __init__(self, function: Callable[Concatenate[Any, P], Coroutine[Any, Any, T]]) -> None:
        super().__init__(function, result_of)

    @overload
    def __get__(self, client: Blocking, owner: type) -> Callable[P, T]: ...
    @overload
    def __get__(self, client: object, owner: type) -> Callable[P, Coroutine[Any, Any, T]]: ...
    def __get__(self, client: object, owner: type) -> Callable[P, Any]:
        return self._bound(client, owner)


class Series(_Method[P, T]):
    """A method that yields items while it sends requests."""

    def __init__(self, function: Callable[Concatenate[Any, P], AsyncIterator[T]]) -> None:
        super().__init__(function, items_of)

    @overload
    def __get__(self, client: Blocking, owner: type) -> Callable[P, Iterator[T]]: ...
    @overload
    def __get__(self, client: object, owner: type) -> Callable[P, AsyncIterator[T]]: ...
    def __get__(self, client: object, owner: type) -> Callable[P, Any]:
        return self._bound(client, owner)


def result_of(coroutine: Coroutine[Any, Any, T]) -> T:
    """Return the result of a coroutine; raise AssertionError if it suspends."""
    try:
        coroutine.send(None)
    except StopIteration as end:
        return cast("T", end.value)
    raise AssertionError("a coroutine of a blocking connection does not suspend")


def items_of(items: AsyncIterator[T]) -> Iterator[T]:
    """Yield the items of an iterator that never suspends."""
    try:
        while True:
            yield result_of(cast("Coroutine[Any, Any, T]", items.__anext__()))
    except StopAsyncIteration:
        return
    finally:
        if inspect.isasyncgen(items):
            result_of(items.aclose())


async def settled(value: T | Awaitable[T]) -> T:
    """Return a value, or await it: httpx.Client returns values, httpx.AsyncClient awaitables."""
    return await value if inspect.isawaitable(value) else value
