"""`sceneprint keys`: keys for a service that listens beyond its own machine."""

from __future__ import annotations

import argparse
import sys
from datetime import UTC, datetime
from typing import Any

from sceneprint.cli.connection import one_line
from sceneprint.cli.serve import add_data_option, settings_of


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
    what.add_argument("--list", action="store_true", help="print when each was made, and its name")
    what.add_argument("--revoke", metavar="NAME", help="let a key open nothing any more")
    add_data_option(command)
    command.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Do what was asked for with the keys of the data folder."""
    from sceneprint.engine import Engine

    with Engine(settings_of(options)) as engine:
        if options.list:
            for name, created_at in engine.list_keys():
                print(f"{datetime.fromtimestamp(created_at, UTC):%Y-%m-%dT%H:%M:%SZ}", end="  ")
                print(one_line(name))
        elif options.revoke is not None:
            engine.revoke_key(options.revoke)
            print(f"key {one_line(options.revoke)} is revoked")
        else:
            print(engine.create_key(options.create))
            print("keep it: it is not stored, and cannot be shown again", file=sys.stderr)
    return 0
