"""How much room a store takes on its disk."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from pathlib import Path

from sqlalchemy import make_url

from sceneprint.schemas.operations import Sizes
from sceneprint.settings import Settings

#: Blobs that are measured one by one; of more, the rest is taken to be like them.
MEASURED = 5_000


def sizes(settings: Settings) -> Sizes:
    """Bytes of all parts of a store."""
    return Sizes(
        database=_of_database(settings.database),
        blobs=_of_blobs(settings.blob_dir),
        index=sum(_files_of(settings.indexes, deep=True)),
        free=_free(settings.data_dir),
    )


def _of_database(url: str) -> int | None:
    parsed = make_url(url)
    if parsed.get_backend_name() != "sqlite" or parsed.database is None:
        return None
    path = Path(parsed.database)
    return sum(_size(one) for one in (path, path.with_name(path.name + "-wal")))


def _of_blobs(folder: Path) -> int:
    """Bytes of all blobs: their names are hashes, so that any of the 256 folders is like all."""
    try:
        parts = sorted(one.path for one in os.scandir(folder) if one.is_dir())
    except OSError:
        return 0
    total, seen = 0, 0
    for done, part in enumerate(parts, 1):
        found = list(_files_of(Path(part)))
        total, seen = total + sum(found), seen + len(found)
        if seen >= MEASURED:
            return total * len(parts) // done
    return total


def _files_of(folder: Path, *, deep: bool = False) -> Iterator[int]:
    try:
        for one in os.scandir(folder):
            if one.is_file(follow_symlinks=False):
                yield _size(one)
            elif deep and one.is_dir(follow_symlinks=False):
                yield from _files_of(Path(one.path), deep=True)
    except OSError:
        return  # removed meanwhile, or not there yet


def _size(path: Path | os.DirEntry[str]) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return 0


def _free(folder: Path) -> int:
    try:
        return shutil.disk_usage(folder).free
    except OSError:
        return 0
