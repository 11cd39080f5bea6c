"""Segments: the immutable parts of a version, searched one by one and merged as they grow many.

    frames that are new  --\\
    segments of the version before  --merge_plan-->  sources  --write_segment-->  segments

A publication writes what is new as one segment, and merges into it what is not at least `RATIO`
times as large as the next smaller: each time a frame is written again, its segment is larger by a
third at least, so that all writing together is in O(n log n) (the logarithmic method of Bentley and
Saxe).
Frames that are gone stay in the file, and in a list beside it, until their segment is written
again.
"""

from __future__ import annotations

import mmap
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sceneprint.atomic_files import create_private
from sceneprint.errors import DamagedIndex
from sceneprint.geometry.retrieval.ranking import Metric, distances
from sceneprint.index import faiss_index
from sceneprint.index.faiss_index import codes_of, map_index, nearest
from sceneprint.index.index_manifest import PartOfIndex, Recall, SegmentFiles
from sceneprint.index.part_files import (
    BLOCK_BYTES,
    Block,
    Keys,
    check_block,
    mapped,
    put,
    unfinished,
)
from sceneprint.index.sketches import (
    NEAR,
    Sketches,
    make_sketches,
    map_sketches,
    measure_sketches,
)
from sceneprint.types import Bytes

if TYPE_CHECKING:
    from faiss import IndexScalarQuantizer

#: A segment has at least this many times the frames of the next smaller one. By 2 a map of 100,000
#: frames has up to 7 segments, a search takes a fifth longer, and a fifth less is written.
RATIO = 3
#: Segments of a version, at most: of more, the two smallest are merged.
MOST_SEGMENTS = 8
#: Share of a segment's frames that may be gone before it is written again without them.
GONE_SHARE = 0.25
#: Bytes of signatures up to which a map has no sketches: comparing all takes 3 ms.
FLAT_BYTES = 1 << 24
#: Of a larger map, segments of at most this share of FLAT_BYTES have none.
FLAT_SHARE = 1 / 8
#: Where fewer than one in this many frames may be found, they are compared one by one: FAISS reads
#: all of them.
FEW = 8
#: Longest answer that FAISS gives: of a longer one, ordering costs more than comparing.
LONGEST = 2048

#: Rows or keys of frames, and their distances.
Found = tuple[NDArray[np.int64], NDArray[np.int64]]


class Places:
    """The places of keys in a list, found by bisection.

    Parameters
    ----------
    keys : (n,) in their order; a rising list is not copied

    Raises
    ------
    ValueError : a key is there twice.
    """

    def __init__(self, keys: Keys) -> None:
        self._order: NDArray[np.intp] | None = None
        self._rising = keys
        if (keys[1:] <= keys[:-1]).any():
            self._order = np.argsort(keys)
            self._rising = keys[self._order]
            again = self._rising[1:] == self._rising[:-1]
            if again.any():
                raise ValueError(f"the keys {self._rising[1:][again][:5].tolist()} are there twice")

    def of(self, keys: Keys) -> NDArray[np.int64]:
        """Places (m,) of keys (m,); -1 for a key that is not there."""
        if len(self._rising) == 0:
            return np.full(len(keys), -1, np.int64)
        at = np.minimum(np.searchsorted(self._rising, keys), len(self._rising) - 1)
        places = at if self._order is None else self._order[at]
        return np.where(self._rising[at] == keys, places, -1)

    def found(self, keys: Keys) -> NDArray[np.int64]:
        """Places of those of some keys, rising, that are there."""
        if len(self._rising) == 0 or len(keys) == 0:
            return np.empty(0, np.int64)
        # most keys of a long list are of other segments, which hold frames of other times
        first = keys.searchsorted(self._rising[0])
        last = keys.searchsorted(self._rising[-1], "right")
        if first == last:
            return np.empty(0, np.int64)
        at = self.of(keys[first:last])
        return at[at >= 0]


@dataclass(frozen=True, eq=False)
class Segment:
    """Signatures of some frames, in parts that are mapped.

    Parameters
    ----------
    record : the names of its parts
    keys : (N,) int64, rising, of all frames in its parts
    index : of FAISS, over their signatures in the same order
    sketches : of its frames; None where all of them are compared
    gone : (g,) int64, rising, of the frames that do not count: deleted since, or signed anew and
        in another segment
    """

    record: SegmentFiles
    keys: Keys
    index: IndexScalarQuantizer
    sketches: Sketches | None
    gone: Keys

    def __len__(self) -> int:
        return len(self.keys) - len(self.gone)

    @cached_property
    def vectors(self) -> Bytes:
        """Signatures (N, D) uint8, read-only, in the order of the keys."""
        return codes_of(self.index)

    @cached_property
    def places(self) -> Places:
        """Rows by keys, of the frames too that are gone."""
        return Places(self.keys)

    @cached_property
    def gone_rows(self) -> NDArray[np.int64]:
        """Rows (g,) of the frames that are gone."""
        return self.places.of(self.gone)

    @cached_property
    def _gone_places(self) -> Places:
        return Places(self.gone)

    def rows_of(self, keys: Keys) -> NDArray[np.int64]:
        """Rows (n,) of frames; -1 for one that is not there, or gone."""
        rows = self.places.of(keys)
        if len(self.gone):
            rows[self._gone_places.of(keys) >= 0] = -1
        return rows

    def standing_rows(self, gone: Keys) -> NDArray[np.int64]:
        """Rows of all frames but some, all rising."""
        return np.delete(np.arange(len(self.keys)), self.places.found(gone))

    def nearest(
        self, query: Bytes, size: int, gone: Keys, among: Keys | None, *, metric: Metric,
        exact: bool,
    ) -> tuple[Found, bool, int]:  # fmt: skip
        """Find the nearest frames of those that may be found.

        Parameters
        ----------
        query : (D,) uint8
        size : of the answer
        gone : (g,) rising, of frames that may not be found
        among : (a,) rising, of those that may; None: all others
        exact : compare every frame that may be found

        Returns
        -------
        keys among which the nearest are, and their distances; whether every frame was compared;
        and how many were
        """
        free = self._free_rows(gone, among)
        count = len(self.keys) if free is None else int(np.count_nonzero(free))
        rows: NDArray[np.int64] | None = None  # None: all that are free
        if free is not None and count < len(free) // FEW:
            rows = np.flatnonzero(free)
        elif self.sketches is not None and not exact:
            rows = self.sketches.candidates(query, min(size, count), free)
        elif size <= LONGEST and metric == "l2":
            found = nearest(self.index, query, min(size, count), free)
            if found is not None:
                return (self.keys[found[0]], found[1]), True, count
        if rows is None:
            rows = np.arange(len(self.keys)) if free is None else np.flatnonzero(free)
        distant = distances(query, self.vectors, metric, rows)
        return (self.keys[rows], distant), len(rows) == count, len(rows)

    def _free_rows(self, gone: Keys, among: Keys | None) -> NDArray[np.bool_] | None:
        """Which rows (N,) may be found; None: all."""
        rows = self.places.found(gone)
        if among is None and len(rows) == len(self.gone) == 0:
            return None
        free = np.full(len(self.keys), among is None)
        if among is not None:
            free[self.places.found(among)] = True
        free[rows] = free[self.gone_rows] = False
        return free


def open_segment(folder: Path, record: SegmentFiles, dimension: int) -> Segment:
    """Map the parts of a segment, which the caller has verified.

    Raises
    ------
    DamagedIndex : one of them is missing, or not what its kind is.
    """
    names = {name.rpartition(".")[2]: folder / name for name, _ in record.files}
    keys, sketches = _rising_keys(names["keys"]), None
    index = map_index(names["faiss"], len(keys), dimension)
    if "sketches" in names:
        if "means" not in names:
            raise DamagedIndex(f"{names['sketches']}: of no means.")
        files, probes = (names["sketches"], names["means"]), record.recall.probes
        sketches = map_sketches(*files, len(keys), dimension, probes)
    gone = np.empty(0, np.int64)
    if "gone" in names:
        gone = _rising_keys(names["gone"])
        if not np.isin(gone, keys).all():
            raise DamagedIndex(f"{names['gone']}: names frames that its segment has not.")
    return Segment(record, keys, index, sketches, gone)


def _rising_keys(path: Path) -> Keys:
    keys = np.frombuffer(mapped(path), "<i8")
    if (keys[1:] <= keys[:-1]).any():
        raise DamagedIndex(f"{path}: its keys are not in order.")
    return keys


# Publication: what becomes of the segments before, and of what is new.


def merge_plan(sizes: Sequence[int]) -> list[list[int]]:
    """Return the groups of places in `sizes`, the smallest first, that each become one segment."""
    groups: list[list[int]] = []
    total = 0
    for at in sorted(range(len(sizes)), key=lambda each: sizes[each]):
        if groups and sizes[at] < RATIO * total:
            groups[-1].append(at)
            total += sizes[at]
        else:
            groups.append([at])
            total = sizes[at]
    while len(groups) > MOST_SEGMENTS:
        groups[:2] = [groups[0] + groups[1]]
    return groups


@dataclass(frozen=True, eq=False)
class SegmentSource:
    """Frames that go into a segment: `rows` (r,) of `keys` (N,) and `vectors` (N, D).

    `segment` holds them now, None where they are new; of it `gone` (g,) will not count.
    """

    keys: Keys
    vectors: Bytes
    rows: NDArray[np.int64]
    segment: Segment | None
    gone: Keys

    def __len__(self) -> int:
        return len(self.rows)


def segment_sources(
    segments: Sequence[Segment], new_keys: Keys, stored: Bytes, drop: frozenset[int]
) -> list[SegmentSource]:
    """Return what stays of segments, and what is new; nothing of which nothing stays."""
    none, dropped = np.empty(0, np.int64), np.fromiter(drop, np.int64, len(drop))
    changed = np.union1d(dropped, new_keys)
    found = []
    for one in segments:
        gone = np.union1d(one.gone, one.keys[one.places.found(changed)])
        found.append(SegmentSource(one.keys, one.vectors, one.standing_rows(gone), one, gone))
    new = np.flatnonzero(~np.isin(new_keys, dropped))
    found.append(SegmentSource(new_keys, stored, new, None, none))
    return [each for each in found if len(each)]


def spool_blocks(
    folder: Path, blocks: Iterable[Block], dimension: int | None
) -> tuple[Keys, Bytes]:
    """Return keys (n,) and signatures (n, D) in a file without a name, not in memory.

    Raises
    ------
    ValueError : they are none, or of several lengths, or have a key twice.
    """
    keys, path = [np.empty(0, np.int64)], unfinished(folder)
    with os.fdopen(create_private(path), "w+b") as file:
        path.unlink()
        for own, signatures in blocks:
            if dimension is not None and signatures.ndim == 2 and signatures.shape[1] != dimension:
                lengths = sorted({dimension, signatures.shape[1]})
                raise ValueError(f"signatures of {lengths} bytes in one map")
            check_block(own, signatures, signatures.shape[-1])
            dimension = signatures.shape[1]
            file.write(np.ascontiguousarray(signatures).data)
            keys.append(own)
        file.flush()
        found = np.concatenate(keys)
        Places(found)  # raises where a key is there twice
        if len(found) == 0:
            return found, np.empty((0, dimension or 1), np.uint8)
        data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    return found, np.frombuffer(data, np.uint8).reshape(len(found), -1)


def write_segment(
    folder: Path, sources: Sequence[SegmentSource], *, clean: bool, flat_bytes: float
) -> SegmentFiles:
    """Write the frames of some sources as one segment, in the order of their keys.

    A segment that is not to change is not read, and its parts are named again.

    Parameters
    ----------
    clean : leave nothing of frames that are gone
    flat_bytes : of signatures, above which there are sketches
    """
    only = sources[0]
    may_be_gone = 0 if clean else GONE_SHARE * len(only.keys)
    if len(sources) == 1 and only.segment is not None and len(only.gone) <= may_be_gone:
        return _keep_segment(folder, only.segment, only.gone, flat_bytes)
    keys = np.concatenate([each.keys[each.rows] for each in sources])
    by_key = np.argsort(keys)
    keys, order = keys[by_key], np.empty(len(keys), np.int64)
    order[by_key] = np.arange(len(keys))
    index, vectors = faiss_index.allocate(len(keys), only.vectors.shape[1])
    step, start = max(BLOCK_BYTES // vectors.shape[1], 1), 0
    for each in sources:
        places = order[start : start + len(each)]
        start += len(each)
        for first in range(0, len(each), step):
            some = slice(first, first + step)
            vectors[places[some]] = each.vectors[each.rows[some]]
    recall = _flat_recall(len(keys))
    files = [
        put(folder, "keys", lambda take: take(keys.astype("<i8").tobytes())),
        put(folder, "faiss", lambda take: faiss_index.write_index(index, take)),
    ]
    if vectors.nbytes > flat_bytes:
        sketches, recall = _put_sketches(folder, vectors)
        files += sketches
    return SegmentFiles(files=tuple(files), recall=recall)


def _put_sketches(folder: Path, vectors: Bytes) -> tuple[list[PartOfIndex], Recall]:
    sketches, recall = measure_sketches(make_sketches(vectors), vectors)
    files = [
        put(folder, "sketches", lambda take: faiss_index.write_index(sketches.index, take)),
        put(folder, "means", lambda take: take(sketches.means.tobytes())),
    ]
    return files, recall


def _flat_recall(frames: int) -> Recall:
    return Recall(share=1.0, near=NEAR, sample=0, probes=0, frames=frames)


def _keep_segment(folder: Path, segment: Segment, gone: Keys, flat_bytes: float) -> SegmentFiles:
    """Return the parts of a segment that stays, with other frames gone, and sketches if need be.

    Of a map that has become large its older segments get sketches, which no search needed before.
    """
    kept, recall, more = ["keys", "faiss"], segment.record.recall, list[PartOfIndex]()
    if segment.vectors.nbytes <= flat_bytes:
        recall = _flat_recall(len(segment.keys))
    elif segment.sketches is not None:
        kept += ["sketches", "means"]
    else:
        more, recall = _put_sketches(folder, segment.vectors)
    if len(gone) == len(segment.gone):
        kept.append("gone")
    else:
        more.append(put(folder, "gone", lambda take: take(gone.astype("<i8").tobytes())))
    files = [one for one in segment.record.files if one[0].rpartition(".")[2] in kept]
    return SegmentFiles(files=(*files, *more), recall=recall)
