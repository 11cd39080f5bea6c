"""`sceneprint spool`: frames kept on disk while there is no service, and uploaded later."""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import asdict
from datetime import UTC
from pathlib import Path

from tqdm import tqdm

from sceneprint.cli import positive
from sceneprint.cli.bag import add_recording_options, tell
from sceneprint.cli.options import (
    add_service_options,
    one_line,
    open_client,
    priority_of,
    share_of,
)
from sceneprint.cli.upload import OF_FRAME, add_frame_options, meta_for, sequences_of
from sceneprint.errors import DatasetError
from sceneprint_client.api.base import NOVEL
from sceneprint_client.spool import MOST_BYTES, Spool, SpoolRefusal, SyncReport


def add_spool(command: argparse.ArgumentParser) -> None:
    """Add the options of `sceneprint spool`."""
    what = command.add_subparsers(dest="what", required=True, metavar="ACTION")
    add = what.add_parser("add", help="add frames to a spool, which is created if missing")
    _add_file(add)
    add.add_argument("paths", nargs="+", type=Path, metavar="PATH")
    add.add_argument(
        "--most-bytes", type=positive, metavar="N",
        help="bytes that the spool may hold; stays so until given again (default: "
        f"{MOST_BYTES} for a new spool)",
    )  # fmt: skip
    add_frame_options(add)
    add.add_argument("--every", type=positive, default=1, metavar="N", help="add every Nth frame")
    add_recording_options(add)
    status = what.add_parser("status", help="show what waits, and what became of the rest")
    _add_file(status)
    status.add_argument("--json", action="store_true", help="print JSON")
    sync = what.add_parser(
        "sync",
        help="upload what waits, oldest first; exit code 2 if anything was refused or frames wait",
    )
    _add_file(sync)
    sync.add_argument("map", metavar="MAP", help="map to upload frames to; it must exist")
    sync.add_argument(
        "--retry-refused", action="store_true", help="upload again what was refused before"
    )
    sync.add_argument(
        "--priority", type=priority_of, default=0, metavar="N",
        help="-10 to 10; frames with a higher priority are signed first (default: 0)",
    )  # fmt: skip
    sync.add_argument(
        "--if-novel", nargs="?", type=share_of, const=True, metavar="D",
        help=f"as of `sceneprint upload` (without a number: {NOVEL:g})",
    )  # fmt: skip
    add_service_options(sync)
    command.set_defaults(run=run_spool)


def _add_file(command: argparse.ArgumentParser) -> None:
    command.add_argument("spool", type=Path, metavar="FILE", help="file of the spool")


def run_spool(options: argparse.Namespace) -> int:
    """Keep frames in a file of bounded size while a robot is offline, and upload them when it is
    back. A full spool gives up the frames that are nearest to others. A frame leaves the spool
    once the map has it; whatever is interrupted, run `sync` again.
    """
    if options.what == "add":
        return _add(options)
    if not options.spool.is_file():
        raise DatasetError(
            f"{options.spool}: There is no spool here. Check the path; `sceneprint spool add` "
            "creates one."
        )
    with Spool(options.spool) as spool:
        return _status(spool, options) if options.what == "status" else _sync(spool, options)


def _add(options: argparse.Namespace) -> int:
    """Add frames; returns 2 where one cannot be read."""
    sequences = sequences_of(options.paths, options)
    found = [(one, frame) for one in sequences for frame in one.frames[:: options.every]]
    new, there, errors = 0, 0, []
    with Spool(options.spool, options.most_bytes) as spool:
        before = spool.status()
        try:
            for sequence, frame in tqdm(found, desc="spool", unit="frame", disable=None):
                try:
                    is_new = spool.add(frame, meta_for(options, sequence, frame))
                    new, there = new + is_new, there + (not is_new)
                except OF_FRAME as error:
                    errors.append(f"{one_line(frame.name)}: {one_line(str(error))}")
        finally:  # what was added stays, however the run ended
            now = spool.status()
            left = len(found) - new - there - len(errors)
            print(
                f"{len(found)} frames: {new} added, {there} already there, {len(errors)} refused"
                f"{f', {left} not added' if left else ''}; "
                f"{now.waiting} wait, {now.thinned - before.thinned} thinned"
            )
            for sequence in sequences:
                tell(sequence)
            for line in errors:
                print(line, file=sys.stderr)
    return 2 if errors else 0


def _status(spool: Spool, options: argparse.Namespace) -> int:
    now, refusals = spool.status(), spool.refusals()
    if options.json:
        oldest = None if now.oldest is None else now.oldest.isoformat()
        reasons = [{"name": one.name, "reason": one.reason} for one in refusals]
        print(json.dumps(asdict(now) | {"oldest": oldest, "refusals": reasons}))
        return 0
    age = ""
    if now.oldest is not None:
        age = f", the oldest of {now.oldest.astimezone(UTC):%Y-%m-%d %H:%M:%SZ}"
    print(
        f"{now.waiting} frames wait{age}; {now.bytes / 1e6:.1f} of {now.most_bytes / 1e6:.1f} MB\n"
        f"{now.uploaded} uploaded, {now.refused} refused, {now.thinned} thinned, "
        f"{now.discarded} refused and discarded"
    )
    for one in refusals:
        print(f"  {_name(one)}: {one_line(one.reason)}")
    return 0


def _name(refusal: SpoolRefusal) -> str:
    return one_line(refusal.name or "a frame")


def _sync(spool: Spool, options: argparse.Namespace) -> int:
    """Upload; returns 2 where a frame is refused."""
    if options.retry_refused:
        spool.retry_refused()
    before = spool.status()
    report: SyncReport | None = None
    with (
        open_client(options) as client,
        tqdm(total=before.waiting, desc="upload", unit="frame", disable=None) as bar,
    ):

        def progress(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        try:
            report = spool.sync(
                client, options.map, priority=options.priority, if_novel=options.if_novel,
                progress=progress,
            )  # fmt: skip
        finally:  # what was uploaded stays there, however the run ended
            bar.close()
            now = spool.status()
            taken = now.uploaded - before.uploaded
            parts = f", {report.there} of them already there" if report and report.there else ""
            print(f"{taken} frames uploaded{parts}; {now.refused} refused, {now.waiting} wait")
    for one in spool.refusals():
        print(f"{_name(one)}: {one_line(one.reason)}", file=sys.stderr)
    if report.done:
        print(report.summary.text)
    return 2 if now.refused else 0
