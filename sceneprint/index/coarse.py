"""FAISS over the codes of a map: eight bits a number, squared Euclidean distance, all compared.

The bits are the same steps on every axis, so that FAISS compares integers: half the time of its
kind that scales each axis, and no neighbour lost (docs/performance.md). Of what FAISS offers this
is the kind that was measured to be right, and nobody else names one: some kinds are silently
wrong under L1, some abort the process. A live index is never changed, because a search beside a
change crashes: appending works on a copy.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sceneprint.errors import DamagedIndex
from sceneprint.types import Floats32

if TYPE_CHECKING:
    from faiss import IndexScalarQuantizer

#: What 8 bits span on either side beyond what was seen at the fit, of the widest span seen: frames
#: that are appended later lie outside more often than frames of the sample.
MARGIN = 0.25
#: An index as bytes: magic, schema, axes, step, then the middles and FAISS's own format.
MAGIC, SCHEMA_VERSION = b"SPCOAR", 2
_HEAD = struct.Struct("<6sHIf")


def _faiss() -> Any:
    """The library, whose own stubs contradict it; imported late, for it takes 0.3 s."""
    import faiss

    return faiss


@dataclass(frozen=True, eq=False)
class Coarse:
    """Codes of the frames of a generation, in their order.

    Parameters
    ----------
    middle : (d,) float32, of what 8 bits span
    step : of one bit, on every axis
    index : of FAISS, over numbers from 0 to 255
    """

    middle: Floats32
    step: float
    index: IndexScalarQuantizer

    def __len__(self) -> int:
        return int(self.index.ntotal)

    def _levels(self, codes: Floats32) -> Floats32:
        """Codes as FAISS keeps them, which cuts off fractions and does not look at the bounds."""
        levels: Floats32 = np.rint(
            (codes - self.middle) / np.float32(self.step) + np.float32(127.5)
        )
        return np.clip(levels, 0, 255, out=levels)

    def nearest(self, code: Floats32, count: int, excluded: NDArray[np.int64]) -> NDArray[np.int64]:
        """The frames whose codes are nearest.

        Parameters
        ----------
        code : (d,) of the query
        count : of frames
        excluded : (e,) positions that are not wanted, none twice

        Returns
        -------
        (r,) positions, in no particular order; r is `count`, or all that there are
        """
        faiss = _faiss()
        faiss.omp_set_num_threads(1)  # of this thread: requests are what runs side by side
        count = min(count, len(self) - len(excluded))
        if count <= 0:
            return np.empty(0, np.int64)
        parameters = None
        if len(excluded):
            wanted = np.ones(len(self), np.bool_)
            wanted[excluded] = False
            selector = faiss.IDSelectorBitmap(np.packbits(wanted, bitorder="little"))
            parameters = faiss.SearchParameters(sel=selector)
        _, positions = self.index.search(self._levels(code[None]), count, params=parameters)
        return np.asarray(positions[0], np.int64)

    def appended(self, kept: NDArray[np.int64], codes: Iterable[Floats32]) -> Coarse:
        """A copy with some frames left out and others put behind them.

        Parameters
        ----------
        kept : (k,) positions that stay, rising
        codes : blocks of (n, d)
        """
        faiss = _faiss()
        faiss.omp_set_num_threads(1)
        index = faiss.clone_index(self.index)
        gone = np.ones(len(self), np.bool_)
        gone[kept] = False
        if gone.any():
            index.remove_ids(np.flatnonzero(gone))
        for block in codes:
            index.add(self._levels(block))
        return Coarse(self.middle, self.step, index)


def train_coarse(sample: Floats32) -> Coarse:
    """An empty index whose eight bits span the sample, and a margin.

    Parameters
    ----------
    sample : (n, d) codes, n >= 1
    """
    faiss = _faiss()
    faiss.omp_set_num_threads(1)
    low, high = sample.min(axis=0), sample.max(axis=0)
    step = float(np.float32((high - low).max() * (1 + 2 * MARGIN) / 255)) or 1.0
    index = faiss.IndexScalarQuantizer(
        sample.shape[1], faiss.ScalarQuantizer.QT_8bit_direct, faiss.METRIC_L2
    )
    return Coarse((low + high) / 2, step, index)


def write_coarse(coarse: Coarse) -> bytes:
    """An index as bytes."""
    head = _HEAD.pack(MAGIC, SCHEMA_VERSION, len(coarse.middle), coarse.step)
    data: bytes = _faiss().serialize_index(coarse.index).tobytes()
    return b"".join([head, coarse.middle.astype("<f4").tobytes(), data])


def read_coarse(data: bytes, dimension: int, number: int) -> Coarse:
    """An index from its bytes.

    Parameters
    ----------
    data : whose checksum the caller has checked: FAISS crashes on bytes that mean harm
    dimension : of a code
    number : of frames

    Raises
    ------
    DamagedIndex : another schema, kind, dimension or number, or of a FAISS that this one cannot
        read.
    """
    faiss = _faiss()
    start = _HEAD.size + 4 * dimension
    magic, schema, d, step = _HEAD.unpack_from(data.ljust(_HEAD.size, b"\0"))
    if (magic, schema, d) != (MAGIC, SCHEMA_VERSION, dimension) or len(data) < start:
        raise DamagedIndex(f"No index of {dimension} numbers a code, of schema {SCHEMA_VERSION}.")
    middle = np.frombuffer(data, "<f4", dimension, _HEAD.size).astype(np.float32)
    try:
        index = faiss.deserialize_index(np.frombuffer(data, np.uint8, offset=start))
    except RuntimeError as error:
        raise DamagedIndex(f"FAISS cannot read its index: {error}") from error
    if (
        not isinstance(index, faiss.IndexScalarQuantizer)
        or (index.d, index.ntotal, index.metric_type) != (dimension, number, faiss.METRIC_L2)
        or index.sq.qtype != faiss.ScalarQuantizer.QT_8bit_direct
    ):
        raise DamagedIndex(f"No FAISS index of {number} codes of {dimension} numbers.")
    return Coarse(middle, step, index)
