"""FAISS indexes that compare all signatures by squared Euclidean distance.

Tests show that this type of FAISS index is correct; some other types return wrong results or abort
the process. It stores the signatures themselves, so its distances equal `geometry.retrieval` as
long as single precision represents them exactly.
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

#: Smallest distance that single precision may round.
ROUNDED = 1 << 24


def library() -> Any:
    """Return the module faiss, limited to one thread, because requests run concurrently."""
    import faiss  # imported late, because it takes 0.3 s

    faiss.omp_set_num_threads(1)  # the setting applies to the calling thread
    return faiss


def allocate(n: int, dimension: int) -> tuple[IndexScalarQuantizer, Bytes]:
    """Return an index of n uninitialised signatures, and a writable view (n, d) uint8 of them."""
    faiss = library()
    index = faiss.IndexScalarQuantizer(
        dimension, faiss.ScalarQuantizer.QT_8bit_direct, faiss.METRIC_L2
    )
    index.codes.resize(n * dimension)
    index.ntotal = n
    return index, _view(index, read_only=False)


def codes_of(index: IndexScalarQuantizer) -> Bytes:
    """Return a read-only view of the signatures (n, d) of an index."""
    return _view(index, read_only=True)


class _Codes:
    """The memory of an index for NumPy; the reference prevents the deletion of the index."""

    def __init__(self, index: Any, read_only: bool) -> None:
        self._index = index
        shape, data = (index.ntotal, index.d), (int(index.codes.data()), read_only)
        self.__array_interface__ = {"version": 3, "typestr": "|u1", "shape": shape, "data": data}


def _view(index: Any, *, read_only: bool) -> Bytes:
    if index.ntotal == 0:  # the index has no memory
        return np.empty((0, index.d), np.uint8)
    return np.asarray(_Codes(index, read_only))


def write_index(
    index: IndexScalarQuantizer | IndexBinaryFlat, take: Callable[[bytes], None]
) -> None:
    """Pass the bytes of an index to `take`, block by block."""
    faiss = library()
    binary = isinstance(index, faiss.IndexBinaryFlat)
    write = faiss.write_index_binary if binary else faiss.write_index
    write(index, faiss.PyCallbackIOWriter(take))


def map_index(path: Path, n: int, dimension: int) -> IndexScalarQuantizer:
    """Map an index file into shared memory; the memory remains valid after the file is unlinked.

    Parameters
    ----------
    path : file whose checksum the caller has verified: FAISS crashes on malicious bytes
    n, dimension : expected number and length of the signatures

    Raises
    ------
    DamagedIndex : If the file is missing, has another type or shape, or cannot be read by this
        version of FAISS.
    """
    faiss = library()
    index = _map_file(path, faiss.read_index)
    if (
        not isinstance(index, faiss.IndexScalarQuantizer)
        or (index.d, index.ntotal, index.metric_type) != (dimension, n, faiss.METRIC_L2)
        or index.sq.qtype != faiss.ScalarQuantizer.QT_8bit_direct
        or index.codes.size() != n * dimension
    ):
        raise DamagedIndex(f"{path}: not a FAISS index of {n} signatures of {dimension} bytes.")
    result: IndexScalarQuantizer = index
    return result


def map_binary(path: Path, n: int, bits: int) -> IndexBinaryFlat:
    """Map a file with an index of bits into memory; see `map_index`."""
    faiss = library()
    index = _map_file(path, faiss.read_index_binary)
    if not isinstance(index, faiss.IndexBinaryFlat) or (index.d, index.ntotal) != (bits, n):
        raise DamagedIndex(f"{path}: not a FAISS index of {n} sketches of {bits} bits.")
    result: IndexBinaryFlat = index
    return result


def _map_file(path: Path, read: Callable[[str, int], Any]) -> Any:
    try:
        return read(str(path), library().IO_FLAG_MMAP_IFC)
    except RuntimeError as error:
        raise DamagedIndex(f"{path}: FAISS cannot read it: {error}") from error


def selection(free: NDArray[np.bool_] | None) -> Any:
    """Return the parameters of a search in the rows where `free` (n,) is True; None selects all."""
    if free is None:
        return None
    faiss = library()
    return faiss.SearchParameters(sel=faiss.IDSelectorBitmap(np.packbits(free, bitorder="little")))


def nearest(
    index: IndexScalarQuantizer, query: Bytes, count: int, free: NDArray[np.bool_] | None
) -> tuple[NDArray[np.int64], NDArray[np.int64]] | None:
    """Return the rows nearest to a query and their distances, in any order.

    Parameters
    ----------
    query : (d,) uint8
    count : number of rows, at most the number of searchable rows
    free : (n,) mask of the searchable rows; None selects all

    Returns
    -------
    (count,) rows, among equal distances those with the lowest numbers, and (count,) distances; None
    if FAISS may have rounded a distance
    """
    if count == 0:
        return np.empty(0, np.int64), np.empty(0, np.int64)
    distances, rows = index.search(query[None].astype(np.float32), count, params=selection(free))
    if distances.max() >= ROUNDED:
        return None
    return rows[0], distances[0].astype(np.int64)
