"""Segments of an index version. They are searched separately, and merged when there are many.

    new frames  --\\
    segments of the previous version  --merge_plan-->  sources  --write_segment-->  segments

A publication writes new frames as one segment, and merges segments that are less than `RATIO` times
as large as the next smaller segment. Whenever a frame is written again, its segment has grown by at
least a third, so the total cost is O(n log n) (the logarithmic method of Bentley and Saxe).
Removed frames remain in the files of a segment, and are listed in another file, until the segment
is written again.
"""

from __future__ import annotations

import mmap
import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

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

#: Minimum ratio of the sizes of consecutive segments. With 2, a map of 100,000 frames would have up
#: to 7 segments, a search would take a fifth longer, and a fifth less would be written.
RATIO = 3
#: Maximum number of segments of a version; with more, the two smallest are merged.
MOST_SEGMENTS = 8
#: A segment is written again without its removed frames if their share exceeds this.
GONE_SHARE = 0.25
#: Maximum total size, in bytes, of signatures without sketches; comparing them takes 3 ms.
FLAT_BYTES = 1 << 24
#: Maximum size of a segment without sketches in a larger map, as a share of FLAT_BYTES.
FLAT_SHARE = 1 / 8
#: If fewer than one in FEW frames is searchable, FAISS is not used, because it would read all
#: frames.
FEW = 8
#: Maximum number of results to request from FAISS: sorting more would take longer than comparing.
LONGEST = 2048

#: Rows or keys of frames, and their distances.
Distances = tuple[NDArray[np.int64], NDArray[np.int64]]


class Places:
    """The positions of keys in a list, by binary search.

    Parameters
    ----------
    keys : (n,) keys in any order; an ascending array is not copied

    Raises
    ------
    ValueError : If a key occurs twice.
    """

    def __init__(self, keys: Keys) -> None:
        self._order: NDArray[np.intp] | None = None
        self._rising = keys
        if (keys[1:] <= keys[:-1]).any():
            self._order = np.argsort(keys)
            self._rising = keys[self._order]
            again = self._rising[1:] == self._rising[:-1]
            if again.any():
                raise ValueError(f"the keys {self._rising[1:][again][:5].tolist()} occur twice")

    def of(self, keys: Keys) -> NDArray[np.int64]:
        """Return the positions (m,) of keys (m,); -1 for a missing key."""
        if len(self._rising) == 0:
            return np.full(len(keys), -1, np.int64)
        at = np.minimum(np.searchsorted(self._rising, keys), len(self._rising) - 1)
        places = at if self._order is None else self._order[at]
        return np.where(self._rising[at] == keys, places, -1)

    def matches(self, keys: Keys) -> NDArray[np.int64]:
        """Return the positions of ascending keys; skip keys that are not in the list."""
        if len(self._rising) == 0 or len(keys) == 0:
            return np.empty(0, np.int64)
        # most keys of a long list belong to other segments, with frames of other times
        first = keys.searchsorted(self._rising[0])
        last = keys.searchsorted(self._rising[-1], "right")
        if first == last:
            return np.empty(0, np.int64)
        at = self.of(keys[first:last])
        return at[at >= 0]


@dataclass(frozen=True, eq=False)
class Segment:
    """A segment: signatures of some frames, in mapped parts.

    Parameters
    ----------
    keys : (N,) int64, ascending keys of all frames in the parts
    index : FAISS index of the signatures in the same order
    sketches : sketches of the frames; None if all frames are compared
    gone : (g,) int64, ascending keys of removed frames: deleted, or signed again and stored in
        another segment
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
        """Return the read-only signatures (N, D) uint8 in the order of the keys."""
        return codes_of(self.index)

    @cached_property
    def places(self) -> Places:
        """Return the rows of all frames by key, including removed frames."""
        return Places(self.keys)

    @cached_property
    def gone_rows(self) -> NDArray[np.int64]:
        """Return the rows (g,) of removed frames."""
        return self.places.of(self.gone)

    @cached_property
    def _gone_places(self) -> Places:
        return Places(self.gone)

    def rows_of(self, keys: Keys) -> NDArray[np.int64]:
        """Return the rows (n,) of frames; -1 for missing and removed frames."""
        rows = self.places.of(keys)
        if len(self.gone):
            rows[self._gone_places.of(keys) >= 0] = -1
        return rows

    def standing_rows(self, gone: Keys) -> NDArray[np.int64]:
        """Return the rows of all frames except `gone`, ascending."""
        return np.delete(np.arange(len(self.keys)), self.places.matches(gone))

    def nearest(
        self, query: Bytes, size: int, gone: Keys, among: Keys | None, *, metric: Metric,
        exact: bool,
    ) -> tuple[Distances, bool, int]:  # fmt: skip
        """Compare frames with a query; return candidates that include the nearest frames.

        Parameters
        ----------
        query : (D,) uint8
        size : number of nearest frames to include
        gone : (g,) ascending keys of excluded frames
        among : (a,) ascending keys of searchable frames; None selects all others
        exact : whether to compare all searchable frames

        Returns
        -------
        keys and distances of the candidates; whether all searchable frames were compared; and the
        number of compared frames
        """
        free = self._searchable_mask(gone, among)
        count = len(self.keys) if free is None else int(np.count_nonzero(free))
        rows: NDArray[np.int64] | None = None  # None selects all searchable rows
        if free is not None and count < len(free) // FEW:
            rows = np.flatnonzero(free)
        elif self.sketches is not None and not exact:
            rows = self.sketches.candidates(query, min(size, count), free)
        elif size <= LONGEST and metric == "l2":
            hits = nearest(self.index, query, min(size, count), free)
            if hits is not None:
                return (self.keys[hits[0]], hits[1]), True, count
        if rows is None:
            rows = np.arange(len(self.keys)) if free is None else np.flatnonzero(free)
        distant = distances(query, self.vectors, metric, rows)
        return (self.keys[rows], distant), len(rows) == count, len(rows)

    def _searchable_mask(self, gone: Keys, among: Keys | None) -> NDArray[np.bool_] | None:
        """Return a mask (N,) of the searchable rows; None if all are searchable."""
        rows = self.places.matches(gone)
        if among is None and len(rows) == len(self.gone) == 0:
            return None
        free = np.full(len(self.keys), among is None)
        if among is not None:
            free[self.places.matches(among)] = True
        free[rows] = free[self.gone_rows] = False
        return free


def open_segment(folder: Path, record: SegmentFiles, dimension: int) -> Segment:
    """Map the parts of a segment; the caller has verified them.

    Raises
    ------
    DamagedIndex : If a part is missing or inconsistent.
    """
    names = {name.rpartition(".")[2]: folder / name for name, _ in record.files}
    keys, sketches = _rising_keys(names["keys"]), None
    index = map_index(names["faiss"], len(keys), dimension)
    if "sketches" in names:
        if "means" not in names:
            raise DamagedIndex(f"{names['sketches']}: the means are missing.")
        files, probes = (names["sketches"], names["means"]), record.recall.probes
        sketches = map_sketches(*files, len(keys), dimension, probes)
    gone = np.empty(0, np.int64)
    if "gone" in names:
        gone = _rising_keys(names["gone"])
        if not np.isin(gone, keys).all():
            raise DamagedIndex(f"{names['gone']}: a removed frame is not in the segment.")
    return Segment(record, keys, index, sketches, gone)


def _rising_keys(path: Path) -> Keys:
    keys = np.frombuffer(mapped(path), "<i8")
    if (keys[1:] <= keys[:-1]).any():
        raise DamagedIndex(f"{path}: the keys are not in ascending order.")
    return keys


def merge_plan(sizes: Sequence[int]) -> list[list[int]]:
    """Return groups of indices of `sizes`; each group becomes a segment. Smallest group first."""
    groups: list[list[int]] = []
    total = 0
    for at in sorted(range(len(sizes)), key=lambda index: sizes[index]):
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
    """Frames for a new segment: `rows` (r,) of `keys` (N,) and `vectors` (N, D).

    Parameters
    ----------
    segment : current segment of the frames; None for new frames
    gone : (g,) removed keys of that segment
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
    """Return the sources of the next version: the remaining frames of segments, and new frames."""
    none, dropped = np.empty(0, np.int64), np.fromiter(drop, np.int64, len(drop))
    changed = np.union1d(dropped, new_keys)
    sources = []
    for segment in segments:
        gone = np.union1d(segment.gone, segment.keys[segment.places.matches(changed)])
        sources.append(
            SegmentSource(segment.keys, segment.vectors, segment.standing_rows(gone), segment, gone)
        )
    new = np.flatnonzero(~np.isin(new_keys, dropped))
    sources.append(SegmentSource(new_keys, stored, new, None, none))
    return [source for source in sources if len(source)]


def spool_blocks(
    folder: Path, blocks: Iterable[Block], dimension: int | None
) -> tuple[Keys, Bytes]:
    """Write blocks to an unnamed file; return their keys (n,) and mapped signatures (n, D).

    Raises
    ------
    ValueError : If blocks are malformed, have several lengths, or have a key twice.
    """
    keys = [np.empty(0, np.int64)]
    with tempfile.TemporaryFile(dir=folder) as file:
        for own, signatures in blocks:
            if dimension is not None and signatures.ndim == 2 and signatures.shape[1] != dimension:
                lengths = sorted({dimension, signatures.shape[1]})
                raise ValueError(f"signatures of {lengths} bytes in one map")
            check_block(own, signatures, signatures.shape[-1])
            dimension = signatures.shape[1]
            file.write(np.ascontiguousarray(signatures).data)
            keys.append(own)
        file.flush()
        all_keys = np.concatenate(keys)
        Places(all_keys)  # raises if a key occurs twice
        if len(all_keys) == 0:
            return all_keys, np.empty((0, dimension or 1), np.uint8)
        data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    return all_keys, np.frombuffer(data, np.uint8).reshape(len(all_keys), -1)


def write_segment(
    folder: Path, sources: Sequence[SegmentSource], *, clean: bool, flat_bytes: float
) -> SegmentFiles:
    """Write the frames of sources as a segment, in the order of their keys.

    If the only source is a segment, its parts are reused, unless more than GONE_SHARE of its frames
    are removed.

    Parameters
    ----------
    clean : whether to write a single segment again if any of its frames is removed
    flat_bytes : sketches are written if the signatures exceed this size, bytes
    """
    only = sources[0]
    may_be_gone = 0 if clean else GONE_SHARE * len(only.keys)
    if len(sources) == 1 and only.segment is not None and len(only.gone) <= may_be_gone:
        return _reuse_segment(folder, only.segment, only.gone, flat_bytes)
    keys = np.concatenate([source.keys[source.rows] for source in sources])
    by_key = np.argsort(keys)
    keys, order = keys[by_key], np.empty(len(keys), np.int64)
    order[by_key] = np.arange(len(keys))
    index, vectors = faiss_index.allocate(len(keys), only.vectors.shape[1])
    step, start = max(BLOCK_BYTES // vectors.shape[1], 1), 0
    for source in sources:
        places = order[start : start + len(source)]
        start += len(source)
        for first in range(0, len(source), step):
            block = slice(first, first + step)
            vectors[places[block]] = source.vectors[source.rows[block]]
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


def _reuse_segment(folder: Path, segment: Segment, gone: Keys, flat_bytes: float) -> SegmentFiles:
    """Return the parts of a reused segment, with updated removed keys.

    The segment gets sketches if it now exceeds `flat_bytes`.
    """
    kinds, recall, more = ["keys", "faiss"], segment.record.recall, list[PartOfIndex]()
    if segment.vectors.nbytes <= flat_bytes:
        recall = _flat_recall(len(segment.keys))
    elif segment.sketches is not None:
        kinds += ["sketches", "means"]
    else:
        more, recall = _put_sketches(folder, segment.vectors)
    if len(gone) == len(segment.gone):
        kinds.append("gone")
    else:
        more.append(put(folder, "gone", lambda take: take(gone.astype("<i8").tobytes())))
    files = [part for part in segment.record.files if part[0].rpartition(".")[2] in kinds]
    return SegmentFiles(files=(*files, *more), recall=recall)
