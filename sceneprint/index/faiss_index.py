"""FAISS over stored signatures: bytes as they are, squared Euclidean distance, all compared.

Of what FAISS offers this kind was measured to be right, and nobody else names one: some kinds are
silently wrong, some abort the process. Its codes are the signatures themselves, so its distances
are those of `geometry.retrieval`, integers as long as 32 bits of floating point hold them.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sceneprint.errors import DamagedIndex
from sceneprint.types import Bytes

if TYPE_CHECKING:
    from faiss import IndexBinaryFlat, IndexScalarQuantizer

#: Distances from here on may be rounded: the first integers that 32 bits of floats do not all hold.
ROUNDED = 1 << 24


def library() -> Any:
    """FAISS, on one thread: requests are what runs side by side. Imported late: it takes 0.3 s."""
    import faiss  # its own stubs contradict it

    faiss.omp_set_num_threads(1)  # of this thread
    return faiss


def allocate(n: int, dimension: int) -> tuple[IndexScalarQuantizer, Bytes]:
    """Return an index of n signatures that are yet to be written, and where: (n, d) uint8."""
    faiss = library()
    index = faiss.IndexScalarQuantizer(
        dimension, faiss.ScalarQuantizer.QT_8bit_direct, faiss.METRIC_L2
    )
    index.codes.resize(n * dimension)
    index.ntotal = n
    return index, _view(index, read_only=False)


def codes_of(index: IndexScalarQuantizer) -> Bytes:
    """Return the signatures (n, d) of an index, where they are, read-only."""
    return _view(index, read_only=True)


class _Codes:
    """The memory of an index, as numpy reads it; it keeps the index alive."""

    def __init__(self, index: Any, read_only: bool) -> None:
        self._index = index
        shape, data = (index.ntotal, index.d), (int(index.codes.data()), read_only)
        self.__array_interface__ = {"version": 3, "typestr": "|u1", "shape": shape, "data": data}


def _view(index: Any, *, read_only: bool) -> Bytes:
    if index.ntotal == 0:  # of no memory
        return np.empty((0, index.d), np.uint8)
    return np.asarray(_Codes(index, read_only))


def write_index(
    index: IndexScalarQuantizer | IndexBinaryFlat, take: Callable[[bytes], None]
) -> None:
    """Pass an index to `take` as bytes, block by block; raises what `take` raises."""
    faiss = library()
    binary = isinstance(index, faiss.IndexBinaryFlat)
    write = faiss.write_index_binary if binary else faiss.write_index
    write(index, faiss.PyCallbackIOWriter(take))


def map_index(path: Path, n: int, dimension: int) -> IndexScalarQuantizer:
    """Map an index into memory that processes share; it survives the unlinking of its file.

    Parameters
    ----------
    path : of a file whose checksum the caller has checked: FAISS crashes on bytes that mean harm
    n, dimension : that it must have

    Raises
    ------
    DamagedIndex : missing, another kind or shape, or of a FAISS that this one cannot read.
    """
    faiss = library()
    index = _map_file(path, faiss.read_index)
    if (
        not isinstance(index, faiss.IndexScalarQuantizer)
        or (index.d, index.ntotal, index.metric_type) != (dimension, n, faiss.METRIC_L2)
        or index.sq.qtype != faiss.ScalarQuantizer.QT_8bit_direct
        or index.codes.size() != n * dimension
    ):
        raise DamagedIndex(f"{path}: no FAISS index of {n} signatures of {dimension} bytes.")
    found: IndexScalarQuantizer = index
    return found


def map_binary(path: Path, n: int, bits: int) -> IndexBinaryFlat:
    """Map an index over bits into memory, as `map_index` does."""
    faiss = library()
    index = _map_file(path, faiss.read_index_binary)
    if not isinstance(index, faiss.IndexBinaryFlat) or (index.d, index.ntotal) != (bits, n):
        raise DamagedIndex(f"{path}: no FAISS index of {n} sketches of {bits} bits.")
    found: IndexBinaryFlat = index
    return found


def _map_file(path: Path, read: Callable[[str, int], Any]) -> Any:
    try:
        return read(str(path), library().IO_FLAG_MMAP_IFC)
    except RuntimeError as error:
        raise DamagedIndex(f"{path}: FAISS cannot read it: {error}") from error


def selection(free: NDArray[np.bool_] | None) -> Any:
    """Return the parameters of a search of the rows (n,) that are free; None: all of them."""
    if free is None:
        return None
    faiss = library()
    return faiss.SearchParameters(sel=faiss.IDSelectorBitmap(np.packbits(free, bitorder="little")))


def nearest(
    index: IndexScalarQuantizer, query: Bytes, count: int, free: NDArray[np.bool_] | None
) -> tuple[NDArray[np.int64], NDArray[np.int64]] | None:
    """Return the rows nearest to a query, and their distances, in no order that is promised.

    Parameters
    ----------
    query : (d,) uint8
    count : of rows; there must be so many
    free : (n,) which rows may be found; all of them if None

    Returns
    -------
    (count,) rows, of which the earlier wins where distances are equal, and (count,) distances;
    None where FAISS may have rounded one of them
    """
    if count == 0:
        return np.empty(0, np.int64), np.empty(0, np.int64)
    found, rows = index.search(query[None].astype(np.float32), count, params=selection(free))
    if found.max() >= ROUNDED:
        return None
    return rows[0], found[0].astype(np.int64)
