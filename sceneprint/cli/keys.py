"""`sceneprint keys`: keys for a service that listens beyond its own machine."""

from __future__ import annotations

import argparse
import sys
from typing import Any

from sceneprint.cli.serve import add_data_option, settings_of


def add_to(commands: Any) -> None:
    """Describe the command to the parser."""
    command = commands.add_parser(
        "keys",
        help="make a key for callers of a service that listens beyond its own machine",
        description="Make a key. Its secret is printed once and stored nowhere, only its hash is.",
    )
    command.add_argument("--create", required=True, metavar="NAME", help="whose key it is")
    add_data_option(command)
    command.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Make a key and print its secret."""
    from sceneprint.engine import Engine

    with Engine(settings_of(options)) as engine:
        secret = engine.create_key(options.create)
    print(secret)
    print("keep it: it is not stored, and cannot be shown again", file=sys.stderr)
    return 0
