"""`sceneprint keys` and `tenants`: who may use a service, and who pays."""

from __future__ import annotations

import argparse
import sys
from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING

from sceneprint.cli import duration
from sceneprint.cli.options import one_line
from sceneprint.cli.serve import add_data_option, settings_of
from sceneprint.process import COMMAND, acting_as
from sceneprint_client.api.admin import EVERY, SCOPES

if TYPE_CHECKING:
    from sceneprint.engine import Engine
    from sceneprint_client.api.admin import Key, MadeKey, Scope

#: How long before the end of a key it is told of.
SOON = timedelta(days=7)


def add_keys(command: argparse.ArgumentParser) -> None:
    """Add the options of `sceneprint keys`."""
    what = command.add_mutually_exclusive_group(required=True)
    what.add_argument("--create", metavar="NAME", help="create a key and print its secret")
    what.add_argument(
        "--list",
        action="store_true",
        help="list keys with their creation time, name, scope, tenant, expiry and last use",
    )
    what.add_argument(
        "--rotate",
        metavar="NAME",
        help="give a key a new secret and print it; the old one works for a while longer",
    )
    what.add_argument("--revoke", metavar="NAME", help="revoke a key")
    command.add_argument("--scope", choices=SCOPES, help="scope of the new key (default: admin)")
    command.add_argument(
        "--map",
        action="append",
        metavar="MAP",
        help=(
            "map that the key is valid for; repeatable (default: all maps and everything "
            "outside of maps)"
        ),
    )
    command.add_argument(
        "--tenant",
        metavar="TENANT",
        help="tenant that the new key belongs to (default: one with the name of the key)",
    )
    command.add_argument(
        "--expires",
        type=duration,
        metavar="TIME",
        help="lifetime of the key, such as 12h, 30d or 8w (default: no expiry)",
    )
    command.add_argument(
        "--overlap",
        type=lambda text: timedelta() if text == "0" else duration(text),
        metavar="TIME",
        help="how long the old secret still works, such as 30m or 7d, up to 30d; 0 ends it at once "
        "(default: 1h)",
    )
    add_data_option(command)
    command.set_defaults(run=run_keys)


def run_keys(options: argparse.Namespace) -> int:
    """Create, list, rotate or revoke API keys. A service needs them once it listens beyond its
    own machine. The secret of a key is printed once; only its hash is stored.
    """
    from sceneprint.engine import Engine
    from sceneprint.errors import InvalidRequest

    own = ("scope", "map", "tenant", "expires")
    given = [name for name in own if getattr(options, name) is not None]
    if given and options.create is None:
        raise InvalidRequest(f"--{given[0]} applies to a new key only. Use it with --create.")
    if options.overlap is not None and options.rotate is None:
        raise InvalidRequest("--overlap applies to a rotation only. Use it with --rotate.")
    with acting_as(COMMAND), Engine(settings_of(options)) as engine:
        if options.list:
            _print_keys(engine)
        elif options.rotate is not None:
            overlap = timedelta(hours=1) if options.overlap is None else options.overlap
            made = engine.rotate_key(options.rotate, overlap.total_seconds())
            _print_secret(made)
            if made.previous_until is not None:
                ends = f"{made.previous_until:%Y-%m-%dT%H:%M:%SZ}"
                print(f"the old secret works until {ends}", file=sys.stderr)
        elif options.revoke is not None:
            engine.revoke_key(options.revoke)
            print(f"key {one_line(options.revoke)} is revoked")
        else:
            scope: Scope = options.scope or "admin"
            grants = dict.fromkeys(options.map or [EVERY], scope)
            until = None if options.expires is None else datetime.now(UTC) + options.expires
            made = engine.create_key(options.create, grants, until, options.tenant)
            _print_secret(made)
    return 0


def _print_secret(made: MadeKey) -> None:
    print(made.secret)
    print("save this secret now: it is not stored and cannot be shown again", file=sys.stderr)


def _print_keys(engine: Engine) -> None:
    """All keys, and below which of them end soon."""
    from sceneprint.engine.admin.operations import list_keys

    now, cursor, soon = datetime.now(UTC), None, []
    while True:
        page = list_keys(engine.store, cursor, 1000)
        for key in page.items:
            print(_key_line(key))
            if key.expires_at is not None and now < key.expires_at <= now + SOON:
                soon.append(one_line(key.name))
        cursor = page.next_cursor
        if cursor is None:
            break
    if soon:
        print(
            f"expiring within {SOON.days} days: {', '.join(soon)}. Create keys in their place with "
            "--create.",
            file=sys.stderr,
        )


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


# `sceneprint tenants`: whom keys belong to.


def add_tenants(command: argparse.ArgumentParser) -> None:
    """Add the options of `sceneprint tenants`."""
    what = command.add_mutually_exclusive_group(required=True)
    what.add_argument("--create", metavar="NAME", help="create a tenant without keys")
    what.add_argument(
        "--list",
        action="store_true",
        help="list tenants with their creation time, name and number of keys",
    )
    what.add_argument("--delete", metavar="NAME", help="delete a tenant that has no key")
    add_data_option(command)
    command.set_defaults(run=run_tenants)


def run_tenants(options: argparse.Namespace) -> int:
    """Create, list or delete tenants. What the keys of a tenant ask at once and per second is
    counted together, and tenants take turns at the workers. A key that is created without
    --tenant belongs to a tenant of its own name.
    """
    from sceneprint.engine import Engine
    from sceneprint.engine.admin.operations import create_tenant, delete_tenant
    from sceneprint.store.tenants import list_tenants

    with acting_as(COMMAND), Engine(settings_of(options)) as engine:
        if options.list:
            with engine.store.database.read() as connection:
                found = list_tenants(connection)
            for one in found:
                at = datetime.fromtimestamp(one.created_at, UTC)
                count = f"{one.keys} key{'s' * (one.keys != 1)}"
                print(f"{at:%Y-%m-%dT%H:%M:%SZ}  {one_line(one.name)}  {count}")
        elif options.delete is not None:
            delete_tenant(engine.store, options.delete)
            print(f"tenant {one_line(options.delete)} is deleted")
        else:
            create_tenant(engine.store, options.create)
            print(f"tenant {one_line(options.create)} is created")
    return 0
