"""Sec. III-C, sums of |x - y| over bytes by the one instruction that x86 has for them.

A compiler finds it (psadbw) for one pair of rows at best. Written out, four rows and several
queries are compared at once: each byte is loaded once for all of them, and nobody waits for one
sum before the next. It takes 64, 32 or 16 bytes at a time, as the processor can.

Loaded when such sums are first asked for: what writes them imports numba.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils as numba_code
from numba.core import types as numba_types
from numba.core.registry import cpu_target
from numba.extending import intrinsic

from sceneprint.geometry.kernel import kernel
from sceneprint.geometry.retrieval.ranking import GROUP, Ints64
from sceneprint.types import Bytes

Scanner = Callable[[Bytes, Bytes, Ints64, bool, int, Ints64], None]

#: Untyped, whatever numba's own hints say of some.
cgutils: Any = numba_code
types: Any = numba_types

#: Rows compared at once: four streams keep memory busy where one does not. Queries compared at
#: once with them, by bytes at a time: their sums and bytes fill the registers, 32 or 16.
ROWS, QUERIES = 4, {64: 4, 32: 2, 16: 2}

#: Instruction by bytes at a time, and what an x86-64 must have for it; the last is in all.
_PSADBW = {
    64: ("llvm.x86.avx512.psad.bw.512", "+avx512bw"),
    32: ("llvm.x86.avx2.psad.bw", "+avx2"),
    16: ("llvm.x86.sse2.psad.bw", ""),
}

#: Bytes of a query that the first level of the cache holds: neighbouring rows are then read
#: fastest in their order, one after the other; not so rows that are scattered.
_SHORT = 16384


@cache
def widths() -> tuple[int, ...]:
    """Bytes at a time that can be summed, falling; 0, the plain loop, is always the last.

    Asked of the compiler, not of the processor: an operator may have set another one, and code
    is cached by what the compiler was set to.
    """
    triple, _, features = cpu_target.target_context.codegen().magic_tuple()
    return widths_of(triple, features)


def widths_of(triple: str, features: str) -> tuple[int, ...]:
    """See `widths`; of a processor in LLVM's words, "x86_64-..." and "+avx2,-avx512bw,..."."""
    has = {"", *features.split(",")} if triple.startswith("x86_64") else set()
    return (*(width for width, (_, needed) in _PSADBW.items() if needed in has), 0)


def _psadbw_sums(
    _context: Any,
    queries: Any,
    q: Any,  # noqa: ARG001  (numbers, whose type is always the same)
    database: Any,
    rows: Any,
    start: Any,  # noqa: ARG001
    stop: Any,  # noqa: ARG001
    width: Any,
    together: Any,
) -> Any:
    """Sums of |x - y| over columns start to stop, a multiple of `width` bytes.

    Of `together` queries from q on and a tuple of rows, as a tuple, those of the first query
    first. Arguments are types; the answer is a signature, and what writes the code of a call.

    Length: one loop of LLVM, whose parts share the builder and all names.
    """
    n_bytes, n_queries = width.literal_value, together.literal_value
    lanes = n_bytes // 8
    n_rows = rows.count
    result = types.UniTuple(types.int64, n_queries * n_rows)
    integer = types.int64
    signature = result(queries, integer, database, rows, integer, integer, width, together)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        byte, word = ir.IntType(8), ir.IntType(64)
        chunk, sums = ir.VectorType(byte, n_bytes), ir.VectorType(word, lanes)
        psadbw = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(sums, [chunk, chunk]), _PSADBW[n_bytes][0]
        )
        add_up = cgutils.get_or_insert_function(
            builder.module,
            ir.FunctionType(word, [sums]),
            f"llvm.vector.reduce.add.v{lanes}i64",
        )

        def pointers(array: Any, kind: Any, indices: Any) -> list[Any]:
            array = context.make_array(kind)(context, builder, array)
            length = cgutils.unpack_tuple(builder, array.shape)[1]
            return [builder.gep(array.data, [builder.mul(i, length)]) for i in indices]

        own, first, stored, own_rows, low, high, *_ = arguments
        asked = pointers(
            own, signature.args[0], [builder.add(first, word(k)) for k in range(n_queries)]
        )
        found = pointers(stored, signature.args[2], cgutils.unpack_tuple(builder, own_rows))
        totals = [
            cgutils.alloca_once_value(builder, ir.Constant(sums, [0] * lanes))
            for _ in range(n_queries * n_rows)
        ]
        with cgutils.for_range_slice(builder, low, high, word(n_bytes), word) as (at, _):

            def load(pointer: Any) -> Any:
                there = builder.bitcast(builder.gep(pointer, [at]), chunk.as_pointer())
                return builder.load(there, align=1)

            xs = [load(pointer) for pointer in asked]
            for r, pointer in enumerate(found):
                y = load(pointer)
                for k, x in enumerate(xs):
                    total = totals[k * n_rows + r]
                    more = builder.call(psadbw, [x, y])
                    builder.store(builder.add(builder.load(total), more), total)
        values = [builder.call(add_up, [builder.load(total)]) for total in totals]
        return context.make_tuple(builder, signature.return_type, values)

    return signature, generate


_sums: Any = intrinsic(prefer_literal=True)(_psadbw_sums)


def _scanner(width: int, together: int) -> Scanner:
    """The loop around `_sums`; see `scan` for what it takes."""

    @kernel
    def blocks(
        queries: Bytes, database: Bytes, rows: Ints64, half: bool, tile: int, result: Ints64
    ) -> None:
        """Add to result (Q, r)."""
        n = queries.shape[1]
        whole = n // width * width
        in_order = len(queries) == 1 and n <= _SHORT
        for group in range(0, len(rows), GROUP):
            end = min(group + GROUP, len(rows))
            for start in range(0, whole, tile):
                stop = min(start + tile, whole)
                for i in range(group, end, ROWS):
                    n_rows = min(ROWS, end - i)
                    n_queries = min(i + n_rows, len(queries)) if half else len(queries)
                    q = 0
                    if n_rows == ROWS and not (in_order and rows[i + 3] - rows[i] == 3):
                        four = (rows[i], rows[i + 1], rows[i + 2], rows[i + 3])
                        while q + together <= n_queries:
                            many = _sums(queries, q, database, four, start, stop, width, together)
                            for k in range(together):
                                for r in range(ROWS):
                                    result[q + k, i + r] += many[k * ROWS + r]
                            q += together
                        while q < n_queries:
                            some = _sums(queries, q, database, four, start, stop, width, 1)
                            for r in range(ROWS):
                                result[q, i + r] += some[r]
                            q += 1
                    for k in range(q, n_queries):
                        for r in range(i, i + n_rows):
                            one = _sums(queries, k, database, (rows[r],), start, stop, width, 1)
                            result[k, r] += one[0]
            if whole < n:
                for i in range(group, end):
                    for q in range(len(queries)):
                        rest = np.int64(0)
                        for column in range(whole, n):
                            x, y = queries[q, column], database[rows[i], column]
                            rest += abs(np.int64(x) - np.int64(y))
                        result[q, i] += rest

    return blocks


#: By bytes at a time; only those of `widths` can be called.
SCANNERS = {width: _scanner(width, together) for width, together in QUERIES.items()}
