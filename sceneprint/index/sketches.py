"""Sketches: one bit for each byte of a signature, which select the frames that a search compares.

    signatures (N, d) uint8  --write_segment-->  FAISS's IndexBinaryFlat, in a file beside them
    query (d,)  --Sketches.candidates-->  rows whose sketches differ from its own in the fewest bits

A bit says whether a byte is above the mean of its segment. A sketch takes an eighth of its
signature, and to compare two takes an xor and a count of bits. All sketches of a segment are
compared with a query, and the nearest signatures are then found among the rows selected, by their
exact distances. How many to select is measured when the segment is written.
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

#: Frames of which the means are taken, at most.
MEASURED = 1 << 16
#: Frames that a search selects: at least so many, and so many times those it wants.
LEAST_SELECTED, TIMES_WANTED = 256, 4
#: Neighbours by which recall is measured, and the share of them that a search has to find.
NEAR, ENOUGH = 10, 0.995
#: Frames looked up: at most, at least, and so many that they are compared with no more bytes.
MOST, LEAST, COMPARED_BYTES = 100, 10, 1 << 36


@dataclass(frozen=True, eq=False)
class Sketches:
    """The sketches of a segment.

    Parameters
    ----------
    means : (d,) uint8; a bit is set where the byte is larger
    index : of FAISS, over the bits of each row; bits beyond d are 0
    probes : rows that a search selects at least
    """

    means: Bytes
    index: IndexBinaryFlat
    probes: int = LEAST_SELECTED

    def __len__(self) -> int:
        return int(self.index.ntotal)

    def nearest(
        self, query: Bytes, count: int, free: NDArray[np.bool_] | None = None
    ) -> NDArray[np.int64]:
        """Return the rows (count,) whose sketches differ in the fewest bits, fewest first.

        Parameters
        ----------
        query : (d,) uint8
        count : number of rows; there must be as many
        free : (N,) which rows count; all of them if None
        """
        if count == 0:
            return np.empty(0, np.int64)
        bits = sketch(query[None], self.means)
        rows: NDArray[np.int64] = self.index.search(bits, count, params=selection(free))[1][0]
        return rows

    def candidates(
        self, query: Bytes, size: int, free: NDArray[np.bool_] | None
    ) -> NDArray[np.int64]:
        """Return the rows (r,), rising, that a query is compared with.

        Parameters
        ----------
        query : (d,) uint8
        size : rows that are wanted
        free : (N,) which rows may be found; all of them if None
        """
        there = len(self) if free is None else int(np.count_nonzero(free))
        return np.sort(self.nearest(query, min(max(self.probes, TIMES_WANTED * size), there), free))


def draw(n: int, limit: int, seed: int) -> NDArray[np.int64]:
    """Return at most `limit` of n rows: one at random from each of as many equal stretches.

    Even, so that every place of a map counts alike; at random, so that nothing periodic in the
    order of the frames (two robots in turn) is missed.
    """
    if n <= limit:
        return np.arange(n)
    edges = np.arange(limit + 1) * n // limit
    return np.random.default_rng(seed).integers(edges[:-1], edges[1:])


def sketch(signatures: Bytes, means: Bytes) -> Bytes:
    """Return the sketches (n, ceil(d / 8)) of signatures (n, d): see `Sketches`."""
    return np.packbits(signatures > means, axis=1, bitorder="little")


def make_sketches(vectors: Bytes) -> Sketches:
    """Return the sketches of signatures (N, d), N >= 1: the same of the same signatures."""
    n, d = vectors.shape
    means = vectors[draw(n, MEASURED, 0)].mean(axis=0, dtype=np.float64).astype(np.uint8)
    index = library().IndexBinaryFlat(8 * -(-d // 8))
    step = max(BLOCK_BYTES // d, 1)
    for start in range(0, n, step):
        index.add(sketch(vectors[start : start + step], means))
    return Sketches(means, index)


def measure_sketches(sketches: Sketches, vectors: Bytes, seed: int = 0) -> tuple[Sketches, Recall]:
    """Look up some frames, and select so many that a search finds ENOUGH of the nearest.

    Returns
    -------
    the sketches with their `probes`, LEAST_SELECTED times a power of two; and what a search finds
    """
    n, d = vectors.shape
    chosen = draw(n, min(max(COMPARED_BYTES // (n * d), LEAST), MOST), seed)
    near, wanted = min(NEAR, n - 1), list[tuple[int, NDArray[np.int64]]]()
    for row, others in neighbours(vectors, chosen, 2 * near) if near else ():
        exact = distances(vectors[row], vectors, "l2", others)
        # an equal distance is as good: which of two equal frames is meant is nobody's concern
        wanted.append((row, others[exact <= np.partition(exact, near - 1)[near - 1]]))
    probes = LEAST_SELECTED
    while (share := _share_found(sketches, vectors, wanted, probes)) < ENOUGH and probes < n:
        probes *= 2
    recall = Recall(share=share, near=NEAR, sample=len(chosen), probes=probes, frames=n)
    return replace(sketches, probes=probes), recall


def _share_found(
    sketches: Sketches, vectors: Bytes, wanted: list[tuple[int, NDArray[np.int64]]], probes: int
) -> float:
    """Return the share of the nearest frames that are among as many rows, each without itself."""
    near, found = min(NEAR, len(vectors) - 1), 0
    for row, others in wanted:
        rows = sketches.nearest(vectors[row], min(probes + 1, len(vectors)))
        found += min(int(np.isin(others, rows[rows != row][:probes]).sum()), near)
    return found / (near * len(wanted)) if wanted else 1.0


def neighbours(
    vectors: Bytes, chosen: NDArray[np.int64], most: int
) -> Iterator[tuple[int, NDArray[np.int64]]]:
    """Return each of some rows (c,) and the others nearest to it, at most `most`, in no order.

    They are compared with all signatures (N, d), N > 1, by products of matrices, in a third of the
    time that `distances` takes. Of rows whose distances hardly differ, rounding may choose another.
    """
    n, d = vectors.shape
    most, step = min(most, n - 1), max(BLOCK_BYTES // d, 1)
    queries = vectors[chosen].astype(np.float32)
    near, found = np.empty((len(chosen), 0), np.float32), np.empty((len(chosen), 0), np.int64)
    for start in range(0, n, step):
        block = vectors[start : start + step].astype(np.float32)
        squares: Floats32 = np.einsum("ij,ij->i", block, block) - 2 * (queries @ block.T)
        own = np.flatnonzero((chosen >= start) & (chosen < start + step))
        squares[own, chosen[own] - start] = np.inf
        first = np.argpartition(squares, min(most, len(block)) - 1, axis=1)[:, :most]
        near = np.hstack([near, np.take_along_axis(squares, first, axis=1)])
        found = np.hstack([found, first + start])
    first = np.argpartition(near, most - 1, axis=1)[:, :most]
    return zip(chosen.tolist(), np.take_along_axis(found, first, axis=1), strict=True)


def map_sketches(path: Path, means: Path, n: int, dimension: int, probes: int) -> Sketches:
    """Map the sketches of n signatures, and their means, from parts that the caller has verified.

    Raises
    ------
    DamagedIndex : missing, or of other signatures.
    """
    index = map_binary(path, n, 8 * -(-dimension // 8))
    data = mapped(means)
    if len(data) != dimension:
        raise DamagedIndex(f"{means}: no means of signatures of {dimension} bytes.")
    return Sketches(np.frombuffer(data, np.uint8), index, probes)
