"""FAISS over stored signatures: bytes as they are, squared Euclidean distance, all compared, or
those in the nearest lists.

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
    from faiss import IndexScalarQuantizer
import struct
from dataclasses import dataclass, replace
from functools import cached_property

from sceneprint.geometry.retrieval.ranking import distances
from sceneprint.index.generation_files import BLOCK_BYTES, Recall, draw, mapped
from sceneprint.types import Floats32, Ints32

#: Distances from here on may be rounded: the first integers that 32 bits of floats do not all hold.
ROUNDED = 1 << 24


def library() -> Any:
    """FAISS, on one thread: requests are what runs side by side. Imported late: it takes 0.3 s."""
    import faiss  # its own stubs contradict it

    faiss.omp_set_num_threads(1)  # of this thread
    return faiss


def allocate(n: int, dimension: int) -> tuple[IndexScalarQuantizer, Bytes]:
    """An index of n signatures that are yet to be written, and where: (n, d) uint8."""
    faiss = library()
    index = faiss.IndexScalarQuantizer(
        dimension, faiss.ScalarQuantizer.QT_8bit_direct, faiss.METRIC_L2
    )
    index.codes.resize(n * dimension)
    index.ntotal = n
    return index, _view(index, read_only=False)


def codes_of(index: IndexScalarQuantizer) -> Bytes:
    """The signatures (n, d) of an index, where they are: read-only, and keeps the index alive."""
    return _view(index, read_only=True)


class _Codes:
    """What numpy is told of the memory of an index."""

    def __init__(self, index: Any, read_only: bool) -> None:
        self._index = index
        self.__array_interface__ = {
            "version": 3,
            "typestr": "|u1",
            "shape": (index.ntotal, index.d),
            "data": (int(index.codes.data()), read_only),
        }


def _view(index: Any, *, read_only: bool) -> Bytes:
    if index.ntotal == 0:  # of no memory
        return np.empty((0, index.d), np.uint8)
    return np.asarray(_Codes(index, read_only))


def write_index(index: IndexScalarQuantizer, take: Callable[[bytes], None]) -> None:
    """Give an index as bytes, block by block.

    Raises
    ------
    Exception : of `take`
    """
    faiss = library()
    faiss.write_index(index, faiss.PyCallbackIOWriter(take))


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
    try:
        index: Any = faiss.read_index(str(path), faiss.IO_FLAG_MMAP_IFC)
    except RuntimeError as error:
        raise DamagedIndex(f"{path}: FAISS cannot read it: {error}") from error
    if (
        not isinstance(index, faiss.IndexScalarQuantizer)
        or (index.d, index.ntotal, index.metric_type) != (dimension, n, faiss.METRIC_L2)
        or index.sq.qtype != faiss.ScalarQuantizer.QT_8bit_direct
        or index.codes.size() != n * dimension
    ):
        raise DamagedIndex(f"{path}: no FAISS index of {n} signatures of {dimension} bytes.")
    found: IndexScalarQuantizer = index
    return found


def nearest(
    index: IndexScalarQuantizer, query: Bytes, count: int, free: NDArray[np.bool_] | None
) -> tuple[NDArray[np.int64], NDArray[np.int64]] | None:
    """The rows nearest to a query, and their distances, in no order that is promised.

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
    faiss, parameters = library(), None
    if free is not None:
        selector = faiss.IDSelectorBitmap(np.packbits(free, bitorder="little"))
        parameters = faiss.SearchParameters(sel=selector)
    found, rows = index.search(query[None].astype(np.float32), count, params=parameters)
    if found.max() >= ROUNDED:
        return None
    return rows[0], found[0].astype(np.int64)


# The inverted file of a very large map: which signatures are compared with a query.
#
# Signatures lie in lists, each with a centroid; a query is compared with those of the lists whose
# centroids are nearest. How many lists is measured when a generation is published.

#: Lists of N signatures: this many times the square root of N.
LISTS = 4
#: Signatures a list that centroids are trained on, and rounds of k-means.
TRAINED, ROUNDS = 32, 10
#: Centroids are trained anew when the map has this many times the frames of the last time.
GROWTH = 2
#: Neighbours by which recall is measured, and the share of them that a search has to find.
NEAR, ENOUGH = 10, 0.995
#: Frames looked up: at most, at least, and so many that they are compared with no more bytes.
MOST, LEAST, COMPARED_BYTES = 200, 10, 1 << 36
#: Share by which a generation's frames may be more or fewer before it is measured anew.
DRIFT = 0.1

MAGIC, SCHEMA_VERSION = b"SPLIST", 1
_HEAD = struct.Struct("<6sHIIQQ")


@dataclass(frozen=True, eq=False)
class Lists:
    """An inverted file over the signatures of a generation.

    Parameters
    ----------
    centroids : (L, d) float32
    ends : (L,) int64, where each list ends in `rows`
    rows : (N,) int32 of the generation, list after list, rising in each
    trained_on : frames that the map had when the centroids were trained
    probes : lists that a search compares
    """

    centroids: Floats32
    ends: NDArray[np.int64]
    rows: Ints32
    trained_on: int
    probes: int = 1

    def __len__(self) -> int:
        return len(self.ends)

    @cached_property
    def _quantizer(self) -> Any:
        index = library().IndexFlatL2(self.centroids.shape[1])
        index.add(self.centroids)
        return index

    def nearest(self, query: Bytes, count: int) -> NDArray[np.int64]:
        """The lists (count,) whose centroids are nearest to a query (d,), nearest first."""
        library()  # one thread
        _, found = self._quantizer.search(query[None].astype(np.float32), count)
        return np.asarray(found[0], np.int64)

    def candidates(
        self, query: Bytes, size: int, free: NDArray[np.bool_] | None
    ) -> NDArray[np.int64]:
        """Rows (r,), rising, that a query is compared with.

        Parameters
        ----------
        query : (d,) uint8
        size : rows that are wanted at least; more lists are taken until there are so many
        free : (N,) which rows may be found; all of them if None
        """
        probes = self.probes
        while True:
            probes = min(probes, len(self))
            starts = np.concatenate([[0], self.ends])
            chosen = self.nearest(query, probes).tolist()
            rows = np.concatenate([self.rows[starts[i] : starts[i + 1]] for i in chosen])
            if free is not None:
                rows = rows[free[rows]]
            if len(rows) >= size or probes == len(self):
                return np.sort(rows).astype(np.int64)  # memory is read in its order
            probes *= 2

    def assignment(self) -> Ints32:
        """The list (N,) of each row."""
        lists = np.empty(len(self.rows), np.int32)
        lists[self.rows] = np.repeat(
            np.arange(len(self), dtype=np.int32), np.diff(self.ends, prepend=0)
        )
        return lists


def train_lists(vectors: Bytes, seed: int = 0) -> Lists:
    """Lists of signatures (N, d), N >= 1; the same signatures and seed give the same lists."""
    faiss, (n, d) = library(), vectors.shape
    count = min(max(round(LISTS * n**0.5), 1), n)
    sample = vectors[draw(n, TRAINED * count, seed)].astype(np.float32)
    trained = faiss.Kmeans(
        d, count, niter=ROUNDS, seed=seed, min_points_per_centroid=1,
        max_points_per_centroid=TRAINED + 1,
    )  # fmt: skip
    trained.train(sample)
    centroids = np.asarray(trained.centroids, np.float32)
    return grouped(centroids, _assigned(centroids, vectors, np.arange(n)), n)


def extend_lists(known: Lists, vectors: Bytes, before: NDArray[np.int64]) -> Lists:
    """Lists of the generation that follows: only new signatures are assigned to one.

    Parameters
    ----------
    known : lists of the generation before
    vectors : (N, d) of the one that follows
    before : (N,) the row of each in the generation before; -1 for a new one
    """
    of, new = np.empty(len(vectors), np.int32), before < 0
    of[~new] = known.assignment()[before[~new]]
    of[new] = _assigned(known.centroids, vectors, np.flatnonzero(new))
    return grouped(known.centroids, of, known.trained_on)


def centre_lists(lists: Lists, vectors: Bytes) -> Lists:
    """The same lists, each with the mean of what is in it: nothing is left of a frame that is gone.

    A list that nothing is in goes.
    """
    filled = np.flatnonzero(np.diff(lists.ends, prepend=0))
    means = [
        part.mean(axis=0, dtype=np.float32)
        for part in (vectors[rows] for rows in np.split(lists.rows, lists.ends[:-1]))
        if len(part)
    ]
    return replace(lists, centroids=np.stack(means), ends=lists.ends[filled])


def grouped(centroids: Floats32, lists: Ints32, trained_on: int) -> Lists:
    """Lists from the list (N,) that each row is in."""
    ends = np.cumsum(np.bincount(lists, minlength=len(centroids)))
    rows = np.argsort(lists, kind="stable").astype(np.int32)
    return Lists(centroids, ends, rows, trained_on)


def _assigned(centroids: Floats32, vectors: Bytes, rows: NDArray[np.int64]) -> Ints32:
    """The list (r,) whose centroid is nearest to each of some rows."""
    quantizer = library().IndexFlatL2(centroids.shape[1])
    quantizer.add(centroids)
    lists, step = np.empty(len(rows), np.int32), max(BLOCK_BYTES // centroids.shape[1], 1)
    for start in range(0, len(rows), step):
        block = vectors[rows[start : start + step]].astype(np.float32)
        lists[start : start + step] = quantizer.search(block, 1)[1][:, 0]
    return lists


def measure_lists(lists: Lists, vectors: Bytes, seed: int = 0) -> tuple[Lists, Recall]:
    """Look up some frames, and probe so many lists that a search finds ENOUGH of the nearest.

    Returns
    -------
    the lists with their number of probes, a power of two or all; and what a search finds so
    """
    n, d = vectors.shape
    chosen = draw(n, min(max(COMPARED_BYTES // (n * d), LEAST), MOST), seed)
    near, of = min(NEAR, n - 1), lists.assignment()
    place, ranks = np.empty(len(lists), np.int64), np.empty((len(chosen), near), np.int64)
    for i, row in enumerate(chosen.tolist() if near else ()):
        place[lists.nearest(vectors[row], len(lists))] = np.arange(len(lists))
        exact = distances(vectors[row], vectors, "l2")
        exact[row] = np.iinfo(np.int64).max
        # an equal distance is as good: which of two equal frames is meant is nobody's concern
        wanted = exact <= np.partition(exact, near - 1)[near - 1]
        ranks[i] = np.sort(place[of[wanted]])[:near]
    probes = 1
    while probes < len(lists) and (ranks >= probes).sum() > (1 - ENOUGH) * ranks.size:
        probes *= 2
    probes = min(probes, len(lists))
    share = 1 - float((ranks >= probes).sum()) / max(ranks.size, 1)
    recall = Recall(share, NEAR, len(chosen), probes, n)
    return replace(lists, probes=probes), recall


def still_holds(recall: Recall, frames: int) -> bool:
    """Whether what was measured of a generation stands for one that follows it in the same lists.

    A large map is appended to often, and each time to read all of it many times would cost more
    than the appending.
    """
    return recall.sample > 0 and abs(frames - recall.frames) <= DRIFT * recall.frames


def write_lists(lists: Lists, take: Callable[[bytes], None]) -> None:
    """Give lists as bytes, block by block. The number of probes is not among them."""
    (count, d), n = lists.centroids.shape, len(lists.rows)
    take(_HEAD.pack(MAGIC, SCHEMA_VERSION, d, count, n, lists.trained_on))
    take(lists.centroids.astype("<f4").tobytes())
    take(lists.ends.astype("<i8").tobytes())
    take(lists.rows.astype("<i4").tobytes())


def map_lists(path: Path, n: int, dimension: int, probes: int) -> Lists:
    """Map lists into memory that processes share.

    Parameters
    ----------
    path : of a file whose checksum the caller has checked
    n, dimension : of the signatures
    probes : lists that a search compares

    Raises
    ------
    DamagedIndex : missing, of another schema, or of other signatures.
    """
    data = mapped(path)
    head = data[: _HEAD.size].ljust(_HEAD.size, b"\0")
    magic, schema, d, count, rows, trained_on = _HEAD.unpack(head)
    size = _HEAD.size + 4 * count * d + 8 * count + 4 * rows
    if (magic, schema, d, rows, len(data)) != (MAGIC, SCHEMA_VERSION, dimension, n, size):
        raise DamagedIndex(f"{path}: no lists of {n} signatures of {dimension} bytes.")
    centroids = np.frombuffer(data, "<f4", count * d, _HEAD.size).reshape(count, d)
    ends = np.frombuffer(data, "<i8", count, _HEAD.size + centroids.nbytes)
    own = np.frombuffer(data, "<i4", rows, size - 4 * rows)
    return Lists(centroids, ends, own, trained_on, probes)
