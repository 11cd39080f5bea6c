"""Compact codes: a signature of thousands of bytes as at most 128 numbers.

A code is a principal component analysis fitted on the map itself; fitted elsewhere it is worse.
It serves to propose candidates only, whose exact distances decide. Codes of two fits are never
compared, hence the id.
"""

from __future__ import annotations

import hashlib
import struct
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneprint.errors import DamagedIndex
from sceneprint.types import Bytes, Floats, Floats32

#: Axes of a code, and rows that decide them. More rows cost time by their square.
DIMENSION, SAMPLE = 128, 1000
MAGIC, SCHEMA_VERSION = b"SPCODE", 1
_HEAD = struct.Struct("<6sHII")
#: Numbers converted to floating point at once, and columns of the sample at once.
_NUMBERS, _COLUMNS = 4 << 20, 4096
#: Least variance of an axis, of that of the first: below is the rounding of 32 bits.
_LEAST_VARIANCE = 1e-5


@dataclass(frozen=True, eq=False)
class Code:
    """An affine map of signatures to a few numbers.

    Parameters
    ----------
    mean : (D,) float32
    matrix : (d, D) float32, orthonormal rows, the widest first
    id : of the content, 64 hexadecimal digits
    """

    mean: Floats32
    matrix: Floats32
    id: str

    def encode(self, signatures: Bytes) -> Floats32:
        """Codes of signatures, in blocks: memory is bounded whatever their number.

        Parameters
        ----------
        signatures : (N, D) uint8

        Returns
        -------
        (N, d) float32

        Raises
        ------
        ValueError : not bytes of that shape.
        """
        length = len(self.mean)
        if signatures.ndim != 2 or signatures.shape[1] != length or signatures.dtype != np.uint8:
            raise ValueError(f"{signatures.dtype} {signatures.shape}, not signatures of {length}")
        result = np.empty((len(signatures), len(self.matrix)), np.float32)
        step = max(_NUMBERS // length, 1)
        for start in range(0, len(signatures), step):
            rows = signatures[start : start + step].astype(np.float32)
            rows -= self.mean
            np.matmul(rows, self.matrix.T, out=result[start : start + step])
        return result


def draw(n: int, limit: int, seed: int) -> NDArray[np.int64]:
    """At most `limit` of n rows: one at random from each of as many equal stretches.

    Even, so that every place of a map counts alike; at random, so that nothing periodic in the
    order of the frames (two robots in turn) is missed.
    """
    if n <= limit:
        return np.arange(n)
    edges = np.arange(limit + 1) * n // limit
    return np.random.default_rng(seed).integers(edges[:-1], edges[1:])


def fit_code(signatures: Bytes, seed: int = 0, dimension: int = DIMENSION) -> Code:
    """Principal components of signatures, from the products of the rows among each other.

    Rows are far fewer than columns, so that the small symmetric matrix of the rows has all the
    components: exact, and a third of the time of scikit-learn's randomised solver at 125,000
    columns, without a copy of the sample in floating point.

    Parameters
    ----------
    signatures : (n, D) uint8, n >= 1, of which `draw` takes at most SAMPLE
    seed : of the draw; the same rows and seed give the same code
    dimension : most axes; fewer where the rows span fewer

    Raises
    ------
    ValueError : no rows, or no axes.
    """
    if signatures.ndim != 2 or len(signatures) < 1 or dimension < 1:
        raise ValueError(f"{dimension} axes of signatures {signatures.shape}")
    sample = signatures[draw(len(signatures), SAMPLE, seed)]
    n, length = sample.shape
    mean = sample.mean(axis=0, dtype=np.float64).astype(np.float32)
    products: Floats = np.zeros((n, n))
    for start in range(0, length, _COLUMNS):
        part = _centred(sample, mean, start)
        products += part @ part.T
    variances, vectors = np.linalg.eigh(products)  # rising
    rank = int((variances > _LEAST_VARIANCE * max(variances[-1], 1.0)).sum())
    kept = slice(-1, -min(rank, dimension) - 1, -1)
    weights = (vectors[:, kept] / np.sqrt(variances[kept])).T.astype(np.float32)
    matrix = np.zeros((max(len(weights), 1), length), np.float32)  # no axis: all codes are equal
    for start in range(0, length, _COLUMNS) if len(weights) else ():
        matrix[:, start : start + _COLUMNS] = weights @ _centred(sample, mean, start)
    return Code(mean, matrix, hashlib.sha256(_to_bytes(mean, matrix)).hexdigest())


def _centred(sample: Bytes, mean: Floats32, start: int) -> Floats32:
    columns = slice(start, start + _COLUMNS)
    part: Floats32 = sample[:, columns].astype(np.float32) - mean[columns]
    return part


def write_code(code: Code) -> bytes:
    """A code as bytes, whose SHA-256 is its id."""
    return _to_bytes(code.mean, code.matrix)


def _to_bytes(mean: Floats32, matrix: Floats32) -> bytes:
    head = _HEAD.pack(MAGIC, SCHEMA_VERSION, *matrix.shape)
    return b"".join([head, mean.astype("<f4").tobytes(), matrix.astype("<f4").tobytes()])


def read_code(data: bytes) -> Code:
    """A code from its bytes, whose checksum the caller has checked.

    Raises
    ------
    DamagedIndex : not a code of this schema.
    """
    if len(data) < _HEAD.size:
        raise DamagedIndex(f"{len(data)} bytes are no code.")
    magic, schema, d, length = _HEAD.unpack_from(data)
    if magic != MAGIC or schema != SCHEMA_VERSION or len(data) != _HEAD.size + 4 * length * (d + 1):
        raise DamagedIndex(f"The bytes are no code of schema {SCHEMA_VERSION}.")
    numbers = np.frombuffer(data, "<f4", offset=_HEAD.size).astype(np.float32)
    return Code(
        numbers[:length], numbers[length:].reshape(d, length), hashlib.sha256(data).hexdigest()
    )
