"""How this package computes: loops compiled by one decorator, values of a frame kept, halves of a
computation side by side.

`nogil` lets threads of the service run kernels side by side. `cache` compiles once per
installation. Never `parallel` (a forked child dies in OpenMP), and never `fastmath`: the
compiler may then neither reorder sums nor fuse products, so that one frame gives the same
bytes on every processor. Division follows IEEE, as numpy's does: a check before each would
keep the compiler from working on eight or sixteen numbers at once, so kernels guard their
divisors themselves. For the same reason inner loops write one array each, unless the kernel is
disjoint: then the compiler knows that what it writes is nothing it reads.

A kernel's code holds that of the kernels it calls, and numbers of other files, so what is on
disk is valid for these too, and not for its own file alone, which is all that numba looks at:
see `_made_of`.

The rest saves time and changes no bit of a result. What depends on one frame alone is computed once
for as long as the frame is in memory: a query is compared with ten frames, and each of these with
it on several views. Its samples, the weights of its planes and its symmetries are the same each
time.

    with cores.lent():  both(first, second)  -->  both results

Validation refines two directions that know nothing of each other, and a frame's signature and its
artifact are made of one surface. Kernels hold no lock of the interpreter, so the halves of a query
take little more than half of its time, while answers stay the same to the bit. Queries share the
cores: once as many run as there are cores, each does its halves in turn.
"""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Callable, Hashable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from functools import update_wrapper, wraps
from operator import attrgetter
from types import CodeType, ModuleType
from typing import Any, Concatenate, ParamSpec, TypeVar, cast
from weakref import WeakKeyDictionary

import numpy as np

P = ParamSpec("P")
R = TypeVar("R")

#: The processor that wheels and images carry machine code for, in LLVM's words. All of its
#: features, so that code for it runs on whichever processor has these: x86-64 of 2013 and later.
TARGET = "x86-64-v3"
TARGET_FEATURES = (
    "+avx,+avx2,+bmi,+bmi2,+cx16,+f16c,+fma,+lzcnt,+movbe,+popcnt,+sahf,+sse3,+sse4.1,+sse4.2,"
    "+ssse3"
)

#: One thread at a time makes compilers of kernels; making one makes those that it calls.
_making = threading.RLock()


class Kernel:
    """A loop over arrays that is compiled, or loaded, when it is first called.

    numba is imported then and not before: a service answers without it.

    Parameters
    ----------
    function : of arrays and numbers
    disjoint : whether no array that it writes shares memory with another that it is given
    """

    def __init__(self, function: Callable[..., Any], *, disjoint: bool = False) -> None:
        update_wrapper(self, function)
        self.function, self._disjoint = function, disjoint
        self._known = dict(cast(dict[str, Any], getattr(function, "__globals__", {})))
        self._compiler: Any = None
        self._call: Callable[..., Any] = self._first_call
        self._stamp = ""

    #: Call the machine code: a query does so a thousand times, with nothing of Python between.
    __call__ = property(attrgetter("_call"))

    def _first_call(self, *arguments: Any) -> Any:
        return self.compiler(*arguments)

    def __reduce__(self) -> str:
        """By its name, as a function is pickled."""
        return self.function.__qualname__

    def __getattr__(self, name: str) -> Any:
        """What numba's compiler of it has: signatures, statistics, assembly."""
        if name.startswith("__"):
            raise AttributeError(name)
        return getattr(self.compiler, name)

    @property
    def _numba_type_(self) -> Any:
        """As numba sees a kernel that another kernel calls."""
        return self.compiler._numba_type_

    @property
    def compiler(self) -> Any:
        """What compiles it: numba's, with our rules of what on disk is valid."""
        if self._compiler is None:
            with _making:
                if self._compiler is None:
                    self._call = self._compiler = self._make()
        return self._compiler

    @property
    def stamp(self) -> str:
        """What its code on disk must have been made of; "" where there is none."""
        _ = self.compiler
        return self._stamp

    def _make(self) -> Any:
        import numba

        from sceneprint.geometry.kernel_cache import DisjointCompiler, KernelCache

        options: dict[str, Any] = {"pipeline_class": DisjointCompiler} if self._disjoint else {}
        compiler: Any = numba.njit(nogil=True, error_model="numpy", **options)(self.function)
        if compiler is not self.function:  # as it is under NUMBA_DISABLE_JIT, to be debugged
            cache = KernelCache(self.function)
            self._stamp = repr(cache.stamp(_made_of(self.function, self._known)))
            compiler._cache = cache
        self._known = {}
        return compiler


def kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a loop over arrays to machine code on its first call; cached on disk."""
    return cast(Callable[P, R], Kernel(function))


def disjoint_kernel(function: Callable[P, R]) -> Callable[P, R]:
    """As `kernel`, of a loop none of whose arrays shares memory with one that it writes.

    Only so can it look up scattered numbers (gather) for several elements at once: elsewhere the
    compiler must take each store for one that may change what is looked up next.
    """
    return cast(Callable[P, R], Kernel(function, disjoint=True))


class _Prefetch:
    """Ask for a row of a table that will be read soon: `prefetch(table, row)` in a kernel.

    Where rows are scattered over a table larger than the caches, each would be waited for. Only a
    hint: it changes no result, and in Python, without a compiler, it does nothing. As a kernel
    does, it imports numba when it is compiled.
    """

    def __call__(self, table: Any, row: Any) -> None:
        """Nothing to do in Python."""

    @property
    def _defn(self) -> Any:
        """What writes its code, for the stamp of kernels that use it."""
        from sceneprint.geometry.kernel_cache import prefetch_row

        return prefetch_row._defn

    @property
    def _numba_type_(self) -> Any:
        """As numba sees it in a kernel."""
        from numba.core.registry import cpu_target

        from sceneprint.geometry.kernel_cache import prefetch_row

        return cpu_target.typing_context.resolve_value_type(prefetch_row)


prefetch = _Prefetch()


def cached_at(function: Any) -> tuple[str, bool]:
    """Folder of a kernel's machine code, and whether it is there for this processor."""
    cache = getattr(function, "_cache", None)
    found: tuple[str, bool] = ("", False) if cache is None else cache.place()
    return found


def runs_here() -> bool:
    """Whether code for `TARGET` runs where we compile for."""
    from numba.core.registry import cpu_target

    from sceneprint.geometry.kernel_cache import runs_on

    return runs_on(cpu_target.target_context.codegen().magic_tuple()[2])


def _made_of(function: Callable[..., Any], known: dict[str, Any]) -> str:
    """What a kernel's code on disk must have been made of, but for its own file.

    Modules import what they use before they define anything. So all that may be built into a
    kernel is known when it is decorated, but for what stands in its own file.

    Parameters
    ----------
    known : names of its module and their values when it was decorated
    """
    told = []
    for name, value in known.items():
        key = (function.__module__, name, id(value))
        if key not in _TOLD:
            _TOLD[key] = _named(name, value, function.__module__)
        told.append(_TOLD[key])
    return hashlib.sha256(";".join(sorted(filter(None, told))).encode()).hexdigest()


#: By module, name and value: what a kernel of the module may be made of, told once.
_TOLD: dict[tuple[str, str, int], str] = {}


def _named(name: str, value: object, module: str) -> str:
    """What of a module's name can be built into its kernels; "": nothing, or its own file's."""
    if name.startswith("__"):
        return ""
    if isinstance(value, ModuleType):  # all that it has may be named by the kernel
        ours = value.__name__.startswith("sceneprint.")
        inside = vars(value).items() if ours else ()
        return ";".join(
            f"{name}.{key}={told}"
            for key, one in sorted(inside)
            if not key.startswith("__") and (told := _constant_text(one, module))
        )
    told = _constant_text(value, module)
    return f"{name}={told}" if told else ""


def _constant_text(value: Any, module: str) -> str:
    """What of a value can be built into a kernel of a module; "": nothing, or its own file's."""
    if isinstance(value, tuple):
        return f"({','.join(_constant_text(one, module) for one in value)})"
    if isinstance(value, bool | int | float | complex | str):
        return repr(value)
    if isinstance(value, np.ndarray):
        return f"{value.dtype.str} {value.shape} {hashlib.sha256(value.tobytes()).hexdigest()}"
    if getattr(value, "__module__", module) == module:
        return ""
    if isinstance(value, Kernel):
        return value.stamp
    made = getattr(value, "_defn", None)  # an intrinsic, or `prefetch`
    return "" if made is None else _code(made.__code__)


def _code(code: CodeType) -> str:
    """The bytes of a function and of those within it."""
    inner = [
        _code(one)
        if isinstance(one, CodeType)
        else repr(sorted(map(repr, one)) if isinstance(one, frozenset) else one)
        for one in code.co_consts
    ]
    return f"{code.co_code!r}{code.co_names}{inner}"


# Values that depend on one frame alone.

F = TypeVar("F")


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
