"""How numba compiles kernels, and where their machine code is kept: in numba's folders, or in
those that a wheel or an image brought.

numba keeps code by the processor that it was compiled on. What comes with an installation was
compiled for any processor of a kind (`TARGET`). It is found in numba's folder and beside the
sources, whether that folder may be written to or not. Loaded apart from the kernels: it imports
numba, which takes long.
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
    """Compiles kernels none of whose arrays shares memory with one that they write."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.state.flags.noalias = True


def _prefetch_row(_context: Any, table: Any, row: Any) -> Any:
    """Ask for the first 128 bytes, two cache lines, of a row of a C-contiguous table.

    Arguments are types; the answer is a signature, and what writes the code of a call.
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
        # to be read, and to be kept in all levels of the cache, as data
        how = [ir.Constant(number, value) for value in (0, 3, 1)]
        for offset in (0, 64):
            line = builder.gep(start, [ir.Constant(ir.IntType(64), offset)])
            builder.call(function, [line, *how])
        return context.get_dummy_value()

    return signature, generate


prefetch_row: Any = intrinsic(_prefetch_row)


class _BesideTheSource(InTreeCacheLocator):
    """The folder of a package that may not be written to, where no other folder may be either."""

    def ensure_cache_path(self) -> None:
        """Nothing is written to it."""


class _Locations(CompileResultCacheImpl):
    _locator_classes = [*CompileResultCacheImpl._locator_classes, _BesideTheSource]  # noqa: RUF012


class KernelCache(FunctionCache):
    """The machine code of one kernel on disk.

    Parameters
    ----------
    function : the kernel
    """

    _impl_class = _Locations

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        locator = self._impl.locator
        beside = InTreeCacheLocator(function, locator._py_file).get_cache_path()
        self._brought = IndexDataCacheFile(
            beside, self._impl.filename_base, self._cache_file._source_stamp
        )
        self._read_only = isinstance(locator, _BesideTheSource)

    def stamp(self, made_of: str) -> object:
        """Have code be valid only if it was made of this; returns that and its own file."""
        stamp = (self._cache_file._source_stamp, made_of)
        self._cache_file._source_stamp = self._brought._source_stamp = stamp
        return stamp

    def place(self) -> tuple[str, bool]:
        """Folder of valid code for this processor and whether there is any."""
        target = cpu_target.target_context.codegen().magic_tuple()
        brought = self._brought_for(target)
        for file in (self._brought, self._cache_file):
            if brought is not None and any(one[1] == brought for one in file._load_index()):
                return file._cache_path, True
        found = any(one[1] == target for one in self._cache_file._load_index())
        return "" if self._read_only else self._cache_path, found

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep code for the next process, where there is a folder for it."""
        if not self._read_only:
            super().save_overload(sig, data)

    def _load_overload(self, sig: Any, target_context: Any) -> Any:
        """Code that was brought, or that was compiled here; None where it is yet to be."""
        signature, target, code = self._index_key(sig, target_context.codegen())
        brought = self._brought_for(target)
        for file in (self._brought, self._cache_file) if brought is not None else ():
            data = file.load((signature, brought, code))
            if data is not None:
                return self._impl.rebuild(target_context, data)
        return super()._load_overload(sig, target_context)

    @staticmethod
    def _brought_for(target: tuple[str, str, str]) -> tuple[str, str, str] | None:
        """What brought code was compiled for, if it runs where code for `target` does."""
        triple, name, features = target
        if name not in (TARGET, binding.get_host_cpu_name()) or not runs_on(features):
            return None  # an operator wants code for another processor
        return triple, TARGET, TARGET_FEATURES


def runs_on(features: str) -> bool:
    """Whether a processor has what brought code needs; "+avx2,-avx512bw,..." as LLVM has it."""
    return set(TARGET_FEATURES.split(",")) <= set(features.split(","))
