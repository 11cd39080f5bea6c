"""Where a command finds its service."""

from __future__ import annotations

import argparse
import os
from typing import TYPE_CHECKING

from sceneprint.client.client import DEFAULT_URL

if TYPE_CHECKING:
    from sceneprint.client import Client


def add_service_options(command: argparse.ArgumentParser) -> None:
    """`--url` and `--key`."""
    command.add_argument(
        "--url",
        default=os.environ.get("SCENEPRINT_URL") or None,
        help=f"of the service (default: SCENEPRINT_URL, or {DEFAULT_URL})",
    )
    command.add_argument(
        "--key",
        default=os.environ.get("SCENEPRINT_KEY") or None,
        help="where the service asks for one (default: SCENEPRINT_KEY)",
    )


def open_client(options: argparse.Namespace) -> Client:
    """A client of the service that the options name.

    Raises
    ------
    Unreachable : the address is none.
    """
    from sceneprint.client import Client

    return Client(options.url or DEFAULT_URL, options.key)


def one_line(text: str) -> str:
    """A text that may hold line breaks and escapes; a line of ours never does."""
    return text if text.isprintable() else ascii(text)[1:-1]
