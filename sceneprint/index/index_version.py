"""Versions of an index: their publication, opening, and search together with newer frames.

A version is a list of segments. The next version adds a segment of new frames and merges some of
the others; most parts remain. All parts are durable before their manifest is written. A killed
builder leaves the former version intact; the next builder removes its parts.
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

#: Inode and modification time, which change when a file is written again; None for a missing file.
FileState = tuple[int, int] | None
#: States of the parts that this process has verified or written, by index folder and name.
_sound: dict[Path, Mapping[str, FileState]] = {}


@dataclass(frozen=True, eq=False)
class IndexVersion:
    """A published, immutable version of an index. Threads may share an instance.

    It remains usable after its parts are removed, because they are mapped into memory.

    Parameters
    ----------
    segments : segments that together contain each frame once
    files : states of the parts by name: a part may be written again with the same name
    """

    manifest: IndexManifest
    segments: tuple[Segment, ...]
    files: Mapping[str, FileState]

    def __len__(self) -> int:
        return sum(len(segment) for segment in self.segments)

    @property
    def number(self) -> int:
        """Return the number of the version."""
        return self.manifest.number

    @property
    def revision(self) -> int:
        """Return the revision of the map up to which the index contains its frames."""
        return self.manifest.revision

    @property
    def anchor(self) -> str:
        """Return the text by which the publisher recognises the state of the database."""
        return self.manifest.anchor

    @property
    def model_id(self) -> str:
        """Return the id of the model that signed the frames."""
        return self.manifest.model_id

    @cached_property
    def keys(self) -> Keys:
        """Return the keys (N,) of the frames in ascending order."""
        standing = [part.keys[part.standing_rows(part.gone)] for part in self.segments]
        return np.sort(np.concatenate([np.empty(0, np.int64), *standing]))

    def has(self, keys: Keys) -> NDArray[np.bool_]:
        """Return a mask (n,) of the frames that the index contains."""
        contained = np.zeros(len(keys), np.bool_)
        for segment in self.segments:
            contained |= segment.rows_of(keys) >= 0
        return contained

    def vectors_of(self, keys: Keys) -> Bytes:
        """Return a copy of the signatures (r, D) of frames; raise ValueError if one is missing."""
        result = np.empty((len(keys), self.manifest.dimension), np.uint8)
        missing = np.ones(len(keys), np.bool_)
        for segment in self.segments:
            rows = segment.rows_of(keys)
            at = np.flatnonzero(rows >= 0)
            result[at] = segment.vectors[rows[at]]
            missing[at] = False
        if missing.any():
            raise ValueError(f"no frames {keys[missing][:5].tolist()} in this index")
        return result


def newest(
    folder: Path,
    model_id: str,
    dimension: int,
    *,
    previous: IndexVersion | None = None,
) -> IndexVersion | None:
    """Open the newest sound version in a folder; return None if there is none.

    All parts are verified before use, once in each process. A version with a damaged part is logged
    and skipped.

    Parameters
    ----------
    folder : folder of the map's index; it may be missing
    model_id, dimension : model and length of the signatures; versions of other models are skipped
    previous : open version of this folder; if it is the newest, it is returned
    """
    while True:
        listed, version, errors = manifests(folder), None, []
        for _, path in listed:
            try:
                manifest = read_manifest(path)
                if (manifest.model_id, manifest.dimension) == (model_id, dimension):
                    version = open_version(folder, manifest, previous)
                    break
            except DamagedIndex as error:
                errors.append(error)
        # a part is also missing if a builder has just removed it, after writing a newer version
        if not errors or manifests(folder) == listed:
            for damage in errors:
                log.warning("Damaged index skipped; it will be rebuilt: %s", damage)
            return version


def open_version(
    folder: Path, manifest: IndexManifest, previous: IndexVersion | None = None
) -> IndexVersion:
    """Open the parts in a manifest; raise DamagedIndex if one is missing or damaged."""
    files = {name: _state_of(folder / name) for name, _ in manifest.files}
    if previous is not None and previous.manifest == manifest and previous.files == files:
        return previous
    sound = _sound.get(folder, {})
    for name, size in manifest.files:
        if files[name] is None or sound.get(name) != files[name]:
            for _ in verify(folder, name, size):
                pass
    _sound[folder] = files
    # reuse open segments with their caches, unless a damaged part was written again
    reusable = {} if previous is None else {
        segment.record: segment for segment in previous.segments
        if all(previous.files[name] == files.get(name) for name, _ in segment.record.files)
    }  # fmt: skip
    segments = tuple(
        reusable[record] if record in reusable
        else open_segment(folder, record, manifest.dimension)
        for record in manifest.segments
    )  # fmt: skip
    return IndexVersion(manifest, segments, files)


def _state_of(path: Path) -> FileState:
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_ino, status.st_mtime_ns


# A search returns the nearest frames of a map by exact distance of signatures: Sec. III-C. It
# compares all frames of the tail and of segments without sketches. In segments with sketches, it
# compares the frames with the nearest sketches; publication measures the recall.


@dataclass(frozen=True, eq=False)
class Tail:
    """Frames that are newer than an index. They replace frames of the index with the same keys.

    Parameters
    ----------
    keys : (n,) int64, distinct
    signatures : (n, D) uint8

    Raises
    ------
    ValueError : If the arrays have other shapes or types, or a key occurs twice.
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
        """Return a tail without frames, for signatures of `dimension` bytes."""
        return cls(np.empty(0, np.int64), np.empty((0, dimension), np.uint8))

    @cached_property
    def places(self) -> Places:
        """Return the rows of the frames by key."""
        return Places(self.keys)

    def rows_among(self, gone: Keys, among: Keys | None) -> NDArray[np.int64]:
        """Return the rows of frames in `among` (None: all) but not in `gone`; keys ascend."""
        free = np.full(len(self), among is None)
        if among is not None:
            free[self.places.matches(among)] = True
        free[self.places.matches(gone)] = False
        return np.flatnonzero(free)


def signatures_of(keys: Keys, version: IndexVersion | None, tail: Tail) -> Bytes:
    """Return the signatures (r, D) of frames (r,), from the tail or from the index.

    Raises
    ------
    ValueError : If a frame is missing, or the lengths of signatures differ.
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
    """Raise ValueError unless signatures of the index and the tail have `dimension` bytes."""
    lengths = {tail.signatures.shape[1]}
    if version is not None:
        lengths.add(version.manifest.dimension)
    if lengths != {dimension}:
        raise ValueError(f"signatures of {sorted(lengths)} bytes where {dimension} were expected")


@dataclass(frozen=True, eq=False)
class SearchHits:
    """The results of a search: keys (r,) and distances (r,) of the nearest frames, nearest first.

    Parameters
    ----------
    exact : whether all searchable frames were compared
    compared : number of frames whose distance was computed
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
    """Return the nearest frames of a map. Any number of threads may search an index.

    Parameters
    ----------
    query : (D,) uint8, signature of the map's model
    version : version of the index; None without an index
    tail : newer frames
    size : maximum number of results
    metric : metric of the map's model
    dead : keys of deleted frames
    among : keys of the searchable frames; None selects all
    exact : whether to compare all searchable frames

    Raises
    ------
    ValueError : If the query has another length or type, or the size is negative.
    """
    if query.ndim != 1 or query.dtype != np.uint8 or size < 0:
        raise ValueError(f"{size} for a query {query.dtype} {query.shape}")
    check_lengths(len(query), version, tail)
    gone = np.sort(np.fromiter(dead, np.int64, len(dead)))
    among = None if among is None else np.sort(among)
    alive = tail.rows_among(gone, among)
    keys, whole, compared = [tail.keys[alive]], True, len(alive)
    parts = [distances(query, tail.signatures, metric, alive)]
    if version is not None and len(version):
        gone = np.sort(np.concatenate([gone, tail.keys]))
        for segment in version.segments:
            (own, distant), all_of_it, count = segment.nearest(
                query, size, gone, among, metric=metric, exact=exact
            )
            keys.append(own)
            parts.append(distant)
            whole, compared = whole and all_of_it, compared + count
    every, distant = np.concatenate(keys), np.concatenate(parts)
    first = _nearest(every, distant, size)
    return SearchHits(every[first], distant[first], whole, compared)


def _nearest(keys: Keys, values: NDArray[np.int64], size: int) -> NDArray[np.intp]:
    """Return the positions of the `size` smallest distances, in ascending order; ties by key."""
    size = min(size, len(keys))
    if size == 0:
        return np.empty(0, np.intp)
    candidates = np.flatnonzero(values <= np.partition(values, size - 1)[size - 1])
    order = np.lexsort((keys[candidates], values[candidates]))
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
    """Publish the version that follows `previous`.

    Only one process builds in a folder at a time. All versions except `previous` and the new one
    are removed; readers that have mapped them can still use them. Only segments with new frames,
    merged with some earlier segments, are written. Memory holds the signatures of one segment at a
    time.

    Parameters
    ----------
    folder : folder of the map's index; created if missing
    model_id : id of the model that signed the frames
    revision : revision of the map up to which `blocks` and `previous` contain its frames
    blocks : keys (n,) int64 and signatures (n, D) uint8 of new and replaced frames, in blocks;
        iterated once
    previous : newest version in the folder; None builds an index without reuse
    drop : keys of deleted frames
    anchor : function that returns the anchor; called after `blocks` are read
    clean : whether to remove all bytes of deleted frames, and therefore the previous version
    flat_bytes : sketches are written if the signatures exceed this size, bytes
    after : number that the new version's number must exceed
    share : function that is called with the manifest before it is written; it returns False to
        cancel the publication, if another host published a version with this number

    Returns
    -------
    version : open version; None if another process is building, if `share` returns False, or if
        `previous` is no longer the newest version: open the newest version, and try again

    Raises
    ------
    ValueError : If blocks are malformed or have a key twice, if signatures have another model or
        length than `previous`, or if there are no frames and no `previous`.
    OSError : If a file cannot be written; the previous version remains.
    """
    if previous is not None and previous.model_id != model_id:
        raise ValueError(
            f"an index of model {previous.model_id} cannot contain frames of {model_id}"
        )
    with folder_turn(folder) as mine:
        if not mine:
            return None
        if previous is not None:
            now = newest(folder, model_id, previous.manifest.dimension, previous=previous)
            if now is None or now.number != previous.number:
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
        # the previous version is sound; versions after it may be damaged
        before = last if previous is None else previous.number
        keep_only(folder, {manifest.number} if clean else {manifest.number, before})
        known = {} if previous is None else previous.files
        _sound[folder] = {
            name: known.get(name) or _state_of(folder / name) for name, _ in manifest.files
        }
        return open_version(folder, manifest, previous)


def _write_segments(
    folder: Path, previous: IndexVersion | None, blocks: Iterable[Block], drop: frozenset[int],
    clean: bool, flat_bytes: int,
) -> tuple[tuple[SegmentFiles, ...], int]:  # fmt: skip
    """Write new and merged segments; return all segments, and the length of signatures in bytes."""
    dimension = None if previous is None else previous.manifest.dimension
    new_keys, stored = spool_blocks(folder, blocks, dimension)
    if previous is None and len(new_keys) == 0:
        raise ValueError("there are no frames and no previous version")
    sources = segment_sources(() if previous is None else previous.segments, new_keys, stored, drop)
    is_large = sum(len(each) * each.vectors.shape[1] for each in sources) > flat_bytes
    most = FLAT_SHARE * flat_bytes if is_large else np.inf
    groups = merge_plan([len(each) for each in sources])
    records = tuple(
        write_segment(folder, [sources[at] for at in group], clean=clean, flat_bytes=most)
        for group in reversed(groups)
    )
    return records, dimension or stored.shape[1]


def clear(folder: Path, keep: int | None = None) -> bool:
    """Remove all versions of an index except number `keep`; return False during a build.

    Readers may still use the removed versions.
    """
    with folder_turn(folder) as mine:
        if mine:
            keep_only(folder, () if keep is None else (keep,))
        return mine


def remove_unneeded(folder: Path) -> None:
    """Remove the parts that no manifest in a folder lists; the caller holds its lock."""
    keep_only(folder, [number for number, _ in manifests(folder)])


def keep_only(folder: Path, numbers: Collection[int]) -> None:
    """Remove all versions except `numbers`, and unneeded parts; the caller holds the lock."""
    needed: set[str] = set()
    for number, path in manifests(folder):
        if number not in numbers:  # remove a manifest before its parts
            path.unlink(missing_ok=True)
            continue
        with suppress(DamagedIndex):  # a damaged manifest needs no parts
            needed |= {name for name, _ in read_manifest(path).files}
    for path in folder.iterdir():
        if is_ours(path.name) and path.name not in needed:
            path.unlink(missing_ok=True)
