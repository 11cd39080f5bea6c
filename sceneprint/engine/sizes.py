"""How much room a store takes on its disk."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path

from sqlalchemy import Connection, func, select

from sceneprint.engine.readers import index_folder
from sceneprint.errors import UnusableStore
from sceneprint.schemas.operations import Sizes
from sceneprint.settings import Settings
from sceneprint.store import Blobs, Database, FolderBlobs, Store
from sceneprint.store.growth import bytes_of_files, count_kept, kept_frames, spread_frames, weigh
from sceneprint.store.records import MapRow

#: Blobs that are measured one by one; of more, the rest is taken to be like them.
MEASURED = 5_000
#: Frames of one map that are; taken evenly in the order they came.
WEIGHED = 1_000
#: Frames of a whole store that are weighed where blobs are not files, and blobs that are asked for.
SPREAD, ASKED = 64, 16
_HERE = func.current_database()


def sizes(settings: Settings, store: Store) -> Sizes:
    """Bytes of all parts of a store."""
    free, disk = _free_of(settings.data_dir)
    blobs = settings.blobs
    return Sizes(
        database=_of_database(store.database),
        blobs=_of_blobs(blobs) if isinstance(blobs, Path) else _of_objects(store),
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
    artifacts = _of_artifacts(store.blobs, weight.artifacts)
    share = max(len(numbers), 1)
    return Sizes(
        database=weight.signature_bytes * total // share,
        blobs=(weight.upload_bytes + artifacts) * total // share,
        index=sum(_files_of(index_folder(indexes, row), deep=True)),
        free=None,
        disk=None,
    )


def _of_database(database: Database) -> int | None:
    if not database.is_sqlite:
        with database.read() as connection:
            return int(connection.execute(select(func.pg_database_size(_HERE))).scalar_one())
    path = database.file
    if path is None:
        return None
    return sum(_size(one) for one in (path, path.with_name(path.name + "-wal")))


def _of_objects(store: Store) -> int:
    """Bytes of all blobs in an object store: some of the rows are weighed, nothing is listed."""
    with store.database.read() as connection:
        some = spread_frames(connection, SPREAD)
        weight = weigh(connection, some)
        total = count_kept(connection)
        files = bytes_of_files(connection)
    each = (weight.upload_bytes + _of_artifacts(store.blobs, weight.artifacts)) / max(len(some), 1)
    return int(each * total) + files


def _of_artifacts(blobs: Blobs, artifacts: Sequence[str]) -> int:
    """Bytes of some blobs; of many that each cost a request, a few stand for all."""
    if isinstance(blobs, FolderBlobs):
        return sum(blobs.size(one) or 0 for one in artifacts)
    some = artifacts[:: max(-(-len(artifacts) // ASKED), 1)]
    try:
        asked = sum(blobs.size(one) or 0 for one in some)
    except UnusableStore:  # other figures are told while the store is away
        return 0
    return asked * len(artifacts) // max(len(some), 1)


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
