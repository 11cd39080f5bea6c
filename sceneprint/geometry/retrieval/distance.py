"""Sec. III-C, similarity and retrieval: stored signatures to a ranking; the oracle of every index.

query (n,), database (N, n) uint8  --distances-->  (N,)  --rank-->  Ranking: R of Sec. III-C

Distances are exact integers, so that equal ones are equal, and ties fall to the lower index.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any, Literal, get_args

import numpy as np
from llvmlite import ir
from numba.core import cgutils as numba_code
from numba.core import types as numba_types
from numba.core.registry import cpu_target
from numba.extending import intrinsic
from numpy.typing import NDArray

from sceneprint.geometry.kernel import kernel
from sceneprint.types import Bytes, Floats

# Sec. III-C, sums of |x - y| over bytes by the one instruction that x86 has for them.
#
# A compiler finds it (psadbw) for one pair of rows at best. Written out, four rows and several
# queries are compared at once: each byte is loaded once for all of them, and nobody waits for one
# sum before the next. It takes 64, 32 or 16 bytes at a time, as the processor can.
#
# All that is compiled into a scanner stands in this file: numba keeps its code by the file's date.

Ints64 = NDArray[np.int64]
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

#: Rows that take turns at one tile of columns, and bytes of a tile: these of all queries stay in
#: a core's cache while the rows pass. A tile of a page each keeps the order of memory.
GROUP, TILE = 16, 4096

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


# Sec. III-C, the sums behind a similarity: the loops of `retrieval`, as fast as memory allows.
#
#     queries (Q, n), database (N, n) uint8, rows (r,)  --scan-->  (Q, r) sums of integers
#
# On x86 sums of |x - y| are those of `psadbw`. Elsewhere, and for squares, the loop in plain words
# serves. All give the same integers.

#: Bytes summed in 32 bits before they move to 64: the last power of 2 of which 255^2 each fit.
BLOCK = 32768

#: The same of the loop in plain words, whose calls cost more than sums in shorter tiles.
_CACHED, _SHORTEST = 262144, 4096


def scan(
    queries: Bytes,
    database: Bytes,
    rows: Ints64,
    *,
    squared: bool = False,
    half: bool = False,
    width: int | None = None,
) -> Ints64:
    """Sums of |x - y|, or of (x - y)^2, over the bytes of every query and row.

    Parameters
    ----------
    queries : (Q, n) uint8, in C order
    database : (N, n) uint8, in C order
    rows : (r,) of the database, each from 0 to N - 1: not checked here
    squared : sum squares
    half : only entries (q, i) with q < i mean something; the others may be anything
    width : bytes at a time, of `widths`; the widest where it is not given

    Returns
    -------
    (Q, r) int64
    """
    result = np.zeros((len(queries), len(rows)), np.int64)
    width = widths()[0] if width is None else width
    if squared or width == 0:
        tile = max(_CACHED // max(len(queries), 1), _SHORTEST)
        _plain(frozen(queries), frozen(database), frozen(rows), squared, half, tile, result)
    else:
        # one query stays in the cache whole, and a row is read without a break
        tile = TILE if len(queries) > 1 else max(queries.shape[1], TILE)
        scanner = SCANNERS[width]
        scanner(frozen(queries), frozen(database), frozen(rows), half, tile, result)
    return result


def frozen(array: NDArray[Any]) -> NDArray[Any]:
    """A read-only view: code compiled for it serves mapped files and arrays in memory alike."""
    view = array.view()
    view.flags.writeable = False
    return view


@kernel
def _absolute(a: Bytes, b: Bytes) -> int:
    """Sum of |a - b| over at most BLOCK bytes."""
    total = np.int32(0)
    for i in range(len(a)):
        # the magnitude of 32 bits added to 32 bits, and no other form, becomes one instruction
        d = np.int32(np.int32(a[i]) - np.int32(b[i]))
        total = np.int32(total + abs(d))
    return int(total)


@kernel
def _squares(a: Bytes, b: Bytes) -> int:
    """Sum of (a - b)^2 over at most BLOCK bytes."""
    total = np.int32(0)
    for i in range(len(a)):
        d = np.int32(np.int32(a[i]) - np.int32(b[i]))
        total = np.int32(total + np.int32(d * d))  # becomes pmaddwd
    return int(total)


@kernel
def _plain(
    queries: Bytes,
    database: Bytes,
    rows: Ints64,
    squared: bool,
    half: bool,
    tile: int,
    result: Ints64,
) -> None:
    """Add to result (Q, r), on any processor."""
    n = queries.shape[1]
    for group in range(0, len(rows), GROUP):
        for start in range(0, n, tile):
            for i in range(group, min(group + GROUP, len(rows))):
                stored = database[rows[i], start : start + tile]
                for q in range(min(i, len(queries)) if half else len(queries)):
                    asked = queries[q, start : start + tile]
                    total = 0
                    for low in range(0, len(stored), BLOCK):
                        # slices start at 0: a loop from `low` would not be vectorised
                        a, b = asked[low : low + BLOCK], stored[low : low + BLOCK]
                        total += _squares(a, b) if squared else _absolute(a, b)
                    result[q, i] += total


#: "l1": the paper's, sum |x - y|; "l2": squared Euclidean, sum (x - y)^2, an integer as well.
Metric = Literal["l1", "l2"]

#: A ranking takes this share of a map, and no fewer and no more than these.
RANKING_SHARE, SMALLEST_RANKING, LARGEST_RANKING = 0.4, 50, 200


@dataclass(frozen=True, eq=False)
class Ranking:
    """R of Sec. III-C, nearest first, ties by index.

    Parameters
    ----------
    indices : (r,) rows of the database
    distances : (r,) int64, rising
    similarities : (r,) in [0, 1], falling; see `similarity`
    """

    indices: NDArray[np.intp]
    distances: Ints64
    similarities: Floats

    def __len__(self) -> int:
        return len(self.indices)


def distances(query: Bytes, database: Bytes, metric: Metric, rows: Ints64 | None = None) -> Ints64:
    """Distances -s(X, Y) of one signature to many: Sec. III-C.

    Parameters
    ----------
    query : (n,) uint8
    database : (N, n) uint8
    metric : "l1", the paper's, or "l2", squared Euclidean
    rows : (r,) of the database that are compared, where they are; all of them if not given

    Returns
    -------
    (N,) or (r,) int64, in units of a byte ("l2": of a byte squared); exact

    Raises
    ------
    ValueError : the lengths differ, the arrays are not of bytes, there is no such metric, or no
        such row.
    """
    if query.ndim != 1:
        raise ValueError(f"signatures of {query.shape} and {database.shape[1:]} bytes")
    _check(query[None], database, metric)
    if rows is not None:
        if rows.ndim != 1 or rows.dtype.kind not in "iu":
            raise ValueError(f"{rows.dtype} {rows.shape}, not numbers of rows")
        if len(rows) and not 0 <= rows.min() <= rows.max() < len(database):
            raise ValueError(f"rows {rows.min()} to {rows.max()} of {len(database)} signatures")
    found: Ints64 = _distances(query[None], database, metric, rows)[0]
    return found


def cross_distances(queries: Bytes, database: Bytes, metric: Metric) -> Ints64:
    """Distances -s(X, Y) of many signatures to many: Sec. III-C.

    The database streams through the cache once for all queries that fit in it.

    Parameters
    ----------
    queries : (Q, n) uint8
    database : (N, n) uint8
    metric : see `distances`

    Returns
    -------
    (Q, N) int64, as of `distances`

    Raises
    ------
    ValueError : see `distances`.
    """
    _check(queries, database, metric)
    return _distances(queries, database, metric)


def pairwise_distances(signatures: Bytes, metric: Metric) -> Ints64:
    """Distances of signatures among each other, each pair computed once: Sec. III-C.

    Parameters
    ----------
    signatures : (R, n) uint8
    metric : see `distances`

    Returns
    -------
    (R, R) int64, symmetric, 0 on the diagonal

    Raises
    ------
    ValueError : see `distances`.
    """
    _check(signatures, signatures, metric)
    above = np.triu(_distances(signatures, signatures, metric, half=True), 1)
    return above + above.T


def _check(queries: Bytes, database: Bytes, metric: Metric) -> None:
    if queries.ndim != 2 or database.ndim != 2 or queries.shape[1] != database.shape[1]:
        raise ValueError(f"signatures of {queries.shape[1:]} and {database.shape[1:]} bytes")
    if queries.dtype != np.uint8 or database.dtype != np.uint8:
        raise ValueError(f"signatures of {queries.dtype} and {database.dtype}, not of bytes")
    if metric not in get_args(Metric):
        raise ValueError(f"metric {metric!r}, not one of {get_args(Metric)}")


def _distances(
    queries: Bytes,
    database: Bytes,
    metric: Metric,
    rows: Ints64 | None = None,
    half: bool = False,
) -> Ints64:
    rows = np.arange(len(database)) if rows is None else np.ascontiguousarray(rows, np.int64)
    queries, database = np.ascontiguousarray(queries), np.ascontiguousarray(database)
    return scan(queries, database, rows, squared=metric == "l2", half=half)


def similarity(distances: Ints64, unrelated_distance: float) -> Floats:
    """Distances on a scale that does not depend on the model: Sec. III-C.

    Parameters
    ----------
    distances : (...) of one metric
    unrelated_distance : d0, the model's median distance of unrelated frames, in that metric

    Returns
    -------
    (...) 1 - d / d0, at least 0: 1 for equal signatures, 0 for unrelated ones

    Raises
    ------
    ValueError : d0 is not a positive, finite number.
    """
    if not (unrelated_distance > 0 and math.isfinite(unrelated_distance)):
        raise ValueError(f"the distance of unrelated frames is {unrelated_distance}")
    shares: Floats = np.clip(1.0 - np.asarray(distances, np.float64) / unrelated_distance, 0.0, 1.0)
    return shares


def distance_share(distances: Ints64, unrelated_distance: float, metric: Metric) -> Floats:
    """How far frames are, as a share of how far unrelated ones are: of squared distances the root.

    Parameters
    ----------
    distances : (...) of a metric
    unrelated_distance : d0, see `similarity`
    metric : see `distances`

    Returns
    -------
    (...) 0 for equal signatures, about 1 for unrelated ones
    """
    shares: Floats = np.asarray(distances, np.float64) / unrelated_distance
    return shares if metric == "l1" else np.sqrt(shares)


def share_distance(share: float, unrelated_distance: float, metric: Metric) -> float:
    """The distance that is such a share: the inverse of `distance_share`."""
    return (share if metric == "l1" else share**2) * unrelated_distance


def rank(distances: Ints64, size: int, unrelated_distance: float) -> Ranking:
    """The nearest `size` of a database, ties by index: R of Sec. III-C.

    Parameters
    ----------
    distances : (N,) integers, to every row of the database
    size : of the ranking; all of the database where it has no more rows
    unrelated_distance : see `similarity`

    Raises
    ------
    ValueError : distances that are not (N,) integers, a negative size, or d0 as in `similarity`.
    """
    if distances.ndim != 1 or distances.dtype.kind not in "iu" or size < 0:
        raise ValueError(f"{size} of distances {distances.shape} of {distances.dtype}")
    size = min(size, len(distances))
    if size == 0:
        chosen = np.empty(0, np.intp)
    else:
        cut = np.partition(distances, size - 1)[size - 1]
        nearer, at_cut = np.flatnonzero(distances < cut), np.flatnonzero(distances == cut)
        chosen = np.concatenate([nearer, at_cut[: size - len(nearer)]])
        # rising indices, and a stable sort: equal distances keep the order of the database
        chosen = chosen[np.argsort(distances[chosen], kind="stable")]
    ranked = distances[chosen].astype(np.int64)
    return Ranking(chosen, ranked, similarity(ranked, unrelated_distance))


def ranking_size(n_map: int) -> int:
    """|R| for a map of that many frames: 0.4 of them, from 50 to 200.

    In a map twice as dense the same place fills twice the ranks, so that a fixed number holds
    nothing but near-duplicates, of which no selection can be diverse: among the nearest 50 of 300
    frames of one room diversification gained 10 % of seen volume, among 125 of them 27 % (Sec.
    III-D). A share of the map keeps the stretch of places in R. The lower bound leaves a small
    map whole; the upper bounds the pairwise distances, and a larger map has more places, not
    more views of this one.

    Raises
    ------
    ValueError : a negative number.
    """
    if n_map < 0:
        raise ValueError(f"a map of {n_map} frames")
    wanted = min(max(round(RANKING_SHARE * n_map), SMALLEST_RANKING), LARGEST_RANKING)
    return min(wanted, n_map)
