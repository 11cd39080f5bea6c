"""The truth: one database with maps, frames, signatures and jobs, and a folder of blobs.

Everything else on disk is a cache of this. Functions take the connection of a transaction, so
that what belongs together is committed together; `Store` opens both parts.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from sceneprint.store.blobs import Blobs
from sceneprint.store.database import Database, is_there, open_database
from sceneprint.store.sealed import is_sealed
from sceneprint.store.seals import Seals

__all__ = ["Blobs", "Database", "Store", "open_database", "open_store"]


@dataclass(frozen=True, eq=False)
class Store:
    """Database and blobs, opened."""

    database: Database
    blobs: Blobs

    @cached_property
    def seals(self) -> Seals:
        """What numbers of its rows look like from outside."""
        return Seals(self.database)


def open_store(url: str, blobs: Path) -> Store:
    """Open both, made where both are missing.

    The folder of a database that is there is never made: its disk is not mounted, and what was
    written in its place would be gone when it is.

    Parameters
    ----------
    url : of the database
    blobs : folder

    Raises
    ------
    UnusableStore, NewerSchema : see `open_database`.
    """
    new = not is_sealed(url) and not is_there(url)
    kept = Blobs(blobs, make=new)  # the data folder is made with it
    return Store(open_database(url), kept)
