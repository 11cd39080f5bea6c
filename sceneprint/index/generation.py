"""Generations: one published state of the cache, opened, searched with newer frames, and published.

What is published is what stays of the generation before and what is new, in the order of the keys.
Every file is durable before the manifest that names it, and the manifest comes last: a builder
killed at any moment leaves the generation before, and files that the next builder removes.
"""

from __future__ import annotations

import logging
import mmap
import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sceneprint.atomic_files import create_private
from sceneprint.errors import DamagedIndex
from sceneprint.geometry.retrieval.ranking import Metric, distances
from sceneprint.index import faiss_index, generation_files
from sceneprint.index.faiss_index import Lists, codes_of, map_index, map_lists, nearest
from sceneprint.index.generation_files import (
    BLOCK_BYTES,
    Block,
    GenerationManifest,
    Keys,
    Recall,
    building,
    check_block,
    is_ours,
    manifests,
    put,
    read_manifest,
    unfinished,
    write_manifest,
)
from sceneprint.types import Bytes

if TYPE_CHECKING:
    from faiss import IndexScalarQuantizer


log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Generation:
    """One published state of the cache: immutable, and usable by any number of threads.

    It stays usable after its files have been removed: they are mapped, and processes share them.

    Parameters
    ----------
    manifest : see Manifest
    keys : (N,) int64 of the frames, rising
    index : of FAISS, over their signatures in the same order
    lists : the inverted file of a very large map; None where all of it is compared
    inodes : of the files by their names: another may have taken a name since
    """

    manifest: generation_files.GenerationManifest
    keys: generation_files.Keys
    index: IndexScalarQuantizer
    lists: Lists | None
    inodes: Mapping[str, int]

    def __len__(self) -> int:
        return len(self.keys)

    @property
    def number(self) -> int:
        """Of the generation in its folder."""
        return self.manifest.number

    @property
    def revision(self) -> int:
        """Of the map, up to which the generation holds its frames."""
        return self.manifest.revision

    @property
    def anchor(self) -> str:
        """By which whoever published it knows the state of the database."""
        return self.manifest.anchor

    @property
    def model_id(self) -> str:
        """Of the model that signed them."""
        return self.manifest.model_id

    @cached_property
    def vectors(self) -> Bytes:
        """Signatures (N, D) uint8 where they are mapped, read-only, in the order of the keys."""
        return codes_of(self.index)

    @cached_property
    def places(self) -> Places:
        """Rows of the frames by their keys."""
        return Places(self.keys)

    def vectors_of(self, keys: generation_files.Keys) -> Bytes:
        """Signatures (r, D) of some frames, a copy.

        Raises
        ------
        ValueError : there is no such frame in it.
        """
        at = self.places.of(keys)
        if (at < 0).any():
            raise ValueError(f"no frames {keys[at < 0][:5].tolist()} in this index")
        return self.vectors[at]


def newest(
    folder: Path, model_id: str, dimension: int, *, known: Generation | None = None
) -> Generation | None:
    """Open the newest sound generation of a folder.

    Every file is read and verified before it is used. A damaged one is skipped with a warning in
    the log, and an older one is used.

    Parameters
    ----------
    folder : of the map; it need not exist
    model_id, dimension : of the signatures; generations of others are passed over
    known : a generation of this folder that is open: files that it has are not verified again,
        and where it is the newest it is returned itself

    Returns
    -------
    the generation; None where there is none, so that the map must be published from the database
    """
    while True:
        listed, found, errors = generation_files.manifests(folder), None, []
        for _, path in listed:
            try:
                manifest = generation_files.read_manifest(path)
                if (manifest.model_id, manifest.dimension) == (model_id, dimension):
                    found = open_generation(folder, manifest, known)
                    break
            except DamagedIndex as error:
                errors.append(error)
        # what a builder removed after it was listed is not damaged, and something newer is there
        if not errors or generation_files.manifests(folder) == listed:
            for each in errors:
                log.warning("Damaged index skipped; it will be rebuilt: %s", each)
            return found


def open_generation(
    folder: Path, manifest: generation_files.GenerationManifest, known: Generation | None = None,
    written: Mapping[str, int] | None = None,
) -> Generation:  # fmt: skip
    """Open the files of a generation.

    Parameters
    ----------
    folder, manifest : of the generation
    known : see `newest`
    written : inodes, by name, of files that were verified as they were written

    Raises
    ------
    DamagedIndex : one of them is missing or damaged.
    """
    sound = {} if known is None else dict(known.inodes)
    inodes = {name: _inode(folder / name) for name, _ in manifest.files}
    if known is not None and known.manifest == manifest and known.inodes == inodes:
        return known
    sound.update(written or {})
    for name, size in manifest.files:
        if inodes[name] != sound.get(name, -1):
            for _ in generation_files.check(folder, name, size):
                pass
    names = {name.rpartition(".")[2]: folder / name for name, _ in manifest.files}
    keys = np.frombuffer(generation_files.mapped(names["keys"]), "<i8")
    if (keys[1:] <= keys[:-1]).any():
        raise DamagedIndex(f"{names['keys']}: its keys are not in order.")
    n, lists = len(keys), None
    index = map_index(names["faiss"], n, manifest.dimension)
    if "lists" in names:
        lists = map_lists(names["lists"], n, manifest.dimension, manifest.recall.probes)
    return Generation(manifest, keys, index, lists, inodes)


def _inode(path: Path) -> int:
    """0 where there is no such file."""
    try:
        return path.stat().st_ino
    except OSError:
        return 0


# Search: the nearest frames of a map by exact distance of signatures, Sec. III-C.
#
# The tail is compared whole, and so is a generation; of one with an inverted file only the lists
# that are nearest to the query. What they miss is missed, and measured when it is published.

# Tails: frames newer than a generation, held in memory and always compared exactly.


@dataclass(frozen=True, eq=False)
class Tail:
    """Frames newer than a generation.

    A frame that is in both counts once, with the signature it has here.

    Parameters
    ----------
    keys : (n,) int64, none twice
    signatures : (n, D) uint8

    Raises
    ------
    ValueError : other arrays, or a key that is there twice.
    """

    keys: generation_files.Keys
    signatures: Bytes

    def __post_init__(self) -> None:
        generation_files.check_block(self.keys, self.signatures, self.signatures.shape[-1])
        _ = self.places

    def __len__(self) -> int:
        return len(self.keys)

    @classmethod
    def empty(cls, dimension: int) -> Tail:
        """No frames, of signatures of that many bytes."""
        return cls(np.empty(0, np.int64), np.empty((0, dimension), np.uint8))

    @cached_property
    def places(self) -> Places:
        """Rows of the frames by their keys."""
        return Places(self.keys)


def signatures_of(keys: generation_files.Keys, generation: Generation | None, tail: Tail) -> Bytes:
    """Signatures of some frames: of the hits of a search, to compare them among each other.

    Parameters
    ----------
    keys : (r,) int64
    generation : or None where there is none
    tail : frames newer than that

    Returns
    -------
    (r, D) uint8, in the order of `keys`; the tail's where a frame is in both

    Raises
    ------
    ValueError : a frame is in neither, or the lengths of signatures differ.
    """
    check_lengths(tail.signatures.shape[1], generation, tail)
    in_tail = tail.places.of(keys)
    result = np.empty((len(keys), tail.signatures.shape[1]), np.uint8)
    result[in_tail >= 0] = tail.signatures[in_tail[in_tail >= 0]]
    others = keys[in_tail < 0]
    if len(others) and generation is None:
        raise ValueError(f"no frames {others[:5].tolist()} in this index")
    if len(others) and generation is not None:
        result[in_tail < 0] = generation.vectors_of(others)
    return result


def check_lengths(dimension: int, generation: Generation | None, tail: Tail) -> None:
    """See that signatures of generation and tail have that many bytes.

    Raises
    ------
    ValueError : they have not.
    """
    found = {tail.signatures.shape[1]}
    if generation is not None:
        found.add(generation.manifest.dimension)
    if found != {dimension}:
        raise ValueError(f"signatures of {sorted(found)} bytes where {dimension} were expected")


#: Where fewer than one in this many frames may be found, they are compared one by one: FAISS reads
#: all of them.
FEW = 8
#: Longest answer that FAISS gives: of a longer one, ordering costs more than comparing.
LONGEST = 2048

Found = tuple[NDArray[np.int64], NDArray[np.int64]]


@dataclass(frozen=True, eq=False)
class SearchHits:
    """The nearest frames that a search found.

    Parameters
    ----------
    keys : (r,) int64 of the frames
    distances : (r,) int64, exact, rising; equal ones by key
    exact : every frame of the map was compared, so that these are the nearest
    compared : frames whose exact distance was computed
    """

    keys: generation_files.Keys
    distances: NDArray[np.int64]
    exact: bool
    compared: int

    def __len__(self) -> int:
        return len(self.keys)


def search(
    query: Bytes,
    generation: Generation | None,
    tail: Tail,
    size: int,
    *,
    metric: Metric,
    dead: frozenset[int] = frozenset(),
    among: generation_files.Keys | None = None,
    exact: bool = False,
) -> SearchHits:
    """Find the nearest frames of a map. Any number of threads may search one generation.

    Parameters
    ----------
    query : (D,) uint8, a signature of the model of the map
    generation : or None where there is none
    tail : frames newer than that; where a frame is in both, this one counts
    size : of the answer; all frames where there are fewer
    metric : of the model of the map; a generation is of "l2"
    dead : keys of frames that were deleted since
    among : keys of the frames that may be found, where not all may; others are no matter
    exact : compare every frame, of those that may be found

    Raises
    ------
    ValueError : no signature of that length, a negative size, or a generation under "l1".
    """
    if query.ndim != 1 or query.dtype != np.uint8 or size < 0:
        raise ValueError(f"{size} for a query {query.dtype} {query.shape}")
    check_lengths(len(query), generation, tail)
    gone = np.fromiter(dead, np.int64, len(dead))
    alive = np.flatnonzero(_free(tail, gone, among))
    keys, found, whole = tail.keys[alive], distances(query, tail.signatures, metric, alive), True
    compared = len(alive)
    if generation is not None and len(generation):
        if metric != "l2":
            raise ValueError(f"an index of metric 'l2' searched by {metric!r}")
        free = _free(generation, np.concatenate([gone, tail.keys]), among)
        count = int(free.sum())
        own, whole = _candidates(query, generation, free, count, size, exact)
        compared += count if own is None else len(own)
        rows, distant = _compared(query, generation, free, count, size, own)
        keys = np.concatenate([keys, generation.keys[rows]])
        found = np.concatenate([found, distant])
    first = _nearest(keys, found, size)
    return SearchHits(keys[first], found[first], whole, compared)


def _free(
    part: Generation | Tail, gone: generation_files.Keys, among: generation_files.Keys | None
) -> NDArray[np.bool_]:
    """Which frames of a part may be found: those among the given ones that are not gone."""
    free = np.full(len(part), among is None)
    if among is not None:
        free[_known(part.places, among)] = True
    if len(gone):
        free[_known(part.places, gone)] = False
    return free


def _known(places: Places, keys: generation_files.Keys) -> NDArray[np.int64]:
    at = places.of(keys)
    return at[at >= 0]


def _candidates(
    query: Bytes, generation: Generation, free: NDArray[np.bool_], count: int, size: int,
    exact: bool,
) -> tuple[NDArray[np.int64] | None, bool]:  # fmt: skip
    """Rows that are compared one by one, None for all that are free; and whether these are all."""
    if count < len(generation) // FEW:
        return np.flatnonzero(free), True
    if generation.lists is None or exact:
        return None, True
    all_free = count == len(generation)
    rows = generation.lists.candidates(query, min(size, count), None if all_free else free)
    return rows, len(rows) == count


def _compared(
    query: Bytes, generation: Generation, free: NDArray[np.bool_], count: int, size: int,
    rows: NDArray[np.int64] | None,
) -> Found:  # fmt: skip
    """Rows among which the nearest are, and their distances."""
    if rows is None and size <= LONGEST:
        all_free = count == len(generation)
        found = nearest(generation.index, query, min(size, count), None if all_free else free)
        if found is not None:
            return found
    if rows is None:
        rows = np.flatnonzero(free)
    return rows, distances(query, generation.vectors, "l2", rows)


def _nearest(keys: generation_files.Keys, found: NDArray[np.int64], size: int) -> NDArray[np.intp]:
    """Places of the smallest `size`, rising, ties by key."""
    size = min(size, len(keys))
    if size == 0:
        return np.empty(0, np.intp)
    candidates = np.flatnonzero(found <= np.partition(found, size - 1)[size - 1])
    order = np.lexsort((keys[candidates], found[candidates]))
    chosen: NDArray[np.intp] = candidates[order[:size]]
    return chosen


# Publication.

#: Bytes of signatures up to which a map has no inverted file: comparing all takes a fifth of a
#: second.
FLAT_BYTES = 1 << 30


@dataclass(frozen=True, eq=False)
class Draft:
    """Signatures of a generation to be, in memory: `keys` (N,), rising, and `vectors` (N, D).

    `before` (N,) are their rows in the generation before; -1 where they are new.
    """

    keys: Keys
    before: NDArray[np.int64]
    index: IndexScalarQuantizer
    vectors: Bytes


def publish(
    folder: Path,
    *,
    model_id: str,
    revision: int,
    blocks: Iterable[Block],
    previous: Generation | None,
    drop: frozenset[int] = frozenset(),
    anchor: Callable[[], str] = str,
    clean: bool = False,
    flat_bytes: int = FLAT_BYTES,
    after: int = 0,
    share: Callable[[GenerationManifest], bool] = lambda _: True,
) -> Generation | None:
    """Publish the generation that follows `previous`.

    One process builds in a folder at a time. The two newest generations are kept, and files of
    older ones removed; readers that hold them go on undisturbed. Memory holds the signatures once,
    and the disk once more than what is published.

    Parameters
    ----------
    folder : of the map; made if need be
    model_id : of the model that signed the frames, whose metric is "l2"
    revision : of the map, up to which `blocks` and `previous` hold its frames
    blocks : keys (n,) int64 and signatures (n, D) uint8 of the frames that are not in `previous`;
        a key that is there replaces the signature there. It is read once, and block by block.
    previous : the newest generation of the folder, or None to build from nothing
    drop : keys of frames that are no longer in the map
    anchor : called once `blocks` are read: marks that state of the database or a later one. It is
        kept as it is, for whoever opens the generation to check
    clean : leave no file that has a byte of a frame that is no longer there: the generation
        before is not kept
    flat_bytes : of signatures, above which there is an inverted file
    after : its number is larger than that
    share : called with the manifest once all files are there and before it is: False where another
        generation was published by that number elsewhere, so that this one is not published

    Returns
    -------
    the generation, open; None where somebody else is building or has published, or `previous` is
    no longer the newest of the folder: then open the newest and try again

    Raises
    ------
    ValueError : blocks that are none, that have a key twice, or signatures of another model or
        length than `previous`; no frames and no `previous`.
    OSError : a file cannot be written; the generation before remains.
    """
    if previous is not None and previous.model_id != model_id:
        raise ValueError(f"frames of model {model_id} appended to those of {previous.model_id}")
    with building(folder) as mine:
        if not mine or _overtaken(folder, previous):
            return None
        listed = manifests(folder)
        draft = _draft(folder, previous, blocks, drop)
        lists, recall = _lists(draft, previous, clean, flat_bytes)
        files = [
            put(folder, "keys", lambda take: take(draft.keys.astype("<i8").tobytes())),
            put(folder, "faiss", lambda take: faiss_index.write_index(draft.index, take)),
        ]
        if lists is not None:
            files.append(put(folder, "lists", lambda take: faiss_index.write_lists(lists, take)))
        manifest = GenerationManifest(
            number=max(after, listed[0][0] if listed else 0) + 1,
            revision=revision,
            model_id=model_id,
            dimension=draft.vectors.shape[1],
            anchor=anchor(),
            files=tuple(files),
            recall=recall,
        )
        if not share(manifest):
            remove_unneeded(folder)
            return None
        own = write_manifest(folder, manifest)
        if previous is not None:  # known to be sound, whatever lies between
            listed = [each for each in listed if each[0] == previous.number]
        _clean(folder, {own, *(path for _, path in listed[: 0 if clean else 1])})
        written = {name: (folder / name).stat().st_ino for name, _ in files}
        return open_generation(folder, manifest, written=written)


def clear(folder: Path, but: int | None = None) -> bool:
    """Remove all generations of a folder, or all but one; False where somebody is building there.

    Readers that hold them go on undisturbed.
    """
    with building(folder) as mine:
        if mine:
            _clean(folder, {path for number, path in manifests(folder) if number == but})
        return mine


def remove_all_but(folder: Path, manifest: GenerationManifest) -> None:
    """Publish a generation whose files are in a folder, and remove all others; while building.

    Raises
    ------
    OSError : it cannot be written.
    """
    _clean(folder, {write_manifest(folder, manifest)})


def remove_unneeded(folder: Path) -> None:
    """Remove files that no generation of a folder needs; while building."""
    _clean(folder, {path for _, path in manifests(folder)})


def _overtaken(folder: Path, previous: Generation | None) -> bool:
    """Whether a generation was published, or the folder emptied, since `previous` was opened."""
    if previous is None:
        return False
    found = newest(folder, previous.model_id, previous.manifest.dimension, known=previous)
    return found is None or found.number != previous.number


def _draft(
    folder: Path, previous: Generation | None, blocks: Iterable[Block], drop: frozenset[int]
) -> Draft:
    """Merge what stays of the generation before with what is new."""
    none = np.empty(0, np.int64)
    dimension = None if previous is None else previous.manifest.dimension
    new_keys, stored = _spooled(folder, blocks, dimension)
    if previous is None and len(new_keys) == 0:
        raise ValueError("a generation of no frames that follows none")
    Places(new_keys)  # raises where a key is there twice
    old_keys = none if previous is None else previous.keys
    gone = np.fromiter(drop, np.int64, len(drop))
    kept = np.flatnonzero(~np.isin(old_keys, np.concatenate([gone, new_keys])))
    new = np.flatnonzero(~np.isin(new_keys, gone))
    keys = np.concatenate([old_keys[kept], new_keys[new]])
    order = np.argsort(keys)
    before = np.concatenate([kept, np.full(len(new), -1)])[order]
    spooled = np.concatenate([np.full(len(kept), -1), new])[order]
    index, vectors = faiss_index.allocate(len(keys), stored.shape[1])
    step = max(BLOCK_BYTES // stored.shape[1], 1)
    for start in range(0, len(keys), step):
        rows = slice(start, start + step)
        is_new = before[rows] < 0
        vectors[rows][is_new] = stored[spooled[rows][is_new]]
        if previous is not None:
            vectors[rows][~is_new] = previous.vectors[before[rows][~is_new]]
    return Draft(keys[order], before, index, vectors)


def _spooled(folder: Path, blocks: Iterable[Block], dimension: int | None) -> tuple[Keys, Bytes]:
    """Keys (n,) and signatures (n, D) as they come: in a file without a name, not in memory."""
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
        if len(found) == 0:
            return found, np.empty((0, dimension or 1), np.uint8)
        data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    return found, np.frombuffer(data, np.uint8).reshape(len(found), -1)


def _lists(
    draft: Draft, previous: Generation | None, clean: bool, flat_bytes: int
) -> tuple[faiss_index.Lists | None, Recall]:
    """The inverted file, where the signatures are so many, and what a search finds by it."""
    n = len(draft.keys)
    if draft.vectors.nbytes <= flat_bytes:
        return None, Recall(1.0, faiss_index.NEAR, 0, 0, n)
    known = None if previous is None else previous.lists
    if previous is None or known is None or n >= faiss_index.GROWTH * known.trained_on:
        return faiss_index.measure_lists(faiss_index.train_lists(draft.vectors), draft.vectors)
    lists = faiss_index.extend_lists(known, draft.vectors, draft.before)
    if clean or np.count_nonzero(draft.before >= 0) < len(previous):
        # the centroid of a list of one frame is that frame: none may outlive what is deleted
        lists = faiss_index.centre_lists(lists, draft.vectors)
    if not clean and faiss_index.still_holds(previous.manifest.recall, n):
        return replace(lists, probes=known.probes), previous.manifest.recall
    return faiss_index.measure_lists(lists, draft.vectors)


def _clean(folder: Path, kept: set[Path]) -> None:
    """Remove all manifests but some, and every file that none of these needs."""
    needed = {name for path in kept for name, _ in _files(path)}
    for _, path in manifests(folder):
        if path not in kept:  # before its files: a manifest should not promise what is gone
            path.unlink(missing_ok=True)
    for path in folder.iterdir():
        if is_ours(path.name) and path.name not in needed:
            path.unlink(missing_ok=True)


def _files(path: Path) -> tuple[tuple[str, int], ...]:
    try:
        return read_manifest(path).files
    except DamagedIndex:  # it was not sound, and nothing will be read by it
        return ()


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
