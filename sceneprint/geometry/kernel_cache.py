"""Cache of the kernels' machine code, in numba's folder or shipped in a wheel or image.

numba stores code under the name of the processor on which it was compiled. Code that is shipped
with an installation is compiled for `TARGET`, and lies in numba's folder or beside the sources. The
folder may be read-only. Importing numba takes long, so `kernel` imports this module on the first
call.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite import binding, ir
from numba.core import cgutils, types
from numba.core.caching import (
    CompileResultCacheImpl,
    FunctionCache,
    IndexDataCacheFile,
    InTreeCacheLocator,
)
from numba.core.compiler import Compiler
from numba.core.registry import cpu_target
from numba.extending import intrinsic

from sceneprint.geometry.kernel import TARGET, TARGET_FEATURES


class DisjointCompiler(Compiler):
    """A compiler of kernels whose output arrays share no memory with other arguments."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.state.flags.noalias = True


def _prefetch_row(_context: Any, table: Any, row: Any) -> Any:
    """Prefetch the first 128 bytes (two cache lines) of a row of a C-contiguous table.

    Take numba types; return the signature of a call and its code generator.
    """
    signature = types.void(table, row)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array = context.make_array(signature.args[0])(context, builder, arguments[0])
        at = context.cast(builder, arguments[1], signature.args[1], types.intp)
        length = cgutils.unpack_tuple(builder, array.strides)[0]
        byte, number = ir.IntType(8), ir.IntType(32)
        kinds = [byte.as_pointer(), number, number, number]
        function = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(ir.VoidType(), kinds), "llvm.prefetch.p0i8"
        )
        start = builder.bitcast(array.data, byte.as_pointer())
        start = builder.gep(start, [builder.mul(at, length)])
        # the flags mean: prefetch for reading, into all levels of the cache, as data
        flags = [ir.Constant(number, value) for value in (0, 3, 1)]
        for offset in (0, 64):
            line = builder.gep(start, [ir.Constant(ir.IntType(64), offset)])
            builder.call(function, [line, *flags])
        return context.get_dummy_value()

    return signature, generate


prefetch_row: Any = intrinsic(_prefetch_row)


class _BesideTheSource(InTreeCacheLocator):
    """A locator of code beside the sources, for installations without a writable folder."""

    def ensure_cache_path(self) -> None:
        """Do nothing: the folder may be read-only."""


class _Locations(CompileResultCacheImpl):
    _locator_classes = [*CompileResultCacheImpl._locator_classes, _BesideTheSource]  # noqa: RUF012


class KernelCache(FunctionCache):
    """The machine code of a kernel on disk."""

    _impl_class = _Locations

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        locator = self._impl.locator
        beside = InTreeCacheLocator(function, locator._py_file).get_cache_path()
        self._shipped = IndexDataCacheFile(
            beside, self._impl.filename_base, self._cache_file._source_stamp
        )
        self._read_only = isinstance(locator, _BesideTheSource)

    def stamp(self, dependencies: str) -> object:
        """Return the stamp that code on disk must have; it includes a digest of dependencies."""
        stamp = (self._cache_file._source_stamp, dependencies)
        self._cache_file._source_stamp = self._shipped._source_stamp = stamp
        return stamp

    def folder(self) -> tuple[str, bool]:
        """Return the folder of code for this processor, and whether it contains valid code."""
        target = cpu_target.target_context.codegen().magic_tuple()
        shipped = self._shipped_target(target)
        for file in (self._shipped, self._cache_file):
            if shipped is not None and any(key[1] == shipped for key in file._load_index()):
                return file._cache_path, True
        compiled = any(key[1] == target for key in self._cache_file._load_index())
        return "" if self._read_only else self._cache_path, compiled

    def save_overload(self, sig: Any, data: Any) -> None:
        """Save code for the next process if the folder is writable."""
        if not self._read_only:
            super().save_overload(sig, data)

    def _load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return shipped or locally compiled code; None if neither exists."""
        signature, target, code = self._index_key(sig, target_context.codegen())
        shipped = self._shipped_target(target)
        for file in (self._shipped, self._cache_file) if shipped is not None else ():
            data = file.load((signature, shipped, code))
            if data is not None:
                return self._impl.rebuild(target_context, data)
        return super()._load_overload(sig, target_context)

    @staticmethod
    def _shipped_target(target: tuple[str, str, str]) -> tuple[str, str, str] | None:
        """Return the target of shipped code; None if it does not run on `target`."""
        triple, name, features = target
        if name not in (TARGET, binding.get_host_cpu_name()) or not runs_on(features):
            return None  # the operator configured another processor
        return triple, TARGET, TARGET_FEATURES


def runs_on(features: str) -> bool:
    """Return whether a processor with these LLVM features ("+avx2,...") runs shipped code."""
    return set(TARGET_FEATURES.split(",")) <= set(features.split(","))
