"""The `sceneprint` command: its parser, and the types of its options."""

from __future__ import annotations

import argparse
import math
import os
import re
import sys
from collections.abc import Callable, Sequence
from concurrent.futures.process import BrokenProcessPool
from datetime import timedelta
from importlib import import_module
from importlib.metadata import entry_points
from inspect import cleandoc
from pkgutil import resolve_name
from typing import NamedTuple

from sceneprint import __version__
from sceneprint.errors import SceneprintError
from sceneprint.process import read_secret_files

#: Exit code of a command with wrong arguments or unmet preconditions.
USAGE = 2


#: Module and help line of each command, in the order of `sceneprint --help`. Function `add_NAME` of
#: the module adds the options. The docstring of the function that runs the command is its
#: description.
COMMANDS = {
    "serve": ("serve", "run the HTTP service and its workers"),
    "work": ("serve", "run workers without the HTTP service"),
    "keys": ("admin", "create, list, rotate and revoke API keys, and their tenants"),
    "audit": ("admin", "print or export the audit log"),
    "maps": ("inventory", "list, create, edit or delete the maps of a service"),
    "upload": ("upload", "upload depth frames, point clouds or a whole map to a map of a service"),
    "spool": ("spool", "store frames on disk while no service is reachable, and upload them later"),
    "query": ("query", "find frames of the same place in a map"),
    "localize": ("query", "find the pose of a frame in a map"),
    "queries": ("inventory", "list the latest queries and their outcomes"),
    "make": ("products", "compute an association of sessions, or a mesh of a place"),
    "frames": ("inventory", "list frames of a map, download their files, edit metadata"),
    "sessions": ("sessions", "list, rename, tag or delete the sessions of a map"),
    "jobs": ("inventory", "list, retry or cancel the jobs of a service"),
    "bag": ("bag", "show the contents of a ROS recording"),
    "doctor": ("doctor", "check this machine, the data folder and the service"),
    "migrate": ("storage", "create the database schema, or upgrade it to that of this version"),
    "fsck": ("storage", "check and repair database, blobs and indexes, or erase deleted frames"),
    "reencode": ("storage", "switch a map to another model"),
    "snapshot": ("storage", "back up database and blobs as a bundle, while the service runs"),
    "restore": ("storage", "verify a bundle and restore it to a data folder or a database"),
    "pull": ("storage", "copy maps of a service to this machine, to localise without a network"),
    "sign": ("sign", "sign depth frames and point clouds"),
    "completion": ("completion", "print a script that completes commands in a shell"),
}


class Command(NamedTuple):
    """A command: the function that adds its options, as `MODULE:FUNCTION`, and its help line."""

    function: str
    line: str


def own_command(name: str) -> Command:
    """Return the command `name` of COMMANDS."""
    module, line = COMMANDS[name]
    return Command(f"sceneprint.cli.{module}:add_{name}", line)


def all_commands() -> dict[str, Command]:
    """Return all commands by name, without importing their modules.

    Other distributions, such as sceneprint-lab, add commands as entry points. `COMMANDS` in the
    package of their modules contains the help lines.
    """
    commands = {name: own_command(name) for name in COMMANDS}
    for entry in entry_points(group="sceneprint.commands"):
        lines = import_module(entry.module.rpartition(".")[0]).COMMANDS
        commands[entry.name] = Command(entry.value, lines[entry.name])
    return commands


def parser(name: str | None = None) -> argparse.ArgumentParser:
    """Return the parser of a command or of all commands.

    Parameters
    ----------
    name : command whose options are added; None adds the options of all commands, and an unknown
        name adds no options
    """
    top = argparse.ArgumentParser(
        prog="sceneprint",
        description="Place recognition from pure geometry: depth frames in, places and poses out.",
    )
    top.add_argument("--version", action="version", version=f"sceneprint {__version__}")
    commands = top.add_subparsers(dest="command", required=True, metavar="COMMAND")
    # Search for entry points only if necessary, since this doubles the time of a small parser.
    choices = {name: own_command(name)} if name in COMMANDS else all_commands()
    for each, (function, line) in choices.items():
        command = commands.add_parser(each, help=line)
        if name in (None, each):
            resolve_name(function)(command)
            command.description = cleandoc(command.get_default("run").__doc__ or "")
    return top


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command, and return its exit code; print an error as one line on standard error.

    The exit code is 2 after an error, 130 after Ctrl-C, and 0 if the output was closed early.
    """
    for stream in (sys.stdout, sys.stderr):  # escape unprintable characters in file names
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")
    command = "sceneprint"
    arguments = sys.argv[1:] if arguments is None else arguments
    # Prevent httpx from importing rich and click for its own command, which is slow.
    sys.modules.setdefault("httpx._main", None)  # type: ignore[arg-type]
    try:
        options = parser(arguments[0] if arguments else "").parse_args(arguments)
        command = f"sceneprint {options.command}"
        read_secret_files(os.environ)
        return int(options.run(options))
    except SceneprintError as error:
        return _refuse(command, str(error))
    except UnicodeEncodeError as error:  # caused by an argument
        return _refuse(command, f"{error.object!a:.80} is not valid UTF-8. Use another name.")
    except BrokenPipeError:  # closed by the reader, such as `head`
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


# Types of options.


def whole_number(text: str) -> int:
    """Parse an integer of at least 0."""
    return _at_least(text, 0)


def positive(text: str) -> int:
    """Parse an integer of at least 1."""
    return _at_least(text, 1)


def _at_least(text: str, least: int) -> int:
    try:
        number = int(text)
    except ValueError:
        number = least - 1
    if number < least:
        raise argparse.ArgumentTypeError(f"{text!r} is not an integer of at least {least}")
    return number


def number_within(text: str, allowed: Callable[[float], bool], what: str) -> float:
    """Parse a number that satisfies `allowed`; `what` describes such numbers in the error."""
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not allowed(number):
        raise argparse.ArgumentTypeError(f"{text!r} is not {what}")
    return number


def positive_number(text: str) -> float:
    """Parse a number above 0."""
    return number_within(text, lambda number: 0 < number < math.inf, "a number above 0")


def metres(text: str) -> float:
    """Parse a positive distance in metres."""
    return number_within(text, lambda number: 0 < number <= 1e4, "a distance of up to 10000 m")


_SECONDS = {"m": 60, "h": 3600, "d": 86400, "w": 7 * 86400}


def duration(text: str) -> timedelta:
    """Parse a duration such as 12h."""
    parts = re.fullmatch(r"([1-9][0-9]{0,4})([mhdw])", text)
    if parts is None:
        raise argparse.ArgumentTypeError(f"{text!r} is not a duration such as 12h, 30d or 8w")
    return timedelta(seconds=int(parts[1]) * _SECONDS[parts[2]])
