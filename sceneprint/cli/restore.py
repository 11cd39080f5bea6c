"""`sceneprint restore`: a data folder of a snapshot."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import Any

from sceneprint.cli.connection import one_line
from sceneprint.cli.serve import add_data_option, settings_of
from sceneprint.cli.signals import ended_by_signals
from sceneprint.cli.snapshot import contents, name_damaged, shown_progress
from sceneprint.errors import InvalidRequest


def add_to(commands: Any) -> None:
    """Describe the command to the parser."""
    command = commands.add_parser(
        "restore",
        help="make a data folder of a snapshot, after verifying all of it",
        description="Verify a snapshot and make a data folder of it, all or nothing. A folder "
        "that holds something is not touched unless --replace is given, and is then moved aside, "
        "never removed: stop what uses it first. Exit code 1 where the snapshot says that blobs "
        "were damaged when it was taken; 2 where nothing was restored.",
    )
    command.add_argument("archive", type=Path, metavar="ARCHIVE", help="of `sceneprint snapshot`")
    add_data_option(command)
    choice = command.add_mutually_exclusive_group()
    choice.add_argument(
        "--verify-only", action="store_true", help="read and check all of it, and restore nothing"
    )
    choice.add_argument(
        "--replace", action="store_true", help="move the folder that is there aside"
    )
    command.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Verify or restore; returns 1 where blobs were damaged when the snapshot was taken."""
    from sceneprint.maintenance.restoring import restore_snapshot, verify_snapshot

    start, shown = time.perf_counter(), one_line(str(options.archive))
    if options.verify_only:
        with ended_by_signals(), shown_progress("verify") as progress:
            snapshot = verify_snapshot(options.archive, progress)
        done, aside = f"{shown} is whole", None
    else:
        settings = settings_of(options)
        if settings.database_url is not None:
            raise InvalidRequest(
                "SCENEPRINT_DATABASE_URL is set, and a snapshot is restored to the data folder, "
                "where no service would look then. Unset it, for the service too."
            )
        with ended_by_signals(), shown_progress("restore") as progress:
            snapshot, aside = restore_snapshot(
                options.archive, settings.data_dir, replace=options.replace, progress=progress
            )
        done = f"{shown} is restored to {one_line(str(settings.data_dir))}"
    seconds = time.perf_counter() - start
    print(f"{done}: {contents(snapshot)} of {snapshot.manifest.created_at:%Y-%m-%dT%H:%M:%SZ} "
          f"in {seconds:.1f} s")  # fmt: skip
    if aside is not None:
        print(f"what was there before is kept in {one_line(str(aside))}", file=sys.stderr)
    advice = "These frames were damaged before; delete them, or upload them again."
    return 1 if name_damaged(snapshot, advice) else 0
