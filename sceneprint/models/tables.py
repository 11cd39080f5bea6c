"""The pair table of a model: built once per machine, then memory-mapped by every process."""

from __future__ import annotations

import os
import tempfile
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import platformdirs

from sceneprint.geometry.projection import DIMENSION
from sceneprint.geometry.table import LEADING, PairTable, part
from sceneprint.models.model import Model

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
        _publish(packed, path)
    except OSError:  # read-only or full: a cache is a convenience
        return _unpacked(packed)
    return _mapped(path, model) or _unpacked(packed)


def _record() -> np.dtype[np.void]:
    # one bin is 96 contiguous bytes, so that a look-up touches two cache lines, not three pages
    return np.dtype(
        [
            ("features", "<f4", (DIMENSION,)),
            ("posteriors", "<f4", (LEADING,)),
            ("components", "<i2", (LEADING,)),
        ]
    )


def _unpacked(packed: np.ndarray) -> PairTable:
    return PairTable(packed["features"], packed["components"], packed["posteriors"])


def _mapped(path: Path, model: Model) -> PairTable | None:
    try:
        with path.open("rb") as file:
            head = file.read(HEAD)
        if path.stat().st_size != HEAD + model.parameters.table.n_bins * _record().itemsize:
            return None
        packed = np.memmap(path, _record(), "r", offset=HEAD, shape=model.parameters.table.n_bins)
    except (OSError, ValueError):
        return None
    return _unpacked(packed) if head == _head(packed) else None


def _head(packed: np.ndarray) -> bytes:
    """First bytes of the file: what it is, and a checksum of the rest (20 ms to verify)."""
    checksum = zlib.crc32(packed.view(np.uint8).data)
    return f"sceneprint table {CACHE_VERSION} {checksum:08x}".encode().ljust(HEAD)


def build_table(model: Model, progress: Progress | None = None) -> PairTable:
    """The table of a model, evaluated in memory.

    Parameters
    ----------
    model : see Model
    progress : called with bins done and their total
    """
    return _unpacked(_build(model, progress))


def _build(model: Model, progress: Progress | None) -> np.ndarray:
    p, n = model.parameters, model.parameters.table.n_bins
    packed = np.zeros(n, _record())
    for first in range(0, n, CHUNK):
        last = min(first + CHUNK, n)
        done = part(first, last, p.table, p.properties, model.projection, model.mixture)
        packed["features"][first:last] = done.features
        packed["components"][first:last] = done.components
        packed["posteriors"][first:last] = done.posteriors
        if progress is not None:
            progress(last, n)
    return packed


def _publish(packed: np.ndarray, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    descriptor, partial = tempfile.mkstemp(dir=path.parent, prefix=path.name, suffix=".partial")
    try:
        with os.fdopen(descriptor, "wb") as file:
            file.write(_head(packed))
            file.write(packed.data)
        Path(partial).replace(path)
    except BaseException:
        Path(partial).unlink(missing_ok=True)
        raise
