"""Compilation of loops to machine code, per-frame caches, and two-core execution.

Kernels release the interpreter's lock (`nogil`) and are compiled once per installation (`cache`).
They never use `parallel`, because a forked child dies in OpenMP, or `fastmath`, because the
compiler would reorder sums and fuse products: without it, a frame gives the same bytes on every
processor. Divisions do not check for zero, because the check prevents vectorization: kernels check
their divisors. For the same reason, an inner loop writes a single array, unless the kernel is
disjoint.

    with cores.shared():  run_both(first, second)  -->  both results

Validation refines two independent directions, and the signature and the artifact of a frame are
computed from the same surface: `run_both` runs two such computations on two cores if a core is
free. The results are bit-identical.
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

#: LLVM name and features of the target for which wheels and images contain machine code: x86-64
#: processors since 2013.
TARGET = "x86-64-v3"
TARGET_FEATURES = (
    "+avx,+avx2,+bmi,+bmi2,+cx16,+f16c,+fma,+lzcnt,+movbe,+popcnt,+sahf,+sse3,+sse4.1,+sse4.2,"
    "+ssse3"
)

#: Lock for creating compilers; reentrant, because a kernel creates the compilers of its callees.
_compiler_lock = threading.RLock()


class Kernel:
    """A loop over arrays that is compiled, or loaded from disk, on its first call.

    Parameters
    ----------
    function : function of arrays and numbers
    disjoint : whether the arrays that the function writes share no memory with its other arguments
    """

    def __init__(self, function: Callable[..., Any], *, disjoint: bool = False) -> None:
        update_wrapper(self, function)
        self.function, self._disjoint = function, disjoint
        self._globals = dict(cast(dict[str, Any], getattr(function, "__globals__", {})))
        self._compiler: Any = None
        self._call: Callable[..., Any] = self._first_call
        self._stamp = ""

    #: A property that returns the machine code: a method would slow down the 1,000 calls per query.
    __call__ = property(attrgetter("_call"))

    def _first_call(self, *arguments: Any) -> Any:
        return self.compiler(*arguments)

    def __reduce__(self) -> str:
        """Return the name of the kernel, so that pickle can restore it by name."""
        return self.function.__qualname__

    def __getattr__(self, name: str) -> Any:
        """Return an attribute of numba's compiler, such as its signatures."""
        if name.startswith("__"):
            raise AttributeError(name)
        return getattr(self.compiler, name)

    @property
    def _numba_type_(self) -> Any:
        """Return the type that numba uses when another kernel calls this kernel."""
        return self.compiler._numba_type_

    @property
    def compiler(self) -> Any:
        """Return numba's compiler with the cache of `kernel_cache`."""
        if self._compiler is None:
            with _compiler_lock:
                if self._compiler is None:
                    self._call = self._compiler = self._create_compiler()
        return self._compiler

    @property
    def stamp(self) -> str:
        """Return the stamp that valid code on disk carries; "" if compilation is disabled."""
        _ = self.compiler
        return self._stamp

    def _create_compiler(self) -> Any:
        import numba

        from sceneprint.geometry.kernel_cache import DisjointCompiler, KernelCache

        options: dict[str, Any] = {"pipeline_class": DisjointCompiler} if self._disjoint else {}
        compiler: Any = numba.njit(nogil=True, error_model="numpy", **options)(self.function)
        if compiler is not self.function:  # NUMBA_DISABLE_JIT returns the function itself
            cache = KernelCache(self.function)
            self._stamp = repr(cache.stamp(_hash_dependencies(self.function, self._globals)))
            compiler._cache = cache
        self._globals = {}
        return compiler


def kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a loop over arrays to machine code on its first call, and cache the code on disk."""
    return cast(Callable[P, R], Kernel(function))


def disjoint_kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a loop whose output arrays share no memory with other arguments; see `kernel`.

    Because writes cannot change the inputs, the compiler can vectorize reads of scattered numbers.
    """
    return cast(Callable[P, R], Kernel(function, disjoint=True))


class _Prefetch:
    """A function for kernels that loads a row of a table into the processor's caches.

    It hides the memory latency of scattered rows and does not change results.
    """

    def __call__(self, table: Any, row: Any) -> None:
        """Do nothing in plain Python."""

    @property
    def _defn(self) -> Any:
        """Return the function that generates the code, for the stamps of kernels that call it."""
        from sceneprint.geometry.kernel_cache import prefetch_row

        return prefetch_row._defn

    @property
    def _numba_type_(self) -> Any:
        """Return the type that numba uses in a kernel."""
        from numba.core.registry import cpu_target

        from sceneprint.geometry.kernel_cache import prefetch_row

        return cpu_target.typing_context.resolve_value_type(prefetch_row)


prefetch = _Prefetch()


def code_folder(function: Any) -> tuple[str, bool]:
    """Return the folder of a kernel's code, and whether it has code for this processor."""
    cache = getattr(function, "_cache", None)
    folder: tuple[str, bool] = ("", False) if cache is None else cache.folder()
    return folder


def runs_here() -> bool:
    """Return whether code for `TARGET` runs on the processor for which numba compiles."""
    from numba.core.registry import cpu_target

    from sceneprint.geometry.kernel_cache import runs_on

    return runs_on(cpu_target.target_context.codegen().magic_tuple()[2])


def _hash_dependencies(function: Callable[..., Any], names: dict[str, Any]) -> str:
    """Return a digest of the kernels and constants from other files that a kernel may use.

    The stamp of numba covers the kernel's file only. Imports precede definitions in our modules,
    so `names` contains all dependencies on other files.

    Parameters
    ----------
    names : global names of the kernel's module, with their values at the time of decoration
    """
    texts = []
    for name, value in names.items():
        key = (function.__module__, name, id(value))
        if key not in _DEPENDENCIES:
            _DEPENDENCIES[key] = _dependency_text(name, value, function.__module__)
        texts.append(_DEPENDENCIES[key])
    return hashlib.sha256(";".join(sorted(filter(None, texts))).encode()).hexdigest()


#: Cached results of `_dependency_text`, by module, name and identity of the value.
_DEPENDENCIES: dict[tuple[str, str, int], str] = {}


def _dependency_text(name: str, value: object, module: str) -> str:
    """Return the content of a global name of a kernel; "" if the kernel's file defines it."""
    if name.startswith("__"):
        return ""
    if isinstance(value, ModuleType):  # a kernel may use any of its attributes
        ours = value.__name__.startswith("sceneprint.")
        inside = vars(value).items() if ours else ()
        return ";".join(
            f"{name}.{key}={text}"
            for key, attribute in sorted(inside)
            if not key.startswith("__") and (text := _constant_text(attribute, module))
        )
    text = _constant_text(value, module)
    return f"{name}={text}" if text else ""


def _constant_text(value: Any, module: str) -> str:
    """Return the content of a value that a kernel can use; "" if the kernel's file defines it."""
    if isinstance(value, tuple):
        return f"({','.join(_constant_text(item, module) for item in value)})"
    if isinstance(value, bool | int | float | complex | str):
        return repr(value)
    if isinstance(value, np.ndarray):
        return f"{value.dtype.str} {value.shape} {hashlib.sha256(value.tobytes()).hexdigest()}"
    if getattr(value, "__module__", module) == module:
        return ""
    if isinstance(value, Kernel):
        return value.stamp
    generator = getattr(value, "_defn", None)  # an intrinsic, or `prefetch`
    return "" if generator is None else _code_text(generator.__code__)


def _code_text(code: CodeType) -> str:
    """Return the bytecode of a function and of its inner functions."""
    inner = [
        _code_text(item)
        if isinstance(item, CodeType)
        else repr(sorted(map(repr, item)) if isinstance(item, frozenset) else item)
        for item in code.co_consts
    ]
    return f"{code.co_code!r}{code.co_names}{inner}"


F = TypeVar("F")


def cached_per_frame(
    function: Callable[Concatenate[F, P], R],
) -> Callable[Concatenate[F, P], R]:
    """Cache the results of a function for the lifetime of its first argument (such as a surface).

    The first argument is compared by identity and must not change. Other arguments are hashable.
    Callers share the results and must not modify them.
    """
    results: WeakKeyDictionary[F, dict[Hashable, R]] = WeakKeyDictionary()

    @wraps(function)
    def cached(frame: F, /, *args: P.args, **kwargs: P.kwargs) -> R:
        own = results.get(frame)
        if own is None:
            own = results.setdefault(frame, {})
        key = args, tuple(kwargs.items())
        if key not in own:  # two threads may compute the same result; either may be stored
            own[key] = function(frame, *args, **kwargs)
        return own[key]

    return cached


A = TypeVar("A")
B = TypeVar("B")


class Cores:
    """The processor cores that the computations of this process share.

    Parameters
    ----------
    count : number of cores; 1 disables parallel computation
    """

    def __init__(self, count: int) -> None:
        self._count = count
        self._busy = 0
        self._lock = threading.Lock()
        self._pool = ThreadPoolExecutor(max(count - 1, 1), thread_name_prefix="half")

    @contextmanager
    def shared(self) -> Iterator[None]:
        """Occupy a core during the `with` block; there, `run_both` may use a second, free core."""
        with self._lock:
            self._busy += 1
        token = _cores.set(self)
        try:
            yield
        finally:
            _cores.reset(token)
            with self._lock:
                self._busy -= 1

    def run_both(self, first: Callable[[], A], second: Callable[[], B]) -> tuple[A, B]:
        """Run two computations, in parallel if a core is free; see the function `run_both`."""
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
                    later.exception()  # wait: it may still use the caller's arguments
        finally:
            with self._lock:
                self._busy -= 1

    def close(self) -> None:
        """End the threads."""
        self._pool.shutdown()


_cores: ContextVar[Cores | None] = ContextVar("cores", default=None)


def run_both(first: Callable[[], A], second: Callable[[], B]) -> tuple[A, B]:
    """Run two computations that do not write to shared memory; return their results.

    They run in parallel within `Cores.shared` if a core is free, otherwise sequentially. If both
    raise an exception, the exception of `first` is raised.
    """
    cores = _cores.get()
    return (first(), second()) if cores is None else cores.run_both(first, second)
