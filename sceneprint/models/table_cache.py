"""The pair table of a model: built once per machine, then memory-mapped by every process."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import platformdirs

from sceneprint.atomic_files import write_whole
from sceneprint.geometry.signature.pair_table import WIDTH, PairTable, part
from sceneprint.models.model import Model
from sceneprint.types import Floats32

#: Layout of the cached file; a change makes new files beside the old.
CACHE_VERSION = 1
#: Bytes before the bins; a multiple of a cache line, so that the bins stay aligned.
HEAD = 64
#: Bins evaluated between two reports of progress.
CHUNK = 16_384

#: Called with the number of bins done and their total.
Progress = Callable[[int, int], None]


def default_cache_dir() -> Path:
    """Where derived files go unless told otherwise: the user's cache folder."""
    return Path(platformdirs.user_cache_dir("sceneprint", appauthor=False))


def open_table(
    model: Model, cache_dir: Path | None = None, progress: Progress | None = None
) -> PairTable:
    """The table of a model, from the cache where it is there.

    Two processes that build it at once each publish a whole file, of the same bytes. Where
    the cache folder cannot be written, the table is held in memory.

    Parameters
    ----------
    model : see Model
    cache_dir : folder of derived files; created where missing
    progress : called while the table is being built
    """
    folder = default_cache_dir() if cache_dir is None else cache_dir
    path = folder / f"table-v{CACHE_VERSION}-{model.id}.bin"
    cached = _mapped(path, model)
    if cached is not None:
        return cached
    packed = _build(model, progress)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_whole(path, _head(packed) + packed.tobytes())
    except OSError:  # read-only or full: a cache is a convenience
        return PairTable(packed)
    return _mapped(path, model) or PairTable(packed)


def _mapped(path: Path, model: Model) -> PairTable | None:
    try:
        with path.open("rb") as file:
            head = file.read(HEAD)
        shape = (model.parameters.table.n_bins, WIDTH)
        if path.stat().st_size != HEAD + 4 * shape[0] * shape[1]:
            return None
        packed = np.memmap(path, np.float32, "r", offset=HEAD, shape=shape)
    except (OSError, ValueError):
        return None
    # an ndarray of the same memory: a memmap would make every slice of it cost more
    return PairTable(np.asarray(packed)) if head == _head(packed) else None


def _head(packed: Floats32) -> bytes:
    """First bytes of the file: what it is, and a checksum of the rest (20 ms to verify)."""
    return _head_of(zlib.crc32(packed.view(np.uint8).data))


def _head_of(checksum: int) -> bytes:
    return f"sceneprint table {CACHE_VERSION} {checksum:08x}".encode().ljust(HEAD)


def build_table(model: Model, progress: Progress | None = None) -> PairTable:
    """The table of a model, evaluated in memory.

    Parameters
    ----------
    model : see Model
    progress : called with bins done and their total
    """
    return PairTable(_build(model, progress))


def _build(model: Model, progress: Progress | None) -> Floats32:
    p, n = model.parameters, model.parameters.table.n_bins
    packed = np.empty((n, WIDTH), np.float32)
    for first in range(0, n, CHUNK):
        last = min(first + CHUNK, n)
        done = part(first, last, p.table, p.properties, model.projection, model.mixture)
        packed[first:last] = done.packed
        if progress is not None:
            progress(last, n)
    return packed


def is_sound_table(path: Path) -> bool:
    """Whether a cached table has the bytes that were written, whatever model it is of.

    Parameters
    ----------
    path : of the file

    Raises
    ------
    OSError : it cannot be read.
    """
    with path.open("rb") as file:
        head = file.read(HEAD)
        if len(head) < HEAD or path.stat().st_size == HEAD:
            return False
        packed = np.memmap(path, np.uint8, "r", offset=HEAD)
    return head == _head_of(zlib.crc32(packed.data))
