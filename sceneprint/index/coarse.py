"""FAISS over the codes of a map: eight bits a number, squared Euclidean distance, all compared.

Of what FAISS offers this is the kind that was measured to be right (docs/), and nobody else names
one: some kinds are silently wrong under L1, some abort the process. A live index is never
changed, because a search beside a change crashes: appending works on a copy.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sceneprint.errors import DamagedIndex
from sceneprint.types import Floats32

if TYPE_CHECKING:
    from faiss import IndexScalarQuantizer

#: What 8 bits span on either side beyond what was seen at the fit, of the span seen: frames that
#: are appended later lie outside more often than frames of the sample.
MARGIN = 0.25


def _faiss() -> Any:
    """The library, whose own stubs contradict it; imported late, for it takes 0.3 s."""
    import faiss

    return faiss


@dataclass(frozen=True, eq=False)
class Coarse:
    """Codes of the frames of a generation, in their order.

    Parameters
    ----------
    index : of FAISS
    """

    index: IndexScalarQuantizer

    def __len__(self) -> int:
        return int(self.index.ntotal)

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
        _, positions = self.index.search(code[None], count, params=parameters)
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
            index.add(block)
        return Coarse(index)


def train_coarse(sample: Floats32) -> Coarse:
    """An empty index whose eight bits span the sample, and a margin.

    Parameters
    ----------
    sample : (n, d) codes, n >= 1
    """
    faiss = _faiss()
    faiss.omp_set_num_threads(1)
    index = faiss.IndexScalarQuantizer(
        sample.shape[1], faiss.ScalarQuantizer.QT_8bit, faiss.METRIC_L2
    )
    index.sq.rangestat = faiss.ScalarQuantizer.RS_minmax
    index.sq.rangestat_arg = MARGIN
    index.train(sample)
    return Coarse(index)


def write_coarse(coarse: Coarse) -> bytes:
    """An index as bytes, in FAISS's own format."""
    data: bytes = _faiss().serialize_index(coarse.index).tobytes()
    return data


def read_coarse(data: bytes, dimension: int, number: int) -> Coarse:
    """An index from its bytes.

    Parameters
    ----------
    data : whose checksum the caller has checked: FAISS crashes on bytes that mean harm
    dimension : of a code
    number : of frames

    Raises
    ------
    DamagedIndex : another kind, dimension or number, or of a FAISS that this one cannot read.
    """
    faiss = _faiss()
    try:
        index = faiss.deserialize_index(np.frombuffer(data, np.uint8))
    except RuntimeError as error:
        raise DamagedIndex(f"FAISS cannot read its index: {error}") from error
    if (
        not isinstance(index, faiss.IndexScalarQuantizer)
        or (index.d, index.ntotal, index.metric_type) != (dimension, number, faiss.METRIC_L2)
        or index.sq.qtype != faiss.ScalarQuantizer.QT_8bit
    ):
        raise DamagedIndex(f"No FAISS index of {number} codes of {dimension} numbers.")
    return Coarse(index)
