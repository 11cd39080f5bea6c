"""Publishing a generation: what stays of the one before and what is new, in the order of the keys.

Every file is durable before the manifest that names it, and the manifest comes last: a builder
killed at any moment leaves the generation before, and files that the next builder removes.
"""

from __future__ import annotations

import mmap
import os
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sceneprint.atomic_files import create_private
from sceneprint.errors import DamagedIndex
from sceneprint.index import faiss_index
from sceneprint.index.generation import Generation, newest, open_generation
from sceneprint.index.generation_files import (
    BLOCK_BYTES,
    Block,
    GenerationManifest,
    Keys,
    Places,
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
    anchor: str = "",
    clean: bool = False,
    flat_bytes: int = FLAT_BYTES,
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
    anchor : of the database's state; kept as it is, for whoever opens the generation to check
    clean : leave no file that has a byte of a frame that is no longer there: the generation
        before is not kept
    flat_bytes : of signatures, above which there is an inverted file

    Returns
    -------
    the generation, open; None where somebody else is building, or `previous` is no longer the
    newest of the folder: then open the newest and try again

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
            number=listed[0][0] + 1 if listed else 1,
            revision=revision,
            model_id=model_id,
            dimension=draft.vectors.shape[1],
            anchor=anchor,
            files=tuple(files),
            recall=recall,
        )
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
