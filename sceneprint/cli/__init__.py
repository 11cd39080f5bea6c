"""The `sceneprint` command."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from concurrent.futures.process import BrokenProcessPool

from sceneprint import __version__
from sceneprint.errors import SceneprintError

#: Exit code of a command that was asked for something it cannot do.
USAGE = 2


def parser() -> argparse.ArgumentParser:
    """All commands with their options."""
    from sceneprint.cli import (
        associate,
        audit,
        demo,
        doctor,
        evaluate,
        evaluate_pairs,
        events,
        frames,
        fsck,
        index,
        jobs,
        keys,
        localize,
        maps,
        picture,
        query,
        reconstruct,
        reencode,
        restore,
        serve,
        sign,
        similarity,
        snapshot,
        synth,
        thin,
        train,
        upload,
        work,
    )

    top = argparse.ArgumentParser(
        prog="sceneprint",
        description="Place recognition from pure geometry: depth frames in, places and poses out.",
    )
    top.add_argument("--version", action="version", version=f"sceneprint {__version__}")
    commands = top.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for module in (
        demo,
        serve,
        work,
        keys,
        audit,
        maps,
        upload,
        query,
        localize,
        similarity,
        associate,
        frames,
        reconstruct,
        jobs,
        events,
        doctor,
        fsck,
        reencode,
        thin,
        index,
        snapshot,
        restore,
        sign,
        picture,
        evaluate,
        evaluate_pairs,
        synth,
        train,
    ):
        module.add_to(commands)
    return top


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; errors are one line on standard error and exit code 2."""
    for stream in (sys.stdout, sys.stderr):  # file names may hold what a terminal cannot show
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")
    command = "sceneprint"
    try:  # from the first import on, which takes a second
        options = parser().parse_args(arguments)
        command = f"sceneprint {options.command}"
        return int(options.run(options))
    except SceneprintError as error:
        return _refuse(command, str(error))
    except UnicodeEncodeError as error:  # of an argument: what we print ourselves is escaped
        return _refuse(command, f"{error.object!a:.80} is not text in UTF-8. Use another name.")
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
