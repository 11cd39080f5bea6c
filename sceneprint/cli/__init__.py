"""The `sceneprint` command."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence

from sceneprint import __version__
from sceneprint.cli import demo, picture, sign, synth, train
from sceneprint.errors import SceneprintError

#: Exit code of a command that was asked for something it cannot do.
USAGE = 2


def parser() -> argparse.ArgumentParser:
    """All commands with their options."""
    top = argparse.ArgumentParser(
        prog="sceneprint",
        description="Place recognition from pure geometry: depth frames in, signatures out.",
    )
    top.add_argument("--version", action="version", version=f"sceneprint {__version__}")
    commands = top.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for module in (demo, sign, picture, synth, train):
        module.add_to(commands)
    return top


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; errors are one line on standard error and exit code 2."""
    options = parser().parse_args(arguments)
    try:
        return int(options.run(options))
    except SceneprintError as error:
        print(f"sceneprint {options.command}: {error}", file=sys.stderr)
        return USAGE
    except BrokenPipeError:  # the reader, such as `head`, has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as error:
        print(
            f"sceneprint {options.command}: {error.filename or 'input/output'}: "
            f"{error.strerror or error}. Check the path and its permissions.",
            file=sys.stderr,
        )
        return USAGE
    except KeyboardInterrupt:
        print(f"sceneprint {options.command}: stopped", file=sys.stderr)
        return 130
