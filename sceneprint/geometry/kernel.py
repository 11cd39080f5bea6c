"""How this package compiles its loops: one decorator, one set of promises.

`nogil` lets threads of the service run kernels side by side. `cache` compiles once per
installation. Never `parallel` (a forked child dies in OpenMP), and never `fastmath`: the
compiler may then neither reorder sums nor fuse products, so that one frame gives the same
bytes on every processor. Division follows IEEE, as numpy's does: a check before each would
keep the compiler from working on eight or sixteen numbers at once, so kernels guard their
divisors themselves. For the same reason inner loops write one array each.

A kernel's code holds that of the kernels it calls, and numbers of other files, so what is on
disk is valid for these too, and not for its own file alone, which is all that numba looks at:
see `_stamp`.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from types import CodeType, ModuleType
from typing import Any, ParamSpec, TypeVar, cast

import numba
import numpy as np

P = ParamSpec("P")
R = TypeVar("R")


def kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a loop over arrays to machine code on its first call; cached on disk."""
    compiled: Any
    try:
        compiled = numba.njit(nogil=True, cache=True, error_model="numpy")(function)
        if compiled is not function:  # as it is under NUMBA_DISABLE_JIT, to be debugged
            files = compiled._cache._cache_file
            files._source_stamp = _stamp(function, files._source_stamp)
    except RuntimeError:  # no folder to keep the code in: compile in every process instead
        compiled = numba.njit(nogil=True, error_model="numpy")(function)
    return cast(Callable[P, R], compiled)


def cached_at(function: Any) -> tuple[str, str]:
    """Folder and name pattern of a kernel's machine code, there once it has been compiled."""
    folder = getattr(function.stats, "cache_path", None) or ""
    return folder, f"*.{function.__name__}-*.nbi"


def _stamp(function: Callable[..., Any], own: object) -> tuple[object, str]:
    """What a kernel's code on disk must have been made of.

    Modules import what they use before they define anything. So all that may be built into a
    kernel is known when it is decorated, but for what stands in its own file.

    Parameters
    ----------
    function : the kernel
    own : what stands for its own file
    """
    known = cast(dict[str, Any], getattr(function, "__globals__", {}))
    told = _TOLD.setdefault(function.__module__, {})
    for name, value in known.items():
        if (name, id(value)) not in told:
            told[name, id(value)] = _named(name, value, function.__module__)
    text = ";".join(sorted(each for each in told.values() if each))
    return own, hashlib.sha256(text.encode()).hexdigest()


#: By module, and in it by name and value: what a kernel of it may be made of, told once.
_TOLD: dict[str, dict[tuple[str, int], str]] = {}


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
    cache = getattr(getattr(value, "_cache", None), "_cache_file", None)
    if cache is not None:  # a kernel
        return repr(cache._source_stamp)
    made = getattr(value, "_defn", None)  # an intrinsic
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
