"""Generations: what one published state of the cache holds, and how it is opened."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sceneprint.errors import DamagedIndex
from sceneprint.index.flat import codes_of, map_index
from sceneprint.index.lists import Lists, map_lists
from sceneprint.index.manifest import GenerationManifest, Recall, manifests, read_manifest
from sceneprint.index.mapped_files import Keys, Places, check, mapped
from sceneprint.types import Bytes

if TYPE_CHECKING:
    from faiss import IndexScalarQuantizer

_log = logging.getLogger(__name__)


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

    manifest: GenerationManifest
    keys: Keys
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
    def model_id(self) -> str:
        """Of the model that signed them."""
        return self.manifest.model_id

    @property
    def anchor(self) -> str:
        """As given to `publish`."""
        return self.manifest.anchor

    @property
    def recall(self) -> Recall:
        """What a search finds that does not compare all."""
        return self.manifest.recall

    @property
    def dimension(self) -> int:
        """D, bytes of a signature."""
        return self.manifest.dimension

    @cached_property
    def vectors(self) -> Bytes:
        """Signatures (N, D) uint8 where they are mapped, read-only, in the order of the keys."""
        return codes_of(self.index)

    @cached_property
    def places(self) -> Places:
        """Rows of the frames by their keys."""
        return Places(self.keys)

    def vectors_of(self, keys: Keys) -> Bytes:
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
        listed, found, errors = manifests(folder), None, []
        for _, path in listed:
            try:
                manifest = read_manifest(path)
                if (manifest.model_id, manifest.dimension) == (model_id, dimension):
                    found = open_generation(folder, manifest, known)
                    break
            except DamagedIndex as error:
                errors.append(error)
        # what a builder removed after it was listed is not damaged, and something newer is there
        if not errors or manifests(folder) == listed:
            for each in errors:
                _log.warning("Damaged index skipped; it will be rebuilt: %s", each)
            return found


def open_generation(
    folder: Path, manifest: GenerationManifest, known: Generation | None = None,
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
            for _ in check(folder, name, size):
                pass
    names = {name.rpartition(".")[2]: folder / name for name, _ in manifest.files}
    keys = np.frombuffer(mapped(names["keys"]), "<i8")
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
