"""Commands on a store: `migrate`, `fsck`, `purge`, `snapshot`, `restore`, `pull`, `reencode`."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tqdm import tqdm

from sceneprint.atomic_files import check_writable, write_whole
from sceneprint.cli import positive, whole_number
from sceneprint.cli.options import (
    add_service_options,
    ended_by_signals,
    one_line,
    open_client,
    require_database,
    waiting_reason,
)
from sceneprint.cli.serve import add_data_option, settings_of
from sceneprint.errors import InvalidRequest
from sceneprint.process import COMMAND, acting_as

if TYPE_CHECKING:
    from sceneprint.bundle.backup import Bundle
    from sceneprint.engine import Engine
    from sceneprint.maintenance.fsck.findings import Finding
    from sceneprint.settings import Settings
    from sceneprint.store import Database
    from sceneprint_client.api import Map

#: What was looked at, in the order in which it is told.
_COUNTED = (
    "models", "frames", "signatures", "blobs", "files", "indexes",
)  # fmt: skip


def add_migrate(command: argparse.ArgumentParser) -> None:
    """Add the options of `sceneprint migrate`."""
    add_data_option(command)
    command.add_argument(
        "--check",
        action="store_true",
        help="change nothing; exit code 1 if the schema must first be created or upgraded",
    )
    command.set_defaults(run=run_migrate)


def run_migrate(options: argparse.Namespace) -> int:
    """Create or upgrade the schema of a data folder or of DATABASE_URL, in one transaction, and
    print the revisions. `serve` and `work` do so by themselves when they start; use this as a
    step of its own in a deployment. Where the schema is up to date it changes nothing. Exit code
    2 if a later version wrote the database, or it cannot be reached.
    """
    from sceneprint.engine import Engine
    from sceneprint.store.database import is_there, reach_database

    settings = settings_of(options)
    database = reach_database(settings.database)
    try:
        before, usable = _revisions(database) if is_there(settings.database) else (None, False)
        shown = f"{database.shown}: schema {before or 'none'}"
        if options.check:
            print(shown if usable else f"{shown}; run `sceneprint migrate`")
            return 0 if usable else 1
        Engine(settings).close()  # opening it makes or upgrades the schema
        after, _ = _revisions(database)
    finally:
        database.close()
    print(shown if before == after else f"{shown} -> {after}")
    return 0


def _revisions(database: Database) -> tuple[str | None, bool]:
    """The revision of a store's schema, and whether this version can use it as it is."""
    from sceneprint.store.database import current_revision, known_revisions, revision_of

    with database.read() as connection:
        return revision_of(connection), current_revision(connection) == known_revisions()[0]


def add_fsck(command: argparse.ArgumentParser) -> None:
    """Add the options of `sceneprint fsck`."""
    add_data_option(command)
    command.add_argument("--map", metavar="MAP", help="check only this map")
    how = command.add_mutually_exclusive_group()
    how.add_argument(
        "--repair",
        action="store_true",
        help="repair what can be repaired; damaged files move to `quarantine` in the data folder",
    )
    how.add_argument(
        "--quick",
        action="store_true",
        help="check that files exist, without reading their contents",
    )
    command.add_argument(
        "--grace",
        type=whole_number,
        metavar="SECONDS",
        help="keep unreferenced files that changed within this time (default: 3600)",
    )
    command.add_argument(
        "--json", type=Path, metavar="FILE", help="also write the findings to this file"
    )
    command.set_defaults(run=run_fsck)


def run_fsck(options: argparse.Namespace) -> int:
    """Check rows, signatures, blobs and indexes of a data folder, and report problems and what
    --repair would do. Changes nothing without --repair. The service may be running. Exit code 1
    if problems remain, 2 if the folder cannot be checked.
    """
    from sceneprint.engine import Engine
    from sceneprint.maintenance.fsck.check import fsck
    from sceneprint.maintenance.fsck.findings import GRACE_S

    if options.json is not None:
        check_writable(options.json)
    counts, findings = Counter[str](), []
    with acting_as(COMMAND), ended_by_signals(), _progress_bar() as progress:
        for finding in fsck(
            settings_of(options), map_name=options.map, repair=options.repair,
            quick=options.quick, progress=progress, counts=counts,
            grace_s=GRACE_S if options.grace is None else min(options.grace, 10**10),
        ):  # fmt: skip
            findings.append(finding)
            tqdm.write(_line(finding))
    repaired = sum(each.done is not None for each in findings)
    if repaired:
        with acting_as(COMMAND), Engine(settings_of(options)) as engine:
            engine.audit.record("store.repaired", options.map, repaired=repaired)
    if options.json is not None:
        record = {"checked": dict(counts), "findings": [_record(each) for each in findings]}
        write_whole(options.json, (json.dumps(record, indent=1) + "\n").encode())
    print("checked " + ", ".join(f"{counts[name]} {name}" for name in _COUNTED))
    print(_summary(findings, repair=options.repair))
    return 1 if any(each.left for each in findings) else 0


def _line(finding: Finding) -> str:
    if finding.done is not None:
        then = f"; done: {finding.done}"
    elif finding.error is not None:
        then = f"; NOT REPAIRED: {finding.error}"
    else:
        then = "" if finding.would is None else f"; would: {finding.would}"
    return one_line(f"{finding.severity:8}  {finding.kind}  {finding.what}: {finding.means}{then}")


def _summary(findings: list[Finding], *, repair: bool) -> str:
    kinds = Counter(each.severity for each in findings)
    damaged, unneeded, left = kinds["damage"], kinds["leftover"], sum(o.left for o in findings)
    if not damaged and not unneeded:
        return "no problems found"
    found = f"{damaged} damaged, {unneeded} left over"
    if repair:
        done = f"{damaged + unneeded - left} repaired, {left} not"
        return f"{found}: {done}. Run it again once workers have signed the queued frames."
    possible = sum(each.repair is not None for each in findings)
    return f"{found}; nothing was changed: `sceneprint fsck --repair` can repair {possible}"


def _record(finding: Finding) -> dict[str, object]:
    names = ("kind", "severity", "what", "means", "would", "map", "frame_id", "done", "error")
    path = None if finding.path is None else str(finding.path)
    return {name: getattr(finding, name) for name in names} | {"path": path}


@contextmanager
def _progress_bar() -> Iterator[Callable[[str, int, int], None]]:
    """A bar on a terminal, of one subject after the other."""
    with tqdm(disable=None, leave=False) as bar:

        def progress(subject: str, done: int, total: int) -> None:
            if bar.disable:
                return
            if bar.desc != f"{subject}: ":
                bar.reset(total)
                bar.set_description(subject)
            bar.total, bar.n = total, done
            bar.refresh()

        yield progress


# `sceneprint purge`: deletions made final now.


def add_purge(command: argparse.ArgumentParser) -> None:
    """Add the options of `sceneprint purge`."""
    add_data_option(command)
    command.set_defaults(run=run_purge)


def run_purge(options: argparse.Namespace) -> int:
    """Erase every byte of deleted frames on this node now, without waiting for
    SCENEPRINT_PURGE_S. Their deletion cannot be undone afterwards.
    """
    from sceneprint.engine import Engine

    settings = settings_of(options)
    require_database(settings)
    with Engine(settings) as engine:
        found = engine.purging.now()
        print(
            f"purged {found.blobs} blobs, {found.answers} stored answers, "
            f"{found.products} products; rebuilt {found.indexes} indexes"
        )
        if not engine.store.database.shrink_log():
            print("the database log is in use: run this again when nothing reads the database")
            return 1
    return 0


# `sceneprint snapshot`: all that must not be lost, in one archive.

#: Damaged blobs that are named one by one.
_SHOWN = 10


def add_snapshot(command: argparse.ArgumentParser) -> None:
    """Add the options of `sceneprint snapshot`."""
    add_data_option(command)
    add_database_option(command)
    command.add_argument(
        "--to",
        required=True,
        metavar="PLACE",
        help="folder or URL such as s3://bucket/prefix, with bundles of this store alone",
    )
    command.add_argument(
        "--keep",
        type=positive,
        metavar="N",
        help="remove all but the newest N bundles afterwards (default: keep all)",
    )
    command.set_defaults(run=run_snapshot)


def run_snapshot(options: argparse.Namespace) -> int:
    """Write a bundle of database and blobs to a folder or an object store. The service and its
    workers may keep running. What an earlier bundle there holds is not written again. Search
    indexes are left out, as they can be rebuilt. Exit code 1 if a blob was missing or damaged
    and could not be included. A bundle contains all frames and the hashes of keys: protect it
    like the data folder.
    """
    from sceneprint.bundle.backup import take_backup

    start = time.perf_counter()
    settings = named_database(options)
    with ended_by_signals(), record_progress("snapshot") as progress:
        bundle = take_backup(settings, options.to, progress, keep=options.keep)
    print(
        f"{one_line(options.to)}: bundle {bundle.manifest.name}, {contents(bundle)}, "
        f"{bundle.written / 1e6:,.1f} MB of it new, in {time.perf_counter() - start:.1f} s"
    )
    return 1 if name_lost(bundle, "Run `sceneprint fsck` to see what can be repaired.") else 0


def add_database_option(command: argparse.ArgumentParser) -> None:
    """`--database`."""
    command.add_argument(
        "--database",
        metavar="URL",
        help="URL such as postgresql://user@host/name (default: SCENEPRINT_DATABASE_URL, else "
        "SQLite in the data folder); put a password into that variable or PGPASSWORD",
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
            "--database: not a database URL such as postgresql://user@host/name."
        ) from None
    if shown:
        raise InvalidRequest(
            "--database: a password on the command line is visible to everybody on this "
            "machine. Set PGPASSWORD, or put the whole URL into SCENEPRINT_DATABASE_URL."
        )
    return settings.model_copy(update={"database_url": SecretStr(options.database)})


@contextmanager
def record_progress(what: str) -> Iterator[Callable[[int, int], None]]:
    """Show a bar of rows and blobs on a terminal; yield what sets how many are done, and of how
    many."""
    with tqdm(desc=what, unit="record", unit_scale=True, disable=None) as bar:

        def progress(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        yield progress


def contents(bundle: Bundle) -> str:
    """Return the content of a bundle in a few words."""
    held = bundle.manifest
    return (
        f"{held.maps} maps, {held.n_frames} frames, {held.blobs} blobs, {held.bytes / 1e6:,.1f} MB"
    )


def name_lost(bundle: Bundle, advice: str) -> bool:
    """Name on standard error the blobs that a bundle lacks; return whether there are any."""
    if not bundle.lost:
        return False
    for one in bundle.lost[:_SHOWN]:
        print(f"not in it: blob {one.digest[:12]}, {one.why}", file=sys.stderr)
    more = len(bundle.lost) - _SHOWN
    if more > 0:
        print(f"... and {more} more", file=sys.stderr)
    print(f"Everything else is included. {advice}", file=sys.stderr)
    return True


# `sceneprint restore`: a data folder of a bundle, or the store of a fleet.


def add_restore(command: argparse.ArgumentParser) -> None:
    """Add the options of `sceneprint restore`."""
    command.add_argument(
        "place",
        metavar="PLACE",
        help="folder or URL that `sceneprint snapshot` wrote to",
    )
    add_data_option(command)
    add_database_option(command)
    command.add_argument("--bundle", metavar="NAME", help="bundle to restore (default: the newest)")
    command.add_argument(
        "--verify-only",
        action="store_true",
        help="read and check the whole bundle without restoring it",
    )
    command.add_argument(
        "--list", action="store_true", help="list the bundles of the place, and restore none"
    )
    command.set_defaults(run=run_restore)


def run_restore(options: argparse.Namespace) -> int:
    """Restore a bundle to a data folder, verifying every byte. With the URL of an empty
    PostgreSQL database, its rows go there in one transaction, and its blobs to
    SCENEPRINT_BLOB_URL or else the data folder. A folder that is not empty stays untouched. A
    restore that was interrupted goes on when you run it again. Exit code 1 if the bundle lists
    blobs that were damaged when it was taken; 2 if nothing was restored.
    """
    from sceneprint.bundle import restoration

    settings, start = named_database(options), time.perf_counter()
    if options.list:
        return _list_bundles(options.place)
    place, name = options.place, options.bundle
    task = "verify" if options.verify_only else "restore"
    with ended_by_signals(), record_progress(task) as go_on:
        if options.verify_only:
            bundle, done = restoration.verify_bundle(place, name, go_on), "is complete"
        elif settings.database_url is not None:
            shown = _server(settings)
            bundle = restoration.restore_to_server(place, settings, name, go_on)
            done = f"is restored to {shown}"
        else:
            if settings.blob_url is not None:
                raise InvalidRequest(
                    "SCENEPRINT_BLOB_URL is set, but blobs are restored to the data folder, where "
                    "no service would look for them. Unset the variable, or restore into a fleet "
                    "with --database."
                )
            bundle = restoration.restore_to_folder(place, settings.data_dir, name, go_on)
            done = f"is restored to {one_line(str(settings.data_dir))}"
    seconds = time.perf_counter() - start
    print(f"{one_line(place)}: bundle {bundle.manifest.name} {done}: {contents(bundle)} "
          f"in {seconds:.1f} s")  # fmt: skip
    advice = (
        "These blobs were damaged when the bundle was taken. Run `sceneprint fsck` on the restored "
        "store to see whose they are."
    )
    return 1 if name_lost(bundle, advice) else 0


def _list_bundles(place: str) -> int:
    from sceneprint.bundle.place import BundlePlace

    there = BundlePlace.open(place)
    for name in there.names():
        held = there.read(name)
        print(f"{name}  {held.maps} maps, {held.n_frames} frames, {held.bytes / 1e6:,.1f} MB")
    return 0


def _server(settings: Settings) -> str:
    """Return the database of a fleet, to show."""
    from sceneprint.store.database import reach_database

    database = reach_database(settings.database)
    database.close()
    if database.is_sqlite:
        raise InvalidRequest(
            "SCENEPRINT_DATABASE_URL is set to SQLite, but a bundle is restored to the data "
            "folder, where no service would look for it. Unset the variable, for the service "
            "too."
        )
    return one_line(database.shown)


# `sceneprint pull`: a robot's copies of maps, to localise without network.


def add_pull(command: argparse.ArgumentParser) -> None:
    """Add the options of `sceneprint pull`."""
    command.add_argument(
        "--map", action="append", metavar="NAME", required=True, help="a map; may be repeated"
    )
    add_data_option(command)
    add_service_options(command)
    command.set_defaults(run=run_pull)


def run_pull(options: argparse.Namespace) -> int:
    """Copy maps of a service to a data folder, without uploads and keys. Only what is new is
    downloaded. A key that may read the maps suffices, and programs may use the folder meanwhile.
    """
    from sceneprint.engine.maps.map_copy import claim_folder, pull_map
    from sceneprint.store import open_store

    settings = settings_of(options)
    if settings.database_url is not None or settings.blob_url is not None:
        raise InvalidRequest(
            "SCENEPRINT_DATABASE_URL or SCENEPRINT_BLOB_URL is set, but a copy lies in its data "
            "folder. Unset them."
        )
    folder = settings.data_dir.absolute()
    claim_folder(folder)
    with ended_by_signals(), open_client(options) as client:
        store = open_store(settings.database, settings.blobs)
        try:
            for name in dict.fromkeys(options.map):
                start = time.perf_counter()
                with tqdm(desc=name, unit="frame", disable=None) as bar:

                    def progress(done: int, total: int, bar: Any = bar) -> None:
                        bar.total = total
                        bar.update(done - bar.n)

                    found = pull_map(client, store, name, progress)
                print(
                    f"{one_line(str(folder))} has map {name} of revision {found.revision}: "
                    f"{found.frames} frames, {found.written} new or changed, {found.removed} "
                    f"removed; {found.artifacts} artifacts, {found.bytes / 1e6:.1f} MB fetched in "
                    f"{time.perf_counter() - start:.1f} s"
                )
        finally:
            store.close()
    return 0


# `sceneprint reencode`: a map signed with another model, to which it then switches.

#: Seconds without a frame signed after which no worker is believed to be there.
STALL_S = 120.0
#: Seconds between two looks; longer where a look takes more than a tenth of it.
LOOK_S = 0.5


def add_reencode(command: argparse.ArgumentParser) -> None:
    """Add the options of `sceneprint reencode`."""
    command.add_argument("map", metavar="MAP")
    what = command.add_mutually_exclusive_group(required=True)
    what.add_argument("--model", metavar="MODEL", help="depth, lidar, paper, or a model file")
    what.add_argument("--status", action="store_true", help="show the progress")
    what.add_argument(
        "--cancel",
        action="store_true",
        help="keep the current model, and discard signatures of the new one",
    )
    command.add_argument("--wait", action="store_true", help="wait until the map has switched")
    add_data_option(command)
    command.set_defaults(run=run_reencode)


def run_reencode(options: argparse.Namespace) -> int:
    """Sign every frame of a map again with another model, from the stored uploads. Workers sign
    new uploads first. Queries use the current model until all frames are signed; then the map
    switches at once. Works on the data folder, also while a service runs on it. Run the same
    command again to retry failed frames.
    """
    from sceneprint.engine import Engine
    from sceneprint.engine.maps import map_lifecycle

    settings = settings_of(options)
    require_database(settings)
    with acting_as(COMMAND), Engine(settings) as engine:
        if options.model is not None:
            told = engine.reencode(options.map, options.model)
        elif options.cancel:
            told = map_lifecycle.cancel_reencoding(engine.store, options.map)
        else:
            told = engine.get_map(options.map)
        if options.wait and told.reencoding is not None:
            return _wait(engine, told)
        _print_reencoding(told)
    return 0


def _print_reencoding(told: Map) -> None:
    print(f"map {told.name}, model {told.model}")
    coming = told.reencoding
    if coming is None:
        return
    print(f"next model: {coming.model}; {coming.done} frames signed, {coming.left} waiting")
    if coming.failed:
        print(
            f"{coming.failed} frames cannot be signed with it: they will be rejected when the "
            "map switches"
        )
    if coming.dead:
        print(
            f"{coming.dead} frames failed every attempt, and the map does not switch until they "
            "are signed or deleted: see their jobs, then run this with --model again"
        )


def _wait(engine: Engine, told: Map) -> int:
    """Wait while frames are signed now and then."""
    coming = told.reencoding
    assert coming is not None
    last, since = -1, time.monotonic()
    with tqdm(desc=f"sign with {coming.model}", unit="frame", disable=None) as bar:
        while True:
            looked = time.monotonic()
            told = engine.get_map(told.name)
            took = time.monotonic() - looked
            now = told.reencoding
            if now is None or now.model_id != coming.model_id:
                break
            done = now.done + now.failed
            bar.total = done + now.left + now.dead
            bar.update(done - bar.n)
            if done != last:
                last, since = done, time.monotonic()
            if (now.dead and not now.left) or time.monotonic() - since > STALL_S:
                bar.close()
                _print_reencoding(told)
                if not now.dead:
                    stats = engine.operations.statistics.tell(minutes=1)
                    reason = waiting_reason(stats, 0 if now is None else now.left)
                    print(f"no progress for {STALL_S:.0f} s. {reason}", file=sys.stderr)
                return 2
            time.sleep(max(LOOK_S, 10 * took))
    _print_reencoding(told)
    return 0 if told.model_id == coming.model_id else 2
