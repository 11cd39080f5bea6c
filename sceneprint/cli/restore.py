"""`sceneprint restore`: a data folder of a snapshot, or the store of a fleet."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sceneprint.cli.connection import one_line
from sceneprint.cli.serve import add_data_option
from sceneprint.cli.signals import ended_by_signals
from sceneprint.cli.snapshot import (
    add_database_option,
    contents,
    name_damaged,
    named_database,
    shown_progress,
)
from sceneprint.errors import InvalidRequest

if TYPE_CHECKING:
    from sceneprint.maintenance.snapshots import Snapshot
    from sceneprint.settings import Settings


def add_to(commands: Any) -> None:
    """Describe the command to the parser."""
    command = commands.add_parser(
        "restore",
        help="make a data folder of a snapshot, or fill a database, after verifying all of it",
        description="Verify a snapshot and make a data folder of it, all or nothing; with the URL "
        "of a PostgreSQL database, which must be empty, put its rows there in one transaction, "
        "and its blobs where SCENEPRINT_BLOB_URL says, else in the data folder. A folder "
        "that holds something is not touched unless --replace is given, and is then moved aside, "
        "never removed: stop what uses it first. Exit code 1 where the snapshot says that blobs "
        "were damaged when it was taken; 2 where nothing was restored.",
    )
    command.add_argument(
        "archive",
        type=Path,
        metavar="ARCHIVE",
        help="of `sceneprint snapshot`, or the id of one that a service has taken",
    )
    add_data_option(command)
    add_database_option(command)
    choice = command.add_mutually_exclusive_group()
    choice.add_argument(
        "--verify-only", action="store_true", help="read and check all of it, and restore nothing"
    )
    choice.add_argument(
        "--replace", action="store_true", help="move the folder that is there aside"
    )
    command.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Verify or restore; returns 1 where blobs were damaged when the snapshot was taken."""
    settings, start = named_database(options), time.perf_counter()
    with ended_by_signals(), _archive(options, settings) as archive:
        if options.verify_only:
            snapshot, done, aside = *_verified(archive), None
        elif settings.database_url is not None:
            snapshot, done, aside = *_filled(archive, settings, options), None
        else:
            snapshot, done, aside = _made(archive, settings, options)
    seconds = time.perf_counter() - start
    shown = one_line(str(options.archive))
    print(f"{shown} {done}: {contents(snapshot)} of "
          f"{snapshot.manifest.created_at:%Y-%m-%dT%H:%M:%SZ} in {seconds:.1f} s")  # fmt: skip
    if aside is not None:
        print(f"what was there before is kept in {one_line(str(aside))}", file=sys.stderr)
    advice = "These frames were damaged before; delete them, or upload them again."
    return 1 if name_damaged(snapshot, advice) else 0


@contextmanager
def _archive(options: argparse.Namespace, settings: Settings) -> Iterator[Path]:
    """The archive as a file; what is none may be the id of a snapshot that a service has taken."""
    from sceneprint.maintenance.shelf import Shelf, is_snapshot_id

    named: Path = options.archive
    if named.exists() or not is_snapshot_id(str(named)):
        yield named
        return
    # of a folder that is to be made nothing may be there
    fleet = settings.database_url is not None
    place = settings.data_dir if fleet else settings.data_dir.absolute().parent
    with Shelf(settings).local(str(named), place) as archive:
        yield archive


def _verified(archive: Path) -> tuple[Snapshot, str]:
    from sceneprint.maintenance.restoring import verify_snapshot

    with shown_progress("verify") as progress:
        return verify_snapshot(archive, progress), "is whole"


def _filled(archive: Path, settings: Settings, options: argparse.Namespace) -> tuple[Snapshot, str]:
    """Restored into the database of a fleet."""
    from sceneprint.maintenance.fleets import restore_to_fleet
    from sceneprint.store.database import reach_database

    database = reach_database(settings.database)
    database.close()
    if database.is_sqlite:
        raise InvalidRequest(
            "SCENEPRINT_DATABASE_URL is set to SQLite, and a snapshot is restored to the data "
            "folder, where no service would look then. Unset it, for the service too."
        )
    if options.replace:
        raise InvalidRequest(
            "--replace moves a folder aside, and a database stays where it is. Make an empty one "
            "(CREATE DATABASE), and name that."
        )
    with shown_progress("restore") as progress:
        snapshot = restore_to_fleet(archive, settings, progress)
    return snapshot, f"is restored to {one_line(database.shown)}"


def _made(
    archive: Path, settings: Settings, options: argparse.Namespace
) -> tuple[Snapshot, str, Path | None]:
    """Restored to a folder."""
    from sceneprint.maintenance.restoring import restore_snapshot

    if settings.blob_url is not None:
        raise InvalidRequest(
            "SCENEPRINT_BLOB_URL is set, and blobs are restored to the data folder, where no "
            "service would look then. Unset it, or restore into a fleet: --database."
        )
    with shown_progress("restore") as progress:
        snapshot, aside = restore_snapshot(
            archive, settings.data_dir, replace=options.replace, progress=progress
        )
    return snapshot, f"is restored to {one_line(str(settings.data_dir))}", aside
