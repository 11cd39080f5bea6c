"""The blobs of a node's settings, opened for maintenance: what is missing is not made."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sceneprint.errors import UnusableStore
from sceneprint.settings import Settings
from sceneprint.store import Blobs, Database, FolderBlobs, open_blobs
from sceneprint.store.database import reach_database


@contextmanager
def opened_blobs(settings: Settings, database: Database | None = None) -> Iterator[Blobs]:
    """Open them, and give their connections back.

    Parameters
    ----------
    settings : that say where they are
    database : whose they are, where it is open already

    Raises
    ------
    UnusableStore : there is no such folder, or they are another database's.
    """
    place = settings.blobs
    if isinstance(place, Path):
        require_folder(place)
        yield FolderBlobs(place, make=False)
        return
    reached = database or reach_database(settings.database)
    try:
        blobs = open_blobs(place, reached, claim=False)
        try:
            yield blobs
        finally:
            blobs.close()
    finally:
        if database is None:
            reached.close()


def require_folder(place: Path) -> None:
    """See that a folder of blobs is there: a disk that is not mounted is not made up for.

    Raises
    ------
    UnusableStore : it is not.
    """
    if not place.is_dir():
        raise UnusableStore(
            f"{place}: there is no such folder. Name the data folder with --data, see that its "
            "disk is mounted, or restore a snapshot."
        )
