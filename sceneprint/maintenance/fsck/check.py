"""Check and repair of a data folder: lost, damaged and superfluous data.

    Settings  --fsck-->  Findings, as they are discovered

Without `repair`, the check writes nothing. With `repair`, each finding is verified again and
repaired in one transaction, because running services and workers may have changed the data in the
meantime.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from sqlalchemy import select

from sceneprint.errors import SceneprintError, UnusableStore
from sceneprint.maintenance.fsck.blobs import check_blobs, check_files, check_products
from sceneprint.maintenance.fsck.database_checks import (
    FATAL,
    check_counts,
    check_database,
    check_models,
    check_rows,
    damaged_database,
)
from sceneprint.maintenance.fsck.findings import (
    GRACE_S,
    Finding,
    Folder,
    Progress,
    is_data_damage,
)
from sceneprint.maintenance.fsck.indexes import check_indexes
from sceneprint.settings import Settings
from sceneprint.store import Blobs, Database, Store, open_store
from sceneprint.store.maps import find_map
from sceneprint.store.read_only import inspect_blobs, inspect_database, require_folder
from sceneprint.store.tables import frames
from sceneprint_client.api import FrameState


def check_frames(folder: Folder, numbers: list[int]) -> Iterator[Finding]:
    """Check the rows, signatures, uploads and artifacts of the frames with these numbers."""
    yield from check_rows(folder, numbers)
    yield from check_blobs(folder, "upload", numbers)
    yield from check_blobs(folder, "artifact", numbers)


def _check_all_frames(folder: Folder) -> Iterator[Finding]:
    for numbers in folder.numbers("frames"):
        yield from check_frames(folder, numbers)


#: Checks in order; files precede frames, since repairs of frames doom blobs and these would be
#: reported as unreferenced.
_CHECKS: tuple[Callable[[Folder], Iterator[Finding]], ...] = (
    check_database, check_models, check_counts, check_files, _check_all_frames, check_products,
    check_indexes,
)  # fmt: skip


def fsck(
    settings: Settings, *, map_name: str | None = None, repair: bool = False, quick: bool = False,
    grace_s: float = GRACE_S, progress: Progress = lambda *_: None,
    counts: Counter[str] | None = None,
) -> Iterator[Finding]:  # fmt: skip
    """Check a data folder and yield the findings; the service may run.

    Parameters
    ----------
    map_name : map to check; None checks all maps, and data without a map
    repair : whether to repair the findings
    quick : whether to check only that blobs and rows exist, without reading their content
    grace_s : age, in seconds, below which unreferenced files are ignored
    counts : counter that receives the numbers of checked objects

    Yields
    ------
    finding : a finding, after its repair if `repair` is set

    Raises
    ------
    UnusableStore, NewerSchema : If the folder is missing or cannot be read.
    UnknownMap : If the map does not exist.
    ValueError : If both `quick` and `repair` are set, since unread data cannot be repaired.
    """
    if quick and repair:
        raise ValueError("a quick check cannot repair")
    with _open_store(settings, repair=repair) as store:
        counts = Counter() if counts is None else counts
        folder = Folder(settings, store, map_name, quick, grace_s, progress, counts)
        if map_name is not None:
            with store.database.read() as connection:
                find_map(connection, map_name)
        trusted = True
        for check in _CHECKS:
            for finding in _findings_of(check, folder):
                trusted &= finding.kind not in FATAL
                yield _repaired(finding, trusted) if repair and finding.repair else finding


def _findings_of(check: Callable[[Folder], Iterator[Finding]], folder: Folder) -> Iterator[Finding]:
    """Yield the findings of a check; an unreadable database is the last finding."""
    try:
        yield from check(folder)
    except (ValueError, TypeError, KeyError, UnusableStore) as error:
        if not is_data_damage(error):
            raise
        yield damaged_database(f"{type(error).__name__}: {error}")


def _repaired(finding: Finding, trusted: bool) -> Finding:
    """Repair a finding unless the database is damaged; return it with the result or the error."""
    assert finding.repair is not None
    if not trusted:
        return replace(finding, error="the database is damaged: restore a backup first")
    try:
        return replace(finding, done=finding.repair())
    except SceneprintError as error:
        return replace(finding, error=str(error))
    except OSError as error:
        return replace(finding, error=f"{error.filename or 'a file'}: {error.strerror or error}")


@contextmanager
def _open_store(settings: Settings, *, repair: bool) -> Iterator[Store]:
    """Open an existing store, for writing only if `repair` is set and the blobs seem present."""
    # a disk that is not mounted would look like an empty folder
    if isinstance(settings.blobs, Path):
        require_folder(settings.blobs)
    # a repair must not create a database
    with (
        inspect_database(settings.database) as database,
        inspect_blobs(settings.blobs, database) as blobs,
    ):
        if not repair:
            yield Store(database, blobs)
            return
        _require_blobs(database, blobs, settings.blobs)
    store = open_store(settings.database, settings.blobs)
    try:
        yield store
    finally:
        store.close()


def _require_blobs(database: Database, blobs: Blobs, place: Path | str) -> None:
    """Raise UnusableStore if frames refer to blobs but no blob exists: an unmounted disk."""
    without = FrameState.DELETED, FrameState.REDUNDANT
    refers = select(frames.c.number).where(frames.c.state.not_in(without)).limit(1)
    with database.read() as connection:
        if connection.execute(refers).first() is None:
            return
    if next(blobs.digests(), None) is None:
        raise UnusableStore(
            f"{place}: The folder has no uploads, although the database refers to some. Nothing "
            "was changed. Check that the disk is mounted, or restore a backup."
        )
