"""`sceneprint keys`: keys for a service that listens beyond its own machine."""

from __future__ import annotations

import argparse
import re
import sys
from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING, Any

from sceneprint.cli.connection import one_line
from sceneprint.cli.serve import add_data_option, settings_of
from sceneprint.schemas.keys import EVERY, SCOPES

if TYPE_CHECKING:
    from sceneprint.schemas.keys import Key, Scope

_SECONDS = {"m": 60, "h": 3600, "d": 86400, "w": 7 * 86400}


def add_to(commands: Any) -> None:
    """Describe the command to the parser."""
    command = commands.add_parser(
        "keys",
        help="make, list and revoke keys of a service that listens beyond its own machine",
        description="Make, list or revoke keys. The secret of a key is printed once, when it is "
        "made, and stored nowhere, only its hash is.",
    )
    what = command.add_mutually_exclusive_group(required=True)
    what.add_argument("--create", metavar="NAME", help="make a key, and print its secret")
    what.add_argument(
        "--list",
        action="store_true",
        help="print when each was made, its name, what it may do and until when",
    )
    what.add_argument("--revoke", metavar="NAME", help="let a key open nothing any more")
    command.add_argument("--scope", choices=SCOPES, help="what the new key may do (default: admin)")
    command.add_argument(
        "--map",
        action="append",
        metavar="MAP",
        help="for which map; more than once for several (default: all, and what is of none)",
    )
    command.add_argument(
        "--expires",
        type=_duration,
        metavar="TIME",
        help="after which it opens nothing, such as 12h, 30d or 8w (default: never)",
    )
    add_data_option(command)
    command.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Do what was asked for with the keys of the data folder."""
    from sceneprint.engine import Engine
    from sceneprint.errors import InvalidRequest

    given = [name for name in ("scope", "map", "expires") if getattr(options, name) is not None]
    if given and options.create is None:
        raise InvalidRequest(
            f"--{given[0]} says what a new key may do, and none is made. Give it with --create."
        )
    with Engine(settings_of(options)) as engine:
        if options.list:
            cursor = None
            while True:
                page = engine.list_keys(cursor, 1000)
                for key in page.items:
                    print(_line(key))
                cursor = page.next_cursor
                if cursor is None:
                    break
        elif options.revoke is not None:
            engine.revoke_key(options.revoke)
            engine.audit.command("keys --revoke", target=options.revoke)
            print(f"key {one_line(options.revoke)} is revoked")
        else:
            scope: Scope = options.scope or "admin"
            grants = dict.fromkeys(options.map or [EVERY], scope)
            until = None if options.expires is None else datetime.now(UTC) + options.expires
            made = engine.create_key(options.create, grants, until)
            engine.audit.command("keys --create", target=made.name)
            print(made.secret)
            print("keep it: it is not stored, and cannot be shown again", file=sys.stderr)
    return 0


def _line(key: Key) -> str:
    grants = ", ".join(
        f"{scope} of {'all' if name == EVERY else name}" for name, scope in key.grants.items()
    )
    text = f"{key.created_at:%Y-%m-%dT%H:%M:%SZ}  {one_line(key.name)}  {grants}"
    if key.expires_at is None:
        return text
    ends = "expired" if key.expires_at <= datetime.now(UTC) else "until"
    return f"{text}, {ends} {key.expires_at:%Y-%m-%dT%H:%M:%SZ}"


def _duration(text: str) -> timedelta:
    found = re.fullmatch(r"([1-9][0-9]{0,4})([mhdw])", text)
    if found is None:
        raise argparse.ArgumentTypeError(f"{text!r} is no time such as 12h, 30d or 8w")
    return timedelta(seconds=int(found[1]) * _SECONDS[found[2]])
