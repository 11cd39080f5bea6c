"""Sketches: one bit for each byte of a signature, which select the frames that a search compares.

    signatures (N, d) uint8  --write_segment-->  words (N, w) uint64, in a file beside them
    query (d,)  --Sketches.candidates-->  rows whose sketches differ from its own in the fewest bits

A bit says whether a byte is above the mean of its segment. A sketch takes an eighth of its
signature, and to compare two takes an xor and a count of bits. All sketches of a segment are
compared with a query, and the nearest signatures are then found among the rows selected, by their
exact distances. How many to select is measured when the segment is written.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sceneprint.errors import DamagedIndex
from sceneprint.geometry.kernel import kernel
from sceneprint.geometry.retrieval.ranking import distances
from sceneprint.index.generation_files import BLOCK_BYTES, Recall, draw, mapped
from sceneprint.types import Bytes, Floats32

#: Words of 64 bits: (N, w) of all frames, or (w,) of one.
Words = NDArray[np.uint64]
#: Bits in which sketches differ.
Counts = NDArray[np.uint16]

#: Frames of which the means are taken, at most.
MEASURED = 1 << 16
#: Frames that a search selects: at least so many, and so many times those it wants.
LEAST_SELECTED, TIMES_WANTED = 256, 4
#: Neighbours by which recall is measured, and the share of them that a search has to find.
NEAR, ENOUGH = 10, 0.995
#: Frames looked up: at most, at least, and so many that they are compared with no more bytes.
MOST, LEAST, COMPARED_BYTES = 100, 10, 1 << 36

MAGIC, SCHEMA_VERSION = b"SPBITS", 1
_HEAD = struct.Struct("<6sHQQ")


@dataclass(frozen=True, eq=False)
class Sketches:
    """The sketches of a segment.

    Parameters
    ----------
    means : (d,) uint8, d < 65535; a bit is set where the byte is larger
    words : (N, w) uint64, of each row; bits beyond d are 0
    probes : rows that a search selects at least
    """

    means: Bytes
    words: Words
    probes: int = LEAST_SELECTED

    def __len__(self) -> int:
        return len(self.words)

    def differing(
        self, query: Bytes, free: NDArray[np.bool_] | None
    ) -> tuple[Counts, NDArray[np.int64]]:
        """In how many bits each row differs from a query, and how many rows differ in so many.

        Parameters
        ----------
        query : (d,) uint8
        free : (N,) which rows count; all of them if None

        Returns
        -------
        (N,) bits, d + 1 for rows that do not count; and (d + 1,) rows
        """
        bits, rows = np.empty(len(self), np.uint16), np.zeros(len(query) + 1, np.int64)
        free = np.ones(len(self), np.bool_) if free is None else free
        _count_bits(self.words, sketch(query[None], self.means)[0], free, bits, rows)
        return bits, rows

    def candidates(
        self, query: Bytes, size: int, free: NDArray[np.bool_] | None
    ) -> NDArray[np.int64]:
        """Rows (r,), rising, that a query is compared with.

        Parameters
        ----------
        query : (d,) uint8
        size : rows that are wanted
        free : (N,) which rows may be found; all of them if None
        """
        bits, rows = self.differing(query, free)
        limit = np.searchsorted(np.cumsum(rows), max(self.probes, TIMES_WANTED * size))
        return np.flatnonzero(bits <= min(int(limit), len(query)))


@kernel
def _ones(x: np.uint64) -> np.uint64:
    """How many bits are set: of pairs, of fours, of bytes, and their sum.

    The compiler knows this form, and makes it one instruction.
    """
    x = x - ((x >> np.uint64(1)) & np.uint64(0x5555555555555555))
    x = (x & np.uint64(0x3333333333333333)) + ((x >> np.uint64(2)) & np.uint64(0x3333333333333333))
    x = (x + (x >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return (x * np.uint64(0x0101010101010101)) >> np.uint64(56)


@kernel
def _count_bits(
    words: Words, query: Words, free: NDArray[np.bool_], bits: Counts, rows: NDArray[np.int64]
) -> None:
    """See `Sketches.differing`."""
    for i in range(len(words)):
        total = np.int64(0)
        for j in range(len(query)):
            total += np.int64(_ones(words[i, j] ^ query[j]))
        if free[i]:
            bits[i] = total
            rows[total] += 1
        else:
            bits[i] = len(rows)


def sketch(signatures: Bytes, means: Bytes) -> Words:
    """Sketches (n, w) of signatures (n, d): see `Sketches`."""
    packed = np.packbits(signatures > means, axis=1, bitorder="little")
    padded = np.zeros((len(packed), -(-packed.shape[1] // 8) * 8), np.uint8)
    padded[:, : packed.shape[1]] = packed
    return padded.view("<u8")


def make_sketches(vectors: Bytes) -> Sketches:
    """Sketches of signatures (N, d), N >= 1: the same of the same signatures."""
    n, d = vectors.shape
    means = vectors[draw(n, MEASURED, 0)].mean(axis=0, dtype=np.float64).astype(np.uint8)
    words, step = np.empty((n, -(-d // 64)), np.uint64), max(BLOCK_BYTES // d, 1)
    for start in range(0, n, step):
        words[start : start + step] = sketch(vectors[start : start + step], means)
    words.flags.writeable = False  # as a mapped file is: kernels are compiled for either
    return Sketches(means, words)


def measure_sketches(sketches: Sketches, vectors: Bytes, seed: int = 0) -> tuple[Sketches, Recall]:
    """Look up some frames, and select so many that a search finds ENOUGH of the nearest.

    Returns
    -------
    the sketches with their `probes`, LEAST_SELECTED times a power of two; and what a search finds
    """
    n, d = vectors.shape
    chosen = draw(n, min(max(COMPARED_BYTES // (n * d), LEAST), MOST), seed)
    near = min(NEAR, n - 1)
    ranks = np.empty((len(chosen), near), np.int64)
    for i, (row, others) in enumerate(neighbours(vectors, chosen, 2 * near) if near else ()):
        free = np.ones(n, np.bool_)
        free[row] = False
        bits, rows = sketches.differing(vectors[row], free)
        before = np.cumsum(rows) - rows  # rows that differ in fewer bits
        exact = distances(vectors[row], vectors, "l2", others)
        # an equal distance is as good: which of two equal frames is meant is nobody's concern
        wanted = others[exact <= np.partition(exact, near - 1)[near - 1]]
        ranks[i] = np.sort(before[bits[wanted]])[:near]
    probes = LEAST_SELECTED
    while probes < n and (ranks >= probes).sum() > (1 - ENOUGH) * ranks.size:
        probes *= 2
    share = 1 - float((ranks >= probes).sum()) / max(ranks.size, 1)
    return replace(sketches, probes=probes), Recall(share, NEAR, len(chosen), probes, n)


def neighbours(
    vectors: Bytes, chosen: NDArray[np.int64], most: int
) -> Iterator[tuple[int, NDArray[np.int64]]]:
    """Each of some rows (c,), and the others nearest to it, at most `most`, in no order.

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


def write_sketches(sketches: Sketches, take: Callable[[bytes], Any]) -> None:
    """Give sketches as bytes, block by block. The number of probes is not among them."""
    d = len(sketches.means)
    take(_HEAD.pack(MAGIC, SCHEMA_VERSION, d, len(sketches)))
    take(sketches.means.tobytes() + bytes(-d % 8))
    step = max(BLOCK_BYTES // (8 * sketches.words.shape[1]), 1)
    for start in range(0, len(sketches), step):
        take(sketches.words[start : start + step].astype("<u8").tobytes())


def map_sketches(path: Path, n: int, dimension: int, probes: int) -> Sketches:
    """Map sketches into memory that processes share.

    Parameters
    ----------
    path : of a file whose checksum the caller has checked
    n, dimension : of the signatures
    probes : rows that a search selects at least

    Raises
    ------
    DamagedIndex : missing, of another schema, or of other signatures.
    """
    data = mapped(path)
    magic, schema, d, rows = _HEAD.unpack(data[: _HEAD.size].ljust(_HEAD.size, b"\0"))
    width = -(-dimension // 64)
    start = _HEAD.size + dimension + -dimension % 8
    size = start + 8 * n * width
    if (magic, schema, d, rows, len(data)) != (MAGIC, SCHEMA_VERSION, dimension, n, size):
        raise DamagedIndex(f"{path}: no sketches of {n} signatures of {dimension} bytes.")
    means = np.frombuffer(data, np.uint8, dimension, _HEAD.size)
    words = np.frombuffer(data, "<u8", n * width, start).reshape(n, width)
    return Sketches(means, words, probes)
