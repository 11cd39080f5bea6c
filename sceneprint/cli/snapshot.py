"""`sceneprint snapshot`: all that must not be lost, in one archive."""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tqdm import tqdm

from sceneprint.cli.connection import one_line, open_client
from sceneprint.cli.serve import add_data_option, settings_of
from sceneprint.cli.signals import ended_by_signals

if TYPE_CHECKING:
    from sceneprint.maintenance.snapshots import Snapshot
    from sceneprint.schemas.snapshots import SnapshotFile
    from sceneprint.settings import Settings

#: Damaged blobs that are named one by one.
_SHOWN = 10
#: Longest wait for a service to take one, seconds.
_PATIENCE_S = 6 * 3600.0


def add_to(commands: Any) -> None:
    """Describe the command to the parser."""
    command = commands.add_parser(
        "snapshot",
        help="write all that must not be lost into one archive, while the service runs",
        description="Write one state of the store into an archive: database and blobs. "
        "The service and its workers may go on. Search indexes are not in it, as they are made "
        "anew. Exit code 1 where a blob was missing or damaged and could not be taken along. "
        "The archive holds all frames and the hashes of keys: keep it as you keep the folder.",
    )
    add_data_option(command)
    add_database_option(command)
    command.add_argument(
        "--out",
        type=Path,
        metavar="FILE",
        help="archive to write, or its folder (default: where SCENEPRINT_SNAPSHOT_URL says, else "
        "sceneprint-TIME.tar here)",
    )
    command.add_argument(
        "--url",
        metavar="URL",
        help="let the service there take it, and fetch it, rather than read a folder here",
    )
    command.add_argument(
        "--key",
        default=os.environ.get("SCENEPRINT_KEY") or None,
        help="where that service asks for one (default: SCENEPRINT_KEY)",
    )
    command.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Take a snapshot; returns 1 where something could not be taken along."""
    from sceneprint.maintenance.snapshots import take_snapshot

    name = f"sceneprint-{datetime.now(UTC):%Y%m%dT%H%M%SZ}.tar"
    path = Path(name) if options.out is None else options.out
    if path.is_dir():
        path = path / name
    start = time.perf_counter()
    if options.url is not None:
        return _fetched(options, path)
    settings = named_database(options)
    if options.out is None and settings.snapshot_url is not None:
        return _shelved(settings)
    with ended_by_signals(), shown_progress("snapshot") as progress:
        taken = take_snapshot(settings, path, progress)
    print(f"{one_line(str(path))}: {contents(taken)} in {time.perf_counter() - start:.1f} s")
    return 1 if name_damaged(taken, "Run `sceneprint fsck` to see what can be done.") else 0


def add_database_option(command: argparse.ArgumentParser) -> None:
    """`--database`."""
    command.add_argument(
        "--database",
        metavar="URL",
        help="such as postgresql://user@host/name (default: SCENEPRINT_DATABASE_URL, else SQLite "
        "in the data folder); a password comes from that variable, or PGPASSWORD",
    )


def named_database(options: argparse.Namespace) -> Settings:
    """Settings of the environment, and the database that `--database` names.

    Raises
    ------
    InvalidRequest : its URL has a password, which everybody on the machine could see.
    """
    from pydantic import SecretStr
    from sqlalchemy import make_url
    from sqlalchemy.exc import ArgumentError

    from sceneprint.errors import InvalidRequest

    settings = settings_of(options)
    if options.database is None:
        return settings
    try:
        told = make_url(options.database)
        shown = told.password is not None or "password" in told.query
    except (ArgumentError, ValueError):
        raise InvalidRequest(
            "--database: no URL of a database, such as postgresql://user@host/name."
        ) from None
    if shown:
        raise InvalidRequest(
            "--database: a password on the command line can be seen by everybody on this machine. "
            "Set PGPASSWORD, or give the whole URL in SCENEPRINT_DATABASE_URL."
        )
    return settings.model_copy(update={"database_url": SecretStr(options.database)})


def _shelved(settings: Settings) -> int:
    """Take a snapshot to where those of the service are; returns 1 where blobs were lost."""
    from sceneprint.maintenance.shelf import Shelf, new_snapshot_id

    start = time.perf_counter()
    with ended_by_signals(), shown_progress("snapshot") as progress:
        taken = Shelf(settings).take(new_snapshot_id(), progress)
    return _told(taken, f"snapshot {taken.snapshot_id} in {settings.snapshot_url}", start)


def _fetched(options: argparse.Namespace, path: Path) -> int:
    """Have a service take a snapshot, and download it; returns 1 where blobs were lost."""
    from sceneprint.errors import InvalidRequest, SnapshotError
    from sceneprint.schemas.snapshots import SnapshotFile

    if options.data is not None:
        raise InvalidRequest("--url names a service and --data a folder here. Give one of them.")
    start = time.perf_counter()
    with open_client(options) as client:
        job = client.take_snapshot(wait_s=_PATIENCE_S)
        if job.result is None:
            why = job.error or "no worker has done it; see `sceneprint jobs`"
            raise SnapshotError(f"The service took no snapshot: job {job.job_id}: {why}")
        taken = SnapshotFile.model_validate(job.result)
        client.download_snapshot(taken.snapshot_id, path)
    return _told(taken, str(path), start)


def _told(taken: SnapshotFile, place: str, start: float) -> int:
    """Say what has been taken; returns 1 where blobs were lost."""
    print(
        f"{one_line(place)}: {taken.maps} maps, {taken.frames} frames, {taken.blobs} blobs, "
        f"{taken.bytes / 1e6:,.1f} MB in {time.perf_counter() - start:.1f} s"
    )
    if taken.damaged:
        print(f"{taken.damaged} blobs were lost, and are not in it; damaged.jsonl in it names "
              "them.", file=sys.stderr)  # fmt: skip
    return 1 if taken.damaged else 0


@contextmanager
def shown_progress(what: str) -> Iterator[Callable[[int, int], None]]:
    """A bar of bytes on a terminal; yields what is to be told of bytes done and in all."""
    with tqdm(desc=what, unit="B", unit_scale=True, disable=None) as bar:

        def progress(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        yield progress


def contents(snapshot: Snapshot) -> str:
    """What is in a snapshot, in a few words."""
    held = snapshot.manifest
    return (
        f"{held.maps} maps, {held.n_frames} frames, {held.blobs.count} blobs, "
        f"{held.bytes / 1e6:,.1f} MB"
    )


def name_damaged(snapshot: Snapshot, advice: str) -> bool:
    """Name on standard error what is not in a snapshot; whether there is any."""
    if not snapshot.damaged:
        return False
    for one in snapshot.damaged[:_SHOWN]:
        of = ", ".join(f"{use.role} of {use.map}/{use.frame}" for use in one.of)
        print(one_line(f"not in it: blob {one.digest[:12]}, {one.why}: {of}"), file=sys.stderr)
    more = len(snapshot.damaged) - _SHOWN
    if more > 0:
        print(f"... and {more} more, in damaged.jsonl of the archive", file=sys.stderr)
    print(f"All else is in it. {advice}", file=sys.stderr)
    return True
