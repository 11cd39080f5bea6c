"""The truth: one database with maps, frames, signatures and jobs, and a folder of blobs.

Everything else on disk is a cache of this. Functions take the connection of a transaction, so
that what belongs together is committed together; `Store` opens both parts.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from sceneprint.store.blobs import Blobs
from sceneprint.store.database import Database, open_database
from sceneprint.store.sealed import is_sealed

__all__ = ["Blobs", "Database", "Store", "open_database", "open_store"]


@dataclass(frozen=True, eq=False)
class Store:
    """Database and blobs, opened."""

    database: Database
    blobs: Blobs


def open_store(url: str, blobs: Path) -> Store:
    """Open both, made where missing; beside a database that may be read alone nothing is made.

    Parameters
    ----------
    url : of the database
    blobs : folder

    Raises
    ------
    UnusableStore, NewerSchema : see `open_database`.
    """
    kept = Blobs(blobs, make=not is_sealed(url))  # the data folder is made with it
    return Store(open_database(url), kept)
