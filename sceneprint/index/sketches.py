"""Sketches of signatures, with one bit per byte. They select the frames that a search compares.

    signatures (N, d) uint8  --write_segment-->  FAISS's IndexBinaryFlat in a file
    query (d,)  --Sketches.candidates-->  rows with the most similar sketches

A bit is set if the byte is above its mean in the segment. A sketch has an eighth of the size of its
signature, and comparing sketches takes an xor and a count of bits. A search compares all sketches
of a segment with the query, and then the signatures of the selected rows. The number of rows to
select is measured when the segment is written.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sceneprint.errors import DamagedIndex
from sceneprint.geometry.retrieval.ranking import distances
from sceneprint.index.faiss_index import library, map_binary, selection
from sceneprint.index.index_manifest import Recall
from sceneprint.index.part_files import BLOCK_BYTES, mapped
from sceneprint.types import Bytes, Floats32

if TYPE_CHECKING:
    from faiss import IndexBinaryFlat

#: Maximum number of frames in the computation of means.
MEASURED = 1 << 16
#: Minimum number of frames that a search selects: absolute, and as a multiple of its results.
LEAST_SELECTED, TIMES_WANTED = 256, 4
#: Number of neighbours for which recall is measured, and the required recall.
NEAR, ENOUGH = 10, 0.995
#: Maximum and minimum number of queries to measure, and maximum number of bytes to compare.
MOST, LEAST, COMPARED_BYTES = 100, 10, 1 << 36


@dataclass(frozen=True, eq=False)
class Sketches:
    """The sketches of a segment.

    Parameters
    ----------
    means : (d,) uint8, thresholds of the bits
    index : FAISS index of the bits; bits beyond d are 0
    probes : minimum number of rows that a search selects
    """

    means: Bytes
    index: IndexBinaryFlat
    probes: int = LEAST_SELECTED

    def __len__(self) -> int:
        return int(self.index.ntotal)

    def nearest(
        self, query: Bytes, count: int, free: NDArray[np.bool_] | None = None
    ) -> NDArray[np.int64]:
        """Return the rows (count,) with the most similar sketches, most similar first.

        Parameters
        ----------
        query : (d,) uint8
        count : number of rows, at most the number of searchable rows
        free : (N,) mask of the searchable rows; None selects all
        """
        if count == 0:
            return np.empty(0, np.int64)
        bits = sketch(query[None], self.means)
        rows: NDArray[np.int64] = self.index.search(bits, count, params=selection(free))[1][0]
        return rows

    def candidates(
        self, query: Bytes, size: int, free: NDArray[np.bool_] | None
    ) -> NDArray[np.int64]:
        """Return the rows (r,) to compare with a query, ascending.

        Parameters
        ----------
        query : (d,) uint8
        size : number of nearest rows to find
        free : (N,) mask of the searchable rows; None selects all
        """
        n = len(self) if free is None else int(np.count_nonzero(free))
        return np.sort(self.nearest(query, min(max(self.probes, TIMES_WANTED * size), n), free))


def draw(n: int, limit: int, seed: int) -> NDArray[np.int64]:
    """Select at most `limit` of n rows: a random row from each of `limit` equal intervals.

    Intervals represent all places of a map equally. Random selection avoids aliasing with periodic
    orders of frames, such as from alternating robots.
    """
    if n <= limit:
        return np.arange(n)
    edges = np.arange(limit + 1) * n // limit
    return np.random.default_rng(seed).integers(edges[:-1], edges[1:])


def sketch(signatures: Bytes, means: Bytes) -> Bytes:
    """Return the sketches (n, ceil(d / 8)) of signatures (n, d); see `Sketches`."""
    return np.packbits(signatures > means, axis=1, bitorder="little")


def make_sketches(vectors: Bytes) -> Sketches:
    """Compute the sketches of signatures (N, d), N >= 1, deterministically."""
    n, d = vectors.shape
    means = vectors[draw(n, MEASURED, 0)].mean(axis=0, dtype=np.float64).astype(np.uint8)
    index = library().IndexBinaryFlat(8 * -(-d // 8))
    step = max(BLOCK_BYTES // d, 1)
    for start in range(0, n, step):
        index.add(sketch(vectors[start : start + step], means))
    return Sketches(means, index)


def measure_sketches(sketches: Sketches, vectors: Bytes) -> tuple[Sketches, Recall]:
    """Increase the probes of sketches until the recall of a sample of queries reaches ENOUGH.

    Returns
    -------
    sketches : sketches with `probes`, which are LEAST_SELECTED times a power of two
    recall : measured recall
    """
    n, d = vectors.shape
    chosen = draw(n, min(max(COMPARED_BYTES // (n * d), LEAST), MOST), 0)
    near, expected = min(NEAR, n - 1), list[tuple[int, NDArray[np.int64]]]()
    for row, others in neighbours(vectors, chosen, 2 * near) if near else ():
        exact = distances(vectors[row], vectors, "l2", others)
        # frames at the same distance count as equally good
        expected.append((row, others[exact <= np.partition(exact, near - 1)[near - 1]]))
    probes = LEAST_SELECTED
    while (share := _share_found(sketches, vectors, expected, probes)) < ENOUGH and probes < n:
        probes *= 2
    recall = Recall(share=share, near=NEAR, sample=len(chosen), probes=probes, frames=n)
    return replace(sketches, probes=probes), recall


def _share_found(
    sketches: Sketches, vectors: Bytes, expected: list[tuple[int, NDArray[np.int64]]], probes: int
) -> float:
    """Return the share of the nearest frames among the first `probes` rows of each query."""
    near, count = min(NEAR, len(vectors) - 1), 0
    for row, others in expected:
        rows = sketches.nearest(vectors[row], min(probes + 1, len(vectors)))
        count += min(int(np.isin(others, rows[rows != row][:probes]).sum()), near)
    return count / (near * len(expected)) if expected else 1.0


def neighbours(
    vectors: Bytes, chosen: NDArray[np.int64], most: int
) -> Iterator[tuple[int, NDArray[np.int64]]]:
    """Yield each of the rows `chosen` (c,) with its nearest other rows, at most `most`, unordered.

    Rows are compared with all signatures (N, d), N > 1, by matrix products: they take a third of
    the time of `distances`, but rounding may affect the order of almost equal distances.
    """
    n, d = vectors.shape
    most, step = min(most, n - 1), max(BLOCK_BYTES // d, 1)
    queries = vectors[chosen].astype(np.float32)
    near, rows = np.empty((len(chosen), 0), np.float32), np.empty((len(chosen), 0), np.int64)
    for start in range(0, n, step):
        block = vectors[start : start + step].astype(np.float32)
        squares: Floats32 = np.einsum("ij,ij->i", block, block) - 2 * (queries @ block.T)
        own = np.flatnonzero((chosen >= start) & (chosen < start + step))
        squares[own, chosen[own] - start] = np.inf
        first = np.argpartition(squares, min(most, len(block)) - 1, axis=1)[:, :most]
        near = np.hstack([near, np.take_along_axis(squares, first, axis=1)])
        rows = np.hstack([rows, first + start])
    first = np.argpartition(near, most - 1, axis=1)[:, :most]
    return zip(chosen.tolist(), np.take_along_axis(rows, first, axis=1), strict=True)


def map_sketches(path: Path, means: Path, n: int, dimension: int, probes: int) -> Sketches:
    """Map the sketches of n signatures and their means from verified parts.

    Raises
    ------
    DamagedIndex : If a part is missing or belongs to other signatures.
    """
    index = map_binary(path, n, 8 * -(-dimension // 8))
    data = mapped(means)
    if len(data) != dimension:
        raise DamagedIndex(f"{means}: not the means of signatures of {dimension} bytes.")
    return Sketches(np.frombuffer(data, np.uint8), index, probes)
