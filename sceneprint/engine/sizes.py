"""How much room a store takes on its disk."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from pathlib import Path

from sqlalchemy import Connection, make_url

from sceneprint.engine.readers import index_folder
from sceneprint.schemas.operations import Sizes
from sceneprint.settings import Settings
from sceneprint.store import Store
from sceneprint.store.growth import kept_frames, weigh
from sceneprint.store.records import MapRow

#: Blobs that are measured one by one; of more, the rest is taken to be like them.
MEASURED = 5_000
#: Frames of one map that are; taken evenly in the order they came.
WEIGHED = 1_000


def sizes(settings: Settings) -> Sizes:
    """Bytes of all parts of a store."""
    free, disk = _free_of(settings.data_dir)
    return Sizes(
        database=_of_database(settings.database),
        blobs=_of_blobs(settings.blob_dir),
        index=sum(_files_of(settings.indexes, deep=True)),
        free=free,
        disk=disk,
    )


def sizes_of_map(connection: Connection, store: Store, indexes: Path, row: MapRow) -> Sizes:
    """Bytes of what one map takes: of it alone, so that nothing shows of any other.

    A blob that several frames share counts for each of them.

    Parameters
    ----------
    connection : of the store's database
    store : see Store
    indexes : folder of search indexes
    row : of the map
    """
    numbers, total = kept_frames(connection, row.number, WEIGHED)
    weight = weigh(connection, numbers)
    artifacts = sum(store.blobs.size(one) or 0 for one in weight.artifacts)
    share = max(len(numbers), 1)
    return Sizes(
        database=weight.signature_bytes * total // share,
        blobs=(weight.upload_bytes + artifacts) * total // share,
        index=sum(_files_of(index_folder(indexes, row), deep=True)),
        free=None,
        disk=None,
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


def _free_of(folder: Path) -> tuple[int, int]:
    """Bytes left on a disk, and all that it has."""
    try:
        found = shutil.disk_usage(folder)
    except OSError:
        return 0, 0
    return found.free, found.total
