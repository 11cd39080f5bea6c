"""Generations: what one published state of the cache holds, and how it is opened."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sceneprint.errors import DamagedIndex
from sceneprint.index.coarse import Coarse, read_coarse
from sceneprint.index.codes import Code, read_code
from sceneprint.index.files import get
from sceneprint.index.keys import Keys, Places
from sceneprint.index.manifests import Manifest, manifests, read_manifest
from sceneprint.index.segments import Segment, open_segment

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Generation:
    """One published state of the cache: immutable, and usable by any number of threads.

    It stays usable after its files have been removed: they are mapped or in memory.

    Parameters
    ----------
    number : of the generation in its folder
    revision : of the map, up to which the generation holds its frames
    model_id : of the model that signed them
    code : of the coarse index
    fitted_on : frames that the map had when the code was fitted
    anchor : as given to `publish`
    segments : stored signatures, also of frames that are gone
    rows : (N,) int64, rising: the row of each frame, counted through all segments
    keys : (N,) int64 of the frames, none twice
    coarse : codes of the frames, in the same order
    """

    number: int
    revision: int
    model_id: str
    code: Code
    fitted_on: int
    anchor: str
    segments: tuple[Segment, ...]
    rows: NDArray[np.int64]
    keys: Keys
    coarse: Coarse

    def __len__(self) -> int:
        return len(self.keys)

    @property
    def dimension(self) -> int:
        """D, bytes of a signature."""
        return len(self.code.mean)

    @cached_property
    def places(self) -> Places:
        """Positions of the frames by their keys."""
        return Places(self.keys)


def newest_number(folder: Path) -> int | None:
    """Number of the newest manifest in a folder, sound or not: a cheap sign of something new."""
    return next((number for number, _ in manifests(folder)), None)


def newest(
    folder: Path,
    model_id: str,
    dimension: int,
    *,
    verify: bool = False,
    known: Generation | None = None,
) -> Generation | None:
    """Open the newest sound generation of a folder.

    A damaged one is skipped with a warning in the log, and an older one is used. The checksums
    of all small files are verified always.

    Parameters
    ----------
    folder : of the map; it need not exist
    model_id, dimension : of the signatures; generations of others are passed over
    verify : read all signatures and verify them too
    known : a generation of this folder that is open: what is unchanged is taken from there, so
        that memory which has been mapped and read stays so

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
                    found = _open(folder, manifest, verify, known)
                    break
            except DamagedIndex as error:
                errors.append(error)
        # what a builder removed after it was listed is not damaged, and something newer is there
        if not errors or manifests(folder) == listed:
            for each in errors:
                _log.warning("A damaged index is passed over, to be built anew: %s", each)
            return found


def _open(folder: Path, manifest: Manifest, verify: bool, known: Generation | None) -> Generation:
    shared = {} if known is None or verify else {each.name: each for each in known.segments}
    segments = []
    for name, size in manifest.of_kind("segment"):
        segment = shared.get(name)
        if segment is None or _inode(folder / name) != segment.inode:
            segment = open_segment(folder / name, verify=verify)
        if segment.size != size or segment.signatures.shape[1] != manifest.dimension:
            raise DamagedIndex(f"{folder / name}: not the segment that its manifest means.")
        segments.append(segment)
    rows = np.frombuffer(get(folder, *manifest.of_kind("rows")[0]), "<i8").astype(np.int64)
    stored = sum(map(len, segments))
    if (rows[1:] <= rows[:-1]).any() or (len(rows) and not 0 <= rows[0] <= rows[-1] < stored):
        raise DamagedIndex(f"{folder}: generation {manifest.number} has rows of no segment.")
    if known is not None and not verify and known.code.id == manifest.code_id:
        code = known.code
    else:
        code = read_code(get(folder, *manifest.of_kind("code")[0]))
    if (code.id, len(code.mean)) != (manifest.code_id, manifest.dimension):
        raise DamagedIndex(f"{folder}: generation {manifest.number} has another code.")
    index = get(folder, *manifest.of_kind("faiss")[0])
    return Generation(
        number=manifest.number,
        revision=manifest.revision,
        model_id=manifest.model_id,
        code=code,
        fitted_on=manifest.fitted_on,
        anchor=manifest.anchor,
        segments=tuple(segments),
        rows=rows,
        keys=keys_of(segments)[rows],
        coarse=read_coarse(index, len(code.matrix), len(rows)),
    )


def _inode(path: Path) -> int | None:
    try:
        return path.stat().st_ino
    except OSError:
        return None


def keys_of(segments: list[Segment]) -> Keys:
    """Keys (rows of all segments,), also of frames that are gone."""
    return np.concatenate([np.empty(0, np.int64), *(each.keys for each in segments)])
