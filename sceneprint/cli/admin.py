"""`sceneprint keys` and `audit`: keys, tenants and the audit log."""

from __future__ import annotations

import argparse
import socket
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING

from sceneprint.cli import duration, whole_number
from sceneprint.cli.options import (
    add_data_option,
    existing_store,
    open_command_store,
    settings_of,
)
from sceneprint.cli.output import count_of, one_line, print_error
from sceneprint.errors import InvalidRequest
from sceneprint.process import COMMAND, acting_as
from sceneprint_client.api.admin import EVERY, SCOPES

if TYPE_CHECKING:
    from sceneprint.engine.admin.operations import Audit
    from sceneprint.store import Store
    from sceneprint.store.audit_log import AuditFilter
    from sceneprint_client.api.admin import AuditLine, Key, MadeKey, Scope

#: The list of keys warns about keys that expire within this time.
SOON = timedelta(days=7)


def add_keys(command: argparse.ArgumentParser) -> None:
    """Add the options of `sceneprint keys`."""
    what = command.add_mutually_exclusive_group(required=True)
    what.add_argument("--create", metavar="NAME", help="create a key and print its secret")
    what.add_argument(
        "--list", action="store_true",
        help="list keys with their creation time, name, scope, tenant, expiry and last use",
    )  # fmt: skip
    what.add_argument(
        "--rotate", metavar="NAME",
        help="replace the secret of a key and print it; the old secret still works for --overlap",
    )  # fmt: skip
    what.add_argument("--revoke", metavar="NAME", help="revoke a key")
    what.add_argument("--create-tenant", metavar="NAME", help="create a tenant without keys")
    what.add_argument(
        "--list-tenants", action="store_true",
        help="list tenants with their creation time, name and number of keys",
    )  # fmt: skip
    what.add_argument("--delete-tenant", metavar="NAME", help="delete a tenant that has no key")
    command.add_argument("--scope", choices=SCOPES, help="scope of the new key (default: admin)")
    command.add_argument(
        "--map", action="append", metavar="MAP",
        help="map for which the key is valid; repeatable (default: all maps and everything outside "
        "of maps)",
    )  # fmt: skip
    command.add_argument(
        "--tenant", metavar="TENANT",
        help="tenant of the new key (default: a tenant with the name of the key)",
    )  # fmt: skip
    command.add_argument(
        "--expires", type=duration, metavar="TIME",
        help="lifetime of the key, such as 12h, 30d or 8w (default: no expiry)",
    )  # fmt: skip
    command.add_argument(
        "--overlap", metavar="TIME",
        type=lambda text: timedelta() if text == "0" else duration(text),
        help="time for which the old secret still works, such as 30m or 7d, up to 30d; 0 ends it "
             "at once (default: 1h)",
    )  # fmt: skip
    add_data_option(command)
    command.set_defaults(run=run_keys)


def run_keys(options: argparse.Namespace) -> int:
    """Create, list, rotate or revoke API keys, and manage their tenants. A service requires keys if
    it listens beyond its own machine. The secret of a key is printed once; only its hash is stored.
    All keys of a tenant share its limits, and tenants take turns at the workers.
    """
    from sceneprint.engine.admin.operations import (
        create_key,
        create_tenant,
        delete_tenant,
        revoke_key,
        rotate_key,
    )

    own = ("scope", "map", "tenant", "expires")
    foreign = [name for name in own if getattr(options, name) is not None]
    if foreign and options.create is None:
        raise InvalidRequest(f"--{foreign[0]} applies only to a new key. Use it with --create.")
    if options.overlap is not None and options.rotate is None:
        raise InvalidRequest("--overlap applies only to a rotation. Use it with --rotate.")
    with acting_as(COMMAND), open_command_store(settings_of(options)) as store:
        if options.list:
            _print_keys(store)
        elif options.rotate is not None:
            overlap = timedelta(hours=1) if options.overlap is None else options.overlap
            key = rotate_key(store, options.rotate, overlap.total_seconds())
            _print_secret(key)
            if key.previous_until is not None:
                print_error(f"the old secret works until {key.previous_until:%Y-%m-%dT%H:%M:%SZ}")
        elif options.revoke is not None:
            revoke_key(store, options.revoke)
            print(f"key {one_line(options.revoke)} is revoked")
        elif options.list_tenants:
            from sceneprint.store.tenants import list_tenants

            with store.database.read() as connection:
                tenants = list_tenants(connection)
            for row in tenants:
                at = datetime.fromtimestamp(row.created_at, UTC)
                print(f"{at:%Y-%m-%dT%H:%M:%SZ}  {one_line(row.name)}  {count_of(row.keys, 'key')}")
        elif options.delete_tenant is not None:
            delete_tenant(store, options.delete_tenant)
            print(f"tenant {one_line(options.delete_tenant)} is deleted")
        elif options.create_tenant is not None:
            create_tenant(store, options.create_tenant)
            print(f"tenant {one_line(options.create_tenant)} is created")
        else:
            scope: Scope = options.scope or "admin"
            grants = dict.fromkeys(options.map or [EVERY], scope)
            until = None if options.expires is None else datetime.now(UTC) + options.expires
            _print_secret(create_key(store, options.create, grants, until, options.tenant))
    return 0


def _print_secret(key: MadeKey) -> None:
    print(key.secret)
    print_error("save this secret now: it is not stored and cannot be shown again")


def _print_keys(store: Store) -> None:
    """Print all keys, and a warning about keys that expire soon."""
    from sceneprint.engine.admin.operations import list_keys

    now, cursor, soon = datetime.now(UTC), None, []
    while True:
        page = list_keys(store, cursor, 1000)
        for key in page.items:
            print(_key_line(key))
            if key.expires_at is not None and now < key.expires_at <= now + SOON:
                soon.append(one_line(key.name))
        cursor = page.next_cursor
        if cursor is None:
            break
    if soon:
        names = ", ".join(soon)
        print_error(f"expiring within {SOON.days} days: {names}. Create new keys with --create.")


def _key_line(key: Key) -> str:
    grants = ", ".join(
        f"{scope} of {'all' if name == EVERY else name}" for name, scope in key.grants.items()
    )
    text = f"{key.created_at:%Y-%m-%dT%H:%M:%SZ}  {one_line(key.name)}  {grants}"
    if key.tenant != key.name:
        text += f", tenant {one_line(key.tenant)}"
    if key.expires_at is not None:
        ends = "expired" if key.expires_at <= datetime.now(UTC) else "until"
        text += f", {ends} {key.expires_at:%Y-%m-%dT%H:%M:%SZ}"
    if key.previous_until is not None:
        text += f", old secret until {key.previous_until:%Y-%m-%dT%H:%M:%SZ}"
    if key.last_used_at is not None:
        text += f", used {key.last_used_at:%Y-%m-%dT%H:%MZ}"
    return text


# `sceneprint audit`.

#: Syslog priority (RFC 5424) of the facility `log audit` and the severity `notice`.
_PRIORITY = 13 * 8 + 5


def add_audit(command: argparse.ArgumentParser) -> None:
    """Add the options of `sceneprint audit`."""
    command.add_argument(
        "--actor", metavar="NAME",
        help="only entries of this key, or `command` for the command line",
    )  # fmt: skip
    command.add_argument("--map", metavar="MAP", help="only entries about this map")
    command.add_argument(
        "--action",
        metavar="TEXT",
        help="only actions with this prefix, such as `key.` or `refused`",
    )
    command.add_argument(
        "--since", type=duration, metavar="DURATION", help="only entries of the last 12h, 30d or 8w"
    )
    command.add_argument(
        "--limit", type=whole_number, default=100, metavar="N",
        help="maximum number of entries to print without --format (default: 100)",
    )  # fmt: skip
    command.add_argument(
        "--format", choices=tuple(_FORMATS),
        help="export as JSON lines, or as syslog messages (RFC 5424), one per line",
    )  # fmt: skip
    command.add_argument(
        "--output", type=Path, metavar="FILE",
        help="with --format: append to this file (default: standard output)",
    )  # fmt: skip
    add_data_option(command)
    command.set_defaults(run=run_audit)


def run_audit(options: argparse.Namespace) -> int:
    """Print the newest entries of the audit log, newest first. Each entry names the key, its
    address, and the change or the refused request. With --format, export all entries, oldest
    first.
    """
    from sceneprint.engine.admin.operations import Audit
    from sceneprint.store.audit_log import AuditFilter

    if options.output is not None and options.format is None:
        raise InvalidRequest("--output requires --format. Specify jsonl or syslog.")
    since = None if options.since is None else time.time() - options.since.total_seconds()
    audit_filter = AuditFilter(options.actor, options.map, options.action, since)
    settings = existing_store(options)
    with open_command_store(settings) as store:
        audit = Audit(store, settings.audit_log_days)
        if options.format is None:
            for line in _newest(audit, audit_filter, options.limit):
                print(_audit_line(line))
            return 0
        target = options.output
        with nullcontext(sys.stdout) if target is None else target.open("a") as file:
            for line in audit.lines(audit_filter):
                print(_FORMATS[options.format](line), file=file)
    return 0


def _newest(audit: Audit, audit_filter: AuditFilter, limit: int) -> Iterator[AuditLine]:
    cursor = None
    while limit > 0:
        page = audit.page(audit_filter, cursor, min(limit, 1000))
        yield from page.items
        cursor, limit = page.next_cursor, limit - len(page.items)
        if cursor is None:
            return


def _audit_line(line: AuditLine) -> str:
    who = "no key" if line.actor is None else line.actor
    origin = "" if line.address is None else f" from {line.address}"
    operation = line.data.get("operation") if line.action == "refused" else None
    what = " ".join(part for part in (line.action, operation, line.map, line.target) if part)
    return one_line(f"{line.at:%Y-%m-%dT%H:%M:%SZ}  {who}{origin}  {what}")


def _syslog_message(line: AuditLine) -> str:
    """Convert an audit line to a syslog message (RFC 5424), which contains the line as JSON."""
    at = line.at.astimezone(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
    host = socket.gethostname() or "-"
    return f"<{_PRIORITY}>1 {at} {host} sceneprint - audit - {line.model_dump_json()}"


_FORMATS: dict[str, Callable[[AuditLine], str]] = {
    "jsonl": lambda line: line.model_dump_json(),
    "syslog": _syslog_message,
}
