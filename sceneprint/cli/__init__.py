"""The `sceneprint` command: its parser, and the numbers that its options take."""

from __future__ import annotations

import argparse
import math
import os
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures.process import BrokenProcessPool
from datetime import timedelta
from importlib.metadata import entry_points
from pkgutil import resolve_name

from sceneprint import __version__
from sceneprint.errors import SceneprintError
from sceneprint.process import read_secret_files

#: Exit code of a command that was asked for something it cannot do.
USAGE = 2


#: The module of this package that has each command, in the order in which the help lists them.
COMMANDS = {
    "serve": "serve",
    "work": "serve",
    "keys": "admin",
    "tenants": "admin",
    "audit": "audit",
    "maps": "inventory",
    "upload": "upload",
    "spool": "spool",
    "query": "query",
    "localize": "query",
    "queries": "inventory",
    "associate": "sessions",
    "frames": "inventory",
    "sessions": "sessions",
    "reconstruct": "reconstruct",
    "jobs": "inventory",
    "bag": "bag",
    "doctor": "doctor",
    "migrate": "storage",
    "fsck": "storage",
    "reencode": "storage",
    "purge": "storage",
    "snapshot": "storage",
    "restore": "storage",
    "pull": "storage",
    "sign": "sign",
}


def all_commands() -> dict[str, str]:
    """Return the function that describes each command, as `MODULE:FUNCTION`, by its name.

    Other distributions, such as sceneprint-lab, add theirs as entry points.
    """
    added = entry_points(group="sceneprint.commands")
    return {name: _own(name) for name in COMMANDS} | {one.name: one.value for one in added}


def _own(name: str) -> str:
    return f"sceneprint.cli.{COMMANDS[name]}:add_{name.replace('-', '_')}"


def parser(known: Mapping[str, str] | None = None) -> argparse.ArgumentParser:
    """Return the parser of commands with their options.

    Parameters
    ----------
    known : what `all_commands` returns, or a part of it; only its modules are loaded
    """
    top = argparse.ArgumentParser(
        prog="sceneprint",
        description="Place recognition from pure geometry: depth frames in, places and poses out.",
    )
    top.add_argument("--version", action="version", version=f"sceneprint {__version__}")
    commands = top.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for function in (all_commands() if known is None else known).values():
        resolve_name(function)(commands)
    return top


def _needed(arguments: Sequence[str]) -> Mapping[str, str]:
    """Return the commands that have to be known to read these arguments.

    To load them all takes a second, which is most of what a small command needs.
    """
    first = arguments[0] if arguments else ""
    if first == "--version":
        return {}
    if first in COMMANDS:
        return {first: _own(first)}
    found = all_commands()
    return {first: found[first]} if first in found else found


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; errors are one line on standard error and exit code 2."""
    for stream in (sys.stdout, sys.stderr):  # file names may hold what a terminal cannot show
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")
    command = "sceneprint"
    given = sys.argv[1:] if arguments is None else arguments
    try:  # from the first import on, which takes a second
        options = parser(_needed(given)).parse_args(given)
        command = f"sceneprint {options.command}"
        read_secret_files(os.environ)
        return int(options.run(options))
    except SceneprintError as error:
        return _refuse(command, str(error))
    except UnicodeEncodeError as error:  # of an argument: what we print ourselves is escaped
        return _refuse(command, f"{error.object!a:.80} is not valid UTF-8. Use another name.")
    except BrokenPipeError:  # the reader, such as `head`, has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as error:
        place = error.filename or "input/output"
        reason = error.strerror or error
        return _refuse(command, f"{place}: {reason}. Check the path and its permissions.")
    except (BrokenProcessPool, MemoryError):
        return _refuse(
            command,
            "a process was killed or ran out of memory, and nothing was written. "
            "Use fewer --jobs, or a machine with more memory.",
        )
    except KeyboardInterrupt:
        print(f"{command}: stopped", file=sys.stderr)
        return 130


def _refuse(command: str, message: str) -> int:
    print(f"{command}: {message}", file=sys.stderr)
    return USAGE


# Numbers on the command line, checked where they are read.


def whole_number(text: str) -> int:
    """A whole number from 0 up."""
    return _at_least(text, 0)


def positive(text: str) -> int:
    """A whole number from 1 up."""
    return _at_least(text, 1)


def _at_least(text: str, least: int) -> int:
    try:
        number = int(text)
    except ValueError:
        number = least - 1
    if number < least:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number of at least {least}")
    return number


def number_within(text: str, allowed: Callable[[float], bool], what: str) -> float:
    """Return a number that is allowed, which NaN is not; `what` says which those are."""
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not allowed(number):
        raise argparse.ArgumentTypeError(f"{text!r} is not {what}")
    return number


def positive_number(text: str) -> float:
    """Return a number above 0."""
    return number_within(text, lambda number: 0 < number < math.inf, "a number above 0")


def metres(text: str) -> float:
    """A positive distance."""
    return number_within(text, lambda number: 0 < number <= 1e4, "a distance of up to 10000 m")


_SECONDS = {"m": 60, "h": 3600, "d": 86400, "w": 7 * 86400}


def duration(text: str) -> timedelta:
    """A duration such as 12h."""
    found = re.fullmatch(r"([1-9][0-9]{0,4})([mhdw])", text)
    if found is None:
        raise argparse.ArgumentTypeError(f"{text!r} is not a duration such as 12h, 30d or 8w")
    return timedelta(seconds=int(found[1]) * _SECONDS[found[2]])
