"""Published states of an index: opened, searched together with newer frames, and published.

A published state is a list of segments. The next one adds a segment of what is new, and merges
some; most parts stay what they are. Every part is durable before the manifest that names it, and
the manifest comes last: a builder killed at any moment leaves the state before, and parts that the
next builder removes.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sceneprint.atomic_files import folder_turn
from sceneprint.errors import DamagedIndex
from sceneprint.geometry.retrieval.ranking import Metric, distances
from sceneprint.index.index_manifest import (
    IndexManifest,
    SegmentFiles,
    manifests,
    newest_number,
    read_manifest,
    write_manifest,
)
from sceneprint.index.part_files import Block, Keys, check_block, is_ours, verify
from sceneprint.index.segment import (
    FLAT_BYTES,
    FLAT_SHARE,
    Places,
    Segment,
    merge_plan,
    open_segment,
    segment_sources,
    spool_blocks,
    write_segment,
)
from sceneprint.types import Bytes

log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class IndexVersion:
    """One published state of an index: immutable, and usable by any number of threads.

    It stays usable after its parts have been removed: they are mapped, and processes share them.

    Parameters
    ----------
    segments : that together hold each frame once
    inodes : of the parts by their names: another file may have taken a name since
    """

    manifest: IndexManifest
    segments: tuple[Segment, ...]
    inodes: Mapping[str, int]

    def __len__(self) -> int:
        return sum(len(one) for one in self.segments)

    @property
    def number(self) -> int:
        """Of its manifest."""
        return self.manifest.number

    @property
    def revision(self) -> int:
        """Of the map, up to which the index holds its frames."""
        return self.manifest.revision

    @property
    def anchor(self) -> str:
        """By which the publisher recognises the state of the database."""
        return self.manifest.anchor

    @property
    def model_id(self) -> str:
        """Of the model that signed them."""
        return self.manifest.model_id

    @cached_property
    def keys(self) -> Keys:
        """Keys of the frames (N,), rising."""
        standing = [one.keys[one.standing_rows(one.gone)] for one in self.segments]
        return np.sort(np.concatenate([np.empty(0, np.int64), *standing]))

    def has(self, keys: Keys) -> NDArray[np.bool_]:
        """Return which frames (n,) it holds."""
        held = np.zeros(len(keys), np.bool_)
        for one in self.segments:
            held |= one.rows_of(keys) >= 0
        return held

    def vectors_of(self, keys: Keys) -> Bytes:
        """Return a copy of the signatures (r, D) of frames; ValueError where one is missing."""
        result = np.empty((len(keys), self.manifest.dimension), np.uint8)
        missing = np.ones(len(keys), np.bool_)
        for one in self.segments:
            rows = one.rows_of(keys)
            at = np.flatnonzero(rows >= 0)
            result[at] = one.vectors[rows[at]]
            missing[at] = False
        if missing.any():
            raise ValueError(f"no frames {keys[missing][:5].tolist()} in this index")
        return result


def newest(
    folder: Path,
    model_id: str,
    dimension: int,
    *,
    known: IndexVersion | None = None,
    sound: Mapping[str, int] | None = None,
) -> IndexVersion | None:
    """Open the newest sound index of a folder; None where there is none.

    Every part is read and verified before it is used. An index with a damaged one is skipped with a
    warning in the log, and an older one is used.

    Parameters
    ----------
    folder : of the map; it need not exist
    model_id, dimension : of the signatures; indexes of others are passed over
    known : an index of this folder that is open: its parts are not verified again, and where it is
        the newest it is returned itself
    sound : inodes, by name, of parts that this process has verified before
    """
    while True:
        listed, found, errors = manifests(folder), None, []
        for _, path in listed:
            try:
                manifest = read_manifest(path)
                if (manifest.model_id, manifest.dimension) == (model_id, dimension):
                    found = open_version(folder, manifest, known, sound)
                    break
            except DamagedIndex as error:
                errors.append(error)
        # what a builder removed after it was listed is not damaged, and something newer is there
        if not errors or manifests(folder) == listed:
            for each in errors:
                log.warning("Damaged index skipped; it will be rebuilt: %s", each)
            return found


def open_version(
    folder: Path, manifest: IndexManifest, known: IndexVersion | None = None,
    sound: Mapping[str, int] | None = None,
) -> IndexVersion:  # fmt: skip
    """Open the parts that a manifest names; DamagedIndex where one is missing or damaged.

    Parameters
    ----------
    known, sound : see `newest`
    """
    verified = {**(known.inodes if known is not None else {}), **(sound or {})}
    inodes = {name: _inode(folder / name) for name, _ in manifest.files}
    if known is not None and known.manifest == manifest and known.inodes == inodes:
        return known
    for name, size in manifest.files:
        if inodes[name] != verified.get(name, -1):
            for _ in verify(folder, name, size):
                pass
    # what is open has its rows by key, and its pages, at hand; but where a damaged part was written
    # again under its name, what is mapped is the damaged one
    open_ones = {} if known is None else {one.record: one for one in known.segments}
    segments = tuple(
        open_ones[record]
        if record in open_ones
        and known is not None
        and all(known.inodes[name] == inodes[name] for name, _ in record.files)
        else open_segment(folder, record, manifest.dimension)
        for record in manifest.segments
    )
    return IndexVersion(manifest, segments, inodes)


def _inode(path: Path) -> int:
    """0 where there is no such file."""
    try:
        return path.stat().st_ino
    except OSError:
        return 0


# Search: the nearest frames of a map by exact distance of signatures, Sec. III-C.
#
# The tail is compared whole, and so is each segment; of one with sketches only the frames whose
# sketches are nearest to that of the query. What they miss is measured when it is published.


@dataclass(frozen=True, eq=False)
class Tail:
    """Frames newer than an index. A frame that is in both counts once, with its signature here.

    Parameters
    ----------
    keys : (n,) int64, none twice
    signatures : (n, D) uint8

    Raises
    ------
    ValueError : other arrays, or a key that is there twice.
    """

    keys: Keys
    signatures: Bytes

    def __post_init__(self) -> None:
        check_block(self.keys, self.signatures, self.signatures.shape[-1])
        _ = self.places

    def __len__(self) -> int:
        return len(self.keys)

    @classmethod
    def empty(cls, dimension: int) -> Tail:
        """Return a tail of no frames, of signatures of that many bytes."""
        return cls(np.empty(0, np.int64), np.empty((0, dimension), np.uint8))

    @cached_property
    def places(self) -> Places:
        """Rows of the frames by their keys."""
        return Places(self.keys)

    def rows_among(self, gone: Keys, among: Keys | None) -> NDArray[np.int64]:
        """Return the rows of frames among some (None: all) that are not gone; both lists rise."""
        free = np.full(len(self), among is None)
        if among is not None:
            free[self.places.found(among)] = True
        free[self.places.found(gone)] = False
        return np.flatnonzero(free)


def signatures_of(keys: Keys, version: IndexVersion | None, tail: Tail) -> Bytes:
    """Return the signatures (r, D) of frames (r,), in their order; the tail's where it has one.

    Raises
    ------
    ValueError : a frame is in neither, or the lengths of signatures differ.
    """
    check_lengths(tail.signatures.shape[1], version, tail)
    in_tail = tail.places.of(keys)
    result = np.empty((len(keys), tail.signatures.shape[1]), np.uint8)
    result[in_tail >= 0] = tail.signatures[in_tail[in_tail >= 0]]
    others = keys[in_tail < 0]
    if len(others) and version is None:
        raise ValueError(f"no frames {others[:5].tolist()} in this index")
    if len(others) and version is not None:
        result[in_tail < 0] = version.vectors_of(others)
    return result


def check_lengths(dimension: int, version: IndexVersion | None, tail: Tail) -> None:
    """Raise ValueError where signatures of the index or the tail have not that many bytes."""
    found = {tail.signatures.shape[1]}
    if version is not None:
        found.add(version.manifest.dimension)
    if found != {dimension}:
        raise ValueError(f"signatures of {sorted(found)} bytes where {dimension} were expected")


@dataclass(frozen=True, eq=False)
class SearchHits:
    """The nearest frames that a search found: keys (r,), and their distances (r,), which rise.

    Parameters
    ----------
    exact : every frame of the map was compared, so that these are the nearest
    compared : frames whose exact distance was computed
    """

    keys: Keys
    distances: NDArray[np.int64]
    exact: bool
    compared: int

    def __len__(self) -> int:
        return len(self.keys)


def search(
    query: Bytes,
    version: IndexVersion | None,
    tail: Tail,
    size: int,
    *,
    metric: Metric,
    dead: frozenset[int] = frozenset(),
    among: Keys | None = None,
    exact: bool = False,
) -> SearchHits:
    """Find the nearest frames of a map. Any number of threads may search one index.

    Parameters
    ----------
    query : (D,) uint8, a signature of the model of the map
    version : the index; None where there is none
    tail : frames newer than that; where a frame is in both, this one counts
    size : of the answer; all frames where there are fewer
    metric : of the model of the map
    dead : keys of frames that were deleted since
    among : keys of the frames that may be found, where not all may; others are no matter
    exact : compare every frame, of those that may be found

    Raises
    ------
    ValueError : no signature of that length, or a negative size.
    """
    if query.ndim != 1 or query.dtype != np.uint8 or size < 0:
        raise ValueError(f"{size} for a query {query.dtype} {query.shape}")
    check_lengths(len(query), version, tail)
    gone = np.sort(np.fromiter(dead, np.int64, len(dead)))
    among = None if among is None else np.sort(among)
    alive = tail.rows_among(gone, among)
    keys, whole, compared = [tail.keys[alive]], True, len(alive)
    found = [distances(query, tail.signatures, metric, alive)]
    if version is not None and len(version):
        gone = np.sort(np.concatenate([gone, tail.keys]))
        for one in version.segments:
            (own, distant), all_of_it, count = one.nearest(
                query, size, gone, among, metric=metric, exact=exact
            )
            keys.append(own)
            found.append(distant)
            whole, compared = whole and all_of_it, compared + count
    every, distant = np.concatenate(keys), np.concatenate(found)
    first = _nearest(every, distant, size)
    return SearchHits(every[first], distant[first], whole, compared)


def _nearest(keys: Keys, found: NDArray[np.int64], size: int) -> NDArray[np.intp]:
    """Return the places of the smallest `size`, rising, ties by key."""
    size = min(size, len(keys))
    if size == 0:
        return np.empty(0, np.intp)
    candidates = np.flatnonzero(found <= np.partition(found, size - 1)[size - 1])
    order = np.lexsort((keys[candidates], found[candidates]))
    chosen: NDArray[np.intp] = candidates[order[:size]]
    return chosen


def publish(
    folder: Path,
    *,
    model_id: str,
    revision: int,
    blocks: Iterable[Block],
    previous: IndexVersion | None,
    drop: frozenset[int] = frozenset(),
    anchor: Callable[[], str] = str,
    clean: bool = False,
    flat_bytes: int = FLAT_BYTES,
    after: int = 0,
    share: Callable[[IndexManifest], bool] = lambda _: True,
) -> IndexVersion | None:
    """Publish the index that follows `previous`.

    One process builds in a folder at a time. The two newest indexes are kept, and parts that only
    older ones need removed; readers that hold them go on undisturbed. What is new is written, and
    the segments that it is merged with; all others stay. Memory holds the signatures of what is
    written, one segment at a time.

    Parameters
    ----------
    folder : of the map; made if need be
    model_id : of the model that signed the frames
    revision : of the map, up to which `blocks` and `previous` hold its frames
    blocks : keys (n,) int64 and signatures (n, D) uint8 of the frames that are not in `previous`;
        a key that is there replaces the signature there. It is read once, and block by block.
    previous : the newest index of the folder, or None to build from nothing
    drop : keys of frames that are no longer in the map
    anchor : called once `blocks` are read: marks that state of the database or a later one
    clean : leave no part that has a byte of a frame that is no longer there: the index before is
        not kept
    flat_bytes : of signatures, above which there are sketches
    after : its number is larger than that
    share : called with the manifest once all parts are there and before it is: False where another
        index was published by that number elsewhere, so that this one is not published

    Returns
    -------
    the index, open; None where somebody else is building or has published, or `previous` is no
    longer the newest of the folder: then open the newest and try again

    Raises
    ------
    ValueError : blocks that are none, that have a key twice, or signatures of another model or
        length than `previous`; no frames and no `previous`.
    OSError : a file cannot be written; the index before remains.
    """
    if previous is not None and previous.model_id != model_id:
        raise ValueError(f"frames of model {model_id} appended to those of {previous.model_id}")
    with folder_turn(folder) as mine:
        if not mine or (previous is not None and _is_overtaken(folder, previous)):
            return None
        last = newest_number(folder) or 0
        records, dimension = _write_segments(folder, previous, blocks, drop, clean, flat_bytes)
        manifest = IndexManifest(
            number=max(after, last) + 1,
            revision=revision,
            model_id=model_id,
            dimension=dimension,
            anchor=anchor(),
            segments=records,
        )
        if not share(manifest):
            remove_unneeded(folder)
            return None
        write_manifest(folder, manifest)
        # the one before is known to be sound, whatever lies between
        before = last if previous is None else previous.number
        keep_only(folder, {manifest.number} if clean else {manifest.number, before})
        known = {} if previous is None else previous.inodes
        written = {name: _inode(folder / name) for name, _ in manifest.files if name not in known}
        return open_version(folder, manifest, previous, written)


def _write_segments(
    folder: Path, previous: IndexVersion | None, blocks: Iterable[Block], drop: frozenset[int],
    clean: bool, flat_bytes: int,
) -> tuple[tuple[SegmentFiles, ...], int]:  # fmt: skip
    """Write what is new and what it is merged with; all segments, and bytes of a signature."""
    dimension = None if previous is None else previous.manifest.dimension
    new_keys, stored = spool_blocks(folder, blocks, dimension)
    if previous is None and len(new_keys) == 0:
        raise ValueError("an index of no frames that follows none")
    sources = segment_sources(() if previous is None else previous.segments, new_keys, stored, drop)
    is_large = sum(len(each) * each.vectors.shape[1] for each in sources) > flat_bytes
    most = FLAT_SHARE * flat_bytes if is_large else np.inf
    groups = merge_plan([len(each) for each in sources])
    records = tuple(
        write_segment(folder, [sources[at] for at in group], clean=clean, flat_bytes=most)
        for group in reversed(groups)
    )
    return records, dimension or stored.shape[1]


def _is_overtaken(folder: Path, previous: IndexVersion) -> bool:
    """Return whether another was published, or the folder emptied, since `previous` was opened."""
    found = newest(folder, previous.model_id, previous.manifest.dimension, known=previous)
    return found is None or found.number != previous.number


def clear(folder: Path, but: int | None = None) -> bool:
    """Remove all manifests of a folder, or all but one, and the parts that only they need.

    Readers that hold them go on undisturbed. Returns False where somebody is building there.
    """
    with folder_turn(folder) as mine:
        if mine:
            keep_only(folder, () if but is None else (but,))
        return mine


def remove_unneeded(folder: Path) -> None:
    """Remove the parts that no manifest of a folder needs; for whoever has its turn."""
    keep_only(folder, [number for number, _ in manifests(folder)])


def keep_only(folder: Path, numbers: Collection[int]) -> None:
    """Remove all manifests but some, and the parts these do not need; for whoever has the turn."""
    needed: set[str] = set()
    for number, path in manifests(folder):
        if number not in numbers:  # before its parts: a manifest should not promise what is gone
            path.unlink(missing_ok=True)
            continue
        with suppress(DamagedIndex):  # nothing will be read by it
            needed |= {name for name, _ in read_manifest(path).files}
    for path in folder.iterdir():
        if is_ours(path.name) and path.name not in needed:
            path.unlink(missing_ok=True)
