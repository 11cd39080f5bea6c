"""Commands on a store: `migrate`, `fsck`, `snapshot`, `restore`, `pull` and `reencode`."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

from tqdm import tqdm

from sceneprint.atomic_files import check_writable, write_whole
from sceneprint.cli import positive, whole_number
from sceneprint.cli.options import (
    add_data_option,
    add_service_options,
    ended_by_signals,
    existing_store,
    open_client,
    open_command_store,
    settings_of,
)
from sceneprint.cli.output import one_line, print_error, progress_bar, waiting_reason
from sceneprint.errors import InvalidRequest
from sceneprint.process import COMMAND, acting_as

if TYPE_CHECKING:
    from sceneprint.bundle.backup import Bundle
    from sceneprint.engine.context import Context
    from sceneprint.maintenance.fsck.findings import Finding
    from sceneprint.settings import Settings
    from sceneprint.store import Database
    from sceneprint_client.api import Map

#: Names of the counts of fsck, in the order of its output.
_COUNTED = ("models", "frames", "signatures", "blobs", "files", "indexes")


def add_migrate(command: argparse.ArgumentParser) -> None:
    """Add the options of `sceneprint migrate`."""
    add_data_option(command)
    command.add_argument(
        "--check", action="store_true",
        help="change nothing; the exit code is 1 if the schema must be created or upgraded first",
    )  # fmt: skip
    command.set_defaults(run=run_migrate)


def run_migrate(options: argparse.Namespace) -> int:
    """Create or upgrade the schema of a data folder or of DATABASE_URL in one transaction, and
    print the revisions. `serve` and `work` do this automatically at their start; this command is a
    separate step for deployments. A schema that is up to date is not changed. The exit code is 2 if
    a later version wrote the database, or if it is not reachable.
    """
    from sceneprint.store.database import database_exists, reach_database

    settings = settings_of(options)
    database = reach_database(settings.database)
    try:
        before, usable = (
            _revisions(database) if database_exists(settings.database) else (None, False)
        )
        shown = f"{database.shown}: schema {before or 'none'}"
        if options.check:
            print(shown if usable else f"{shown}; run `sceneprint migrate`")
            return 0 if usable else 1
        with open_command_store(settings):  # opening it migrates the schema
            pass
        after, _ = _revisions(database)
    finally:
        database.close()
    print(shown if before == after else f"{shown} -> {after}")
    return 0


def _revisions(database: Database) -> tuple[str | None, bool]:
    """Return the schema revision of a store, and whether this version can use it unchanged."""
    from sceneprint.store.database import current_revision, known_revisions, revision_of

    with database.read() as connection:
        return revision_of(connection), current_revision(connection) == known_revisions()[0]


def add_fsck(command: argparse.ArgumentParser) -> None:
    """Add the options of `sceneprint fsck`."""
    add_data_option(command)
    command.add_argument("--map", metavar="MAP", help="check only this map")
    how = command.add_mutually_exclusive_group()
    how.add_argument(
        "--repair", action="store_true",
        help="repair what can be repaired; damaged files move to `quarantine` in the data folder",
    )  # fmt: skip
    how.add_argument(
        "--quick", action="store_true",
        help="check that files exist, without reading their contents",
    )  # fmt: skip
    how.add_argument(
        "--purge", action="store_true",
        help="do not check anything; erase all data of deleted frames on this node now, without "
        "waiting for SCENEPRINT_PURGE_DEADLINE_S; their deletion can no longer be undone",
    )  # fmt: skip
    command.add_argument(
        "--grace", type=whole_number, metavar="SECONDS",
        help="keep unreferenced files that changed within this time (default: 3600)",
    )  # fmt: skip
    command.add_argument(
        "--json", type=Path, metavar="FILE", help="also write the findings to this file"
    )
    command.set_defaults(run=run_fsck)


def run_fsck(options: argparse.Namespace) -> int:
    """Check rows, signatures, blobs and indexes of a data folder; report problems and what --repair
    would do. Without --repair nothing is changed. The service may be running. The exit code is 1 if
    problems remain, and 2 if the folder cannot be checked.
    """
    from sceneprint.engine.admin.operations import Audit
    from sceneprint.maintenance.fsck.check import fsck
    from sceneprint.maintenance.fsck.findings import GRACE_S

    if options.purge:
        return _purge(options)
    if options.json is not None:
        check_writable(options.json)
    counts, findings = Counter[str](), []
    with acting_as(COMMAND), ended_by_signals(), tqdm(disable=None, leave=False) as bar:

        def progress(subject: str, done: int, total: int) -> None:
            if bar.disable:
                return
            if bar.desc != f"{subject}: ":
                bar.reset(total)
                bar.set_description(subject)
            bar.total, bar.n = total, done
            bar.refresh()

        for finding in fsck(
            settings_of(options), map_name=options.map, repair=options.repair,
            quick=options.quick, progress=progress, counts=counts,
            grace_s=GRACE_S if options.grace is None else min(options.grace, 10**10),
        ):  # fmt: skip
            findings.append(finding)
            tqdm.write(_line(finding))
    repaired = sum(each.done is not None for each in findings)
    if repaired:
        days = settings_of(options).audit_log_days
        with acting_as(COMMAND), open_command_store(settings_of(options)) as store:
            Audit(store, days).record("store.repaired", options.map, repaired=repaired)
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
    damaged, unneeded = kinds["damage"], kinds["leftover"]
    unrepaired = sum(each.left for each in findings)
    if not damaged and not unneeded:
        return "no problems found"
    counts = f"{damaged} damaged, {unneeded} left over"
    if repair:
        done = f"{damaged + unneeded - unrepaired} repaired, {unrepaired} not"
        return f"{counts}: {done}. Run it again once workers have signed the queued frames."
    possible = sum(each.repair is not None for each in findings)
    return f"{counts}; nothing was changed: `sceneprint fsck --repair` can repair {possible}"


def _record(finding: Finding) -> dict[str, object]:
    names = ("kind", "severity", "what", "means", "would", "map", "frame_id", "done", "error")
    path = None if finding.path is None else str(finding.path)
    return {name: getattr(finding, name) for name in names} | {"path": path}


def _purge(options: argparse.Namespace) -> int:
    """Purge deleted frames; return 1 if the write-ahead log could not be emptied."""
    from sceneprint.engine.context import open_context
    from sceneprint.engine.upkeep.index_upkeep import Upkeep
    from sceneprint.engine.upkeep.purge import Purging

    if not options.map is options.grace is options.json is None:
        raise InvalidRequest("--purge checks nothing. Use it only with --data.")
    with open_context(existing_store(options)) as context:
        purged = Purging(context, Upkeep(context)).now()
        print(
            f"purged {purged.blobs} blobs, {purged.answers} stored answers, "
            f"{purged.products} products; rebuilt {purged.indexes} indexes"
        )
        if not context.store.database.shrink_log():
            print("the database log is in use: run this again when no process reads the database")
            return 1
    return 0


# `sceneprint snapshot` and `restore`.

#: Maximum number of damaged blobs to print.
_SHOWN = 10


def add_snapshot(command: argparse.ArgumentParser) -> None:
    """Add the options of `sceneprint snapshot`."""
    _add_database_options(command)
    command.add_argument(
        "--to", required=True, metavar="PLACE",
        help="folder or URL such as s3://bucket/prefix, for bundles of this store only",
    )  # fmt: skip
    command.add_argument(
        "--keep", type=positive, metavar="N",
        help="delete all but the newest N bundles afterwards (default: keep all)",
    )  # fmt: skip
    command.set_defaults(run=run_snapshot)


def run_snapshot(options: argparse.Namespace) -> int:
    """Write a bundle of database and blobs to a folder or an object store. The service and its
    workers may keep running. Blobs of earlier bundles are not written again. Search indexes are not
    included, because they can be rebuilt. The exit code is 1 if a blob was missing or damaged. A
    bundle contains all frames and the hashes of keys: protect it like the data folder.
    """
    from sceneprint.bundle.backup import take_backup

    start = time.perf_counter()
    settings = _named_database(options)
    with ended_by_signals(), progress_bar("snapshot", "record", unit_scale=True) as progress:
        bundle = take_backup(settings, options.to, progress, keep=options.keep)
    print(
        f"{one_line(options.to)}: bundle {bundle.manifest.name}, {_contents(bundle)}, "
        f"{bundle.written / 1e6:,.1f} MB of it new, in {time.perf_counter() - start:.1f} s"
    )
    return _report_lost(bundle, "Run `sceneprint fsck` to see what can be repaired.")


def _add_database_options(command: argparse.ArgumentParser) -> None:
    add_data_option(command)
    command.add_argument(
        "--database", metavar="URL",
        help="URL such as postgresql://user@host/name (default: SCENEPRINT_DATABASE_URL, else "
        "SQLite in the data folder); put a password into that variable or into PGPASSWORD",
    )  # fmt: skip


def _named_database(options: argparse.Namespace) -> Settings:
    """Return the settings of the environment, with the database in `--database` if present.

    Raise InvalidRequest if the URL is not valid, or contains a password, which all users of the
    machine could see.
    """
    from pydantic import SecretStr
    from sqlalchemy import make_url
    from sqlalchemy.exc import ArgumentError

    settings = settings_of(options)
    if options.database is None:
        return settings
    try:
        url = make_url(options.database)
    except (ArgumentError, ValueError):
        raise InvalidRequest(
            "--database is not a database URL such as postgresql://user@host/name."
        ) from None
    if url.password is not None or "password" in url.query:
        raise InvalidRequest(
            "--database: a password on the command line is visible to all users of this machine. "
            "Set PGPASSWORD, or put the whole URL into SCENEPRINT_DATABASE_URL."
        )
    return settings.model_copy(update={"database_url": SecretStr(options.database)})


def _contents(bundle: Bundle) -> str:
    manifest = bundle.manifest
    return (
        f"{manifest.maps} maps, {manifest.n_frames} frames, {manifest.blobs} blobs, "
        f"{manifest.bytes / 1e6:,.1f} MB"
    )


def _report_lost(bundle: Bundle, advice: str) -> int:
    """Print the missing blobs of a bundle on standard error; return 1 if there are any."""
    if not bundle.lost:
        return 0
    for blob in bundle.lost[:_SHOWN]:
        print_error(f"missing: blob {blob.digest[:12]}, {blob.why}")
    if len(bundle.lost) > _SHOWN:
        print_error(f"... and {len(bundle.lost) - _SHOWN} more")
    print_error(f"Everything else is included. {advice}")
    return 1


def add_restore(command: argparse.ArgumentParser) -> None:
    """Add the options of `sceneprint restore`."""
    command.add_argument(
        "place", metavar="PLACE", help="folder or URL that `sceneprint snapshot` wrote to"
    )
    _add_database_options(command)
    command.add_argument("--bundle", metavar="NAME", help="bundle to restore (default: newest)")
    command.add_argument(
        "--verify-only", action="store_true",
        help="verify the whole bundle without restoring it",
    )  # fmt: skip
    command.add_argument(
        "--list", action="store_true", help="list the bundles of the place without restoring any"
    )
    command.add_argument(
        "--keys", choices=("keep", "revoke"),
        help="keep the keys of the bundle, which revives keys that were revoked since, or revoke "
        "all of them (default: ask in a terminal, otherwise keep and list them)",
    )  # fmt: skip
    command.set_defaults(run=run_restore)


def run_restore(options: argparse.Namespace) -> int:
    """Restore a bundle to a data folder and verify every byte. With the URL of an empty PostgreSQL
    database, rows are restored to it in one transaction, and blobs to SCENEPRINT_BLOB_URL or else
    the data folder. A folder that is not empty stays untouched. After an interruption, run the
    command again to continue. The exit code is 1 if blobs were already damaged when the bundle was
    taken, and 2 if nothing was restored.
    """
    from sceneprint.bundle import restoration

    settings, start = _named_database(options), time.perf_counter()
    if options.list:
        return _list_bundles(options.place)
    place, name = options.place, options.bundle
    task = "verify" if options.verify_only else "restore"
    to_server = settings.database_url is not None and not options.verify_only
    shown = _server(settings) if to_server else ""
    keys = [] if options.verify_only else restoration.list_bundle_keys(place, name)
    keep = _keep_keys(options.keys, keys)
    with ended_by_signals(), progress_bar(task, "record", unit_scale=True) as progress:
        if options.verify_only:
            bundle, done = restoration.verify_bundle(place, name, progress), "is complete"
        elif to_server:
            bundle = restoration.restore_to_server(place, settings, name, progress, keep_keys=keep)
            done = f"is restored to {shown}"
        else:
            if settings.blob_url is not None:
                raise InvalidRequest(
                    "SCENEPRINT_BLOB_URL is set, but this command restores blobs to the data "
                    "folder, where a service would not find them. Unset the variable, or restore "
                    "into a fleet with --database."
                )
            bundle = restoration.restore_to_folder(
                place, settings.data_dir, name, progress, keep_keys=keep
            )
            done = f"is restored to {one_line(str(settings.data_dir))}"
    seconds = time.perf_counter() - start
    print(f"{one_line(place)}: bundle {bundle.manifest.name} {done}: {_contents(bundle)} "
          f"in {seconds:.1f} s")  # fmt: skip
    if keys:
        print(
            f"Keys that work again: {_key_list(keys)}. They include any key that was revoked "
            "after the bundle was taken. Revoke such a key again with `sceneprint keys --revoke "
            "NAME`."
            if keep
            else f"Revoked keys: {_key_list(keys)}. Create others with `sceneprint keys --create`."
        )
    advice = (
        "These blobs were damaged when the bundle was taken. Run `sceneprint fsck` on the restored "
        "store to list the affected frames."
    )
    return _report_lost(bundle, advice)


def _keep_keys(choice: str | None, keys: list[str]) -> bool:
    """Return whether to keep restored keys, as the option states.

    Without the option, ask in a terminal; elsewhere, keep the keys.
    """
    if choice is not None or not keys or not sys.stdin.isatty():
        return choice != "revoke"
    print(
        f"The bundle has keys: {_key_list(keys)}. Keys that were revoked since then work again too."
    )
    return input("Keep these keys? [y/N] ").strip().lower() in ("y", "yes")


def _key_list(keys: list[str]) -> str:
    more = "" if len(keys) <= 20 else f" and {len(keys) - 20} more"
    return one_line(", ".join(keys[:20])) + more


def _list_bundles(name: str) -> int:
    from sceneprint.bundle.place import BundlePlace

    place = BundlePlace.open(name)
    for bundle in place.names():
        manifest = place.read(bundle)
        size = f"{manifest.bytes / 1e6:,.1f} MB"
        print(f"{bundle}  {manifest.maps} maps, {manifest.n_frames} frames, {size}")
    return 0


def _server(settings: Settings) -> str:
    """Return the URL of the PostgreSQL database; raise InvalidRequest for SQLite."""
    from sceneprint.store.database import reach_database

    database = reach_database(settings.database)
    database.close()
    if database.is_sqlite:
        raise InvalidRequest(
            "SCENEPRINT_DATABASE_URL is set to SQLite, but this command restores to the data "
            "folder, where a service would not find the bundle. Unset the variable for this "
            "command and for the service."
        )
    return one_line(database.shown)


# `sceneprint pull`.


def add_pull(command: argparse.ArgumentParser) -> None:
    """Add the options of `sceneprint pull`."""
    command.add_argument(
        "--map", action="append", metavar="NAME", required=True, help="name of a map; repeatable"
    )
    add_data_option(command)
    add_service_options(command)
    command.set_defaults(run=run_pull)


def run_pull(options: argparse.Namespace) -> int:
    """Copy maps of a service to a data folder, without uploads and keys, or update the copies: only
    new data is downloaded, and frames that the service has deleted are removed. The key must have
    `read` for the maps. Programs may use the folder in the meantime.
    """
    from sceneprint.engine.maps.map_copy import claim_folder, pull_map
    from sceneprint.store import open_store

    settings = settings_of(options)
    if settings.database_url is not None or settings.blob_url is not None:
        raise InvalidRequest(
            "SCENEPRINT_DATABASE_URL or SCENEPRINT_BLOB_URL is set, but `pull` writes to a data "
            "folder only. Unset them."
        )
    folder = settings.data_dir.absolute()
    claim_folder(folder)
    with ended_by_signals(), open_client(options) as client:
        store = open_store(settings.database, settings.blobs)
        try:
            for name in dict.fromkeys(options.map):
                start = time.perf_counter()
                with progress_bar(name) as progress:
                    pulled = pull_map(client, store, name, progress)
                print(
                    f"{one_line(str(folder))} has map {name} of revision {pulled.revision}: "
                    f"{pulled.frames} frames, {pulled.written} new or changed, {pulled.removed} "
                    f"removed; {pulled.artifacts} artifacts, {pulled.bytes / 1e6:.1f} MB fetched "
                    f"in {time.perf_counter() - start:.1f} s"
                )
        finally:
            store.close()
    return 0


# `sceneprint reencode`.

#: Seconds without a signed frame after which the command gives up.
STALL_S = 120.0
#: Minimum seconds between progress checks, which take at most a tenth of the time.
LOOK_S = 0.5


def add_reencode(command: argparse.ArgumentParser) -> None:
    """Add the options of `sceneprint reencode`."""
    command.add_argument("map", metavar="MAP")
    what = command.add_mutually_exclusive_group(required=True)
    what.add_argument("--model", metavar="MODEL", help="depth, lidar, paper, or a model file")
    what.add_argument("--status", action="store_true", help="show the progress")
    what.add_argument(
        "--cancel", action="store_true",
        help="keep the current model, and delete signatures of the new one",
    )  # fmt: skip
    command.add_argument("--wait", action="store_true", help="wait until the map has switched")
    add_data_option(command)
    command.set_defaults(run=run_reencode)


def run_reencode(options: argparse.Namespace) -> int:
    """Sign all frames of a map with another model, from the stored uploads. Workers sign new
    uploads first. Queries use the current model until all frames are signed; then the map switches
    at once. The command works on the data folder, even while a service runs on it. Run it again to
    retry failed frames.
    """
    from sceneprint.engine.context import open_context
    from sceneprint.engine.maps import map_lifecycle

    with acting_as(COMMAND), open_context(existing_store(options)) as context:
        store = context.store
        if options.model is not None:
            now = map_lifecycle.begin_reencoding(store, context.bell, options.map, options.model)
        elif options.cancel:
            now = map_lifecycle.cancel_reencoding(store, options.map)
        else:
            now = map_lifecycle.get_map(store, options.map)
        if options.wait and now.reencoding is not None:
            return _wait(context, now)
        _print_reencoding(now)
    return 0


def _print_reencoding(record: Map) -> None:
    print(f"map {record.name}, model {record.model}")
    coming = record.reencoding
    if coming is None:
        return
    print(f"next model: {coming.model}; {coming.done} frames signed, {coming.left} waiting")
    if coming.failed:
        print(
            f"{coming.failed} frames cannot be signed with it and will be rejected when the map "
            "switches"
        )
    if coming.dead:
        print(
            f"{coming.dead} frames failed in every attempt, and the map does not switch until they "
            "are signed or deleted: read their jobs, then run this with --model again"
        )


def _wait(context: Context, record: Map) -> int:
    """Wait until a map has switched its model, and print its state; return 2 if it did not switch.

    Stop after STALL_S seconds without progress, or if only jobs that failed permanently remain.
    """
    from sceneprint.engine.admin.statistics import Statistics
    from sceneprint.engine.maps.map_lifecycle import get_map

    coming = record.reencoding
    assert coming is not None
    last, since = -1, time.monotonic()
    with progress_bar(f"sign with {coming.model}") as progress:
        while True:
            looked = time.monotonic()
            record = get_map(context.store, record.name)
            took = time.monotonic() - looked
            now = record.reencoding
            if now is None or now.model_id != coming.model_id:
                break
            done = now.done + now.failed
            progress(done, done + now.left + now.dead)
            if done != last:
                last, since = done, time.monotonic()
            stalled = time.monotonic() - since > STALL_S
            if stalled or (now.dead and not now.left):
                break
            time.sleep(max(LOOK_S, 10 * took))
    _print_reencoding(record)
    if now is not None and now.model_id == coming.model_id and not now.dead:
        stats = Statistics(context).collect(minutes=1)
        reason = waiting_reason(stats, now.left)
        print_error(f"no progress for {STALL_S:.0f} s. {reason}")
    return 0 if record.model_id == coming.model_id else 2
