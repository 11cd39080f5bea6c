"""`sceneprint spool`: frames on disk while no service is reachable, uploaded later."""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from datetime import UTC
from pathlib import Path

from tqdm import tqdm

from sceneprint.cli import positive
from sceneprint.cli.bag import add_recording_options, print_note
from sceneprint.cli.options import add_service_options, add_signing_options, open_client
from sceneprint.cli.output import one_line, print_error, progress_bar
from sceneprint.cli.upload import OF_FRAME, add_frame_options, frame_metadata, sequences_of
from sceneprint.errors import DatasetError, InvalidRequest
from sceneprint_client.spool import MOST_BYTES, Spool, SyncReport


def add_spool(command: argparse.ArgumentParser) -> None:
    """Add the options of `sceneprint spool`."""
    command.add_argument("spool", type=Path, metavar="FILE", help="path of the spool file")
    command.add_argument(
        "paths", nargs="*", type=Path, metavar="PATH",
        help="frames to add to the spool, which is created if missing",
    )  # fmt: skip
    command.add_argument(
        "--most-bytes", type=positive, metavar="N",
        help="maximum size of the spool, bytes; stored in the spool (default: "
        f"{MOST_BYTES} for a new spool)",
    )  # fmt: skip
    add_frame_options(command)
    command.add_argument(
        "--every", type=positive, default=1, metavar="N", help="add every n-th frame"
    )
    command.add_argument("--json", action="store_true", help="print the status as JSON")
    group = command.add_argument_group("upload")
    group.add_argument(
        "--to", metavar="MAP",
        help="upload the waiting frames to this map, which must exist, oldest first; the exit code "
        "is 2 if frames were refused or still wait",
    )  # fmt: skip
    group.add_argument(
        "--retry-refused", action="store_true", help="upload previously refused frames again"
    )
    add_signing_options(group)
    add_recording_options(command)
    add_service_options(command)
    command.set_defaults(run=run_spool)


def run_spool(options: argparse.Namespace) -> int:
    """Store frames in a file of limited size while a robot is offline, and upload them later with
    --to. Without PATH and --to, show the waiting and uploaded frames. A full spool drops the frames
    that are nearest to others. A frame leaves the spool once the map has it; after an interruption,
    run the command again.
    """
    if options.paths and options.to is not None:
        raise InvalidRequest(
            "Frames cannot be added to a spool and uploaded in one command. Omit --to or PATH."
        )
    if options.retry_refused and options.to is None:
        raise InvalidRequest("--retry-refused requires --to. Specify the map to upload to.")
    if options.paths:
        return _add(options)
    if not options.spool.is_file():
        raise DatasetError(
            f"{options.spool}: there is no spool here. Check the path; `sceneprint spool FILE "
            "PATH` creates one."
        )
    with Spool(options.spool) as spool:
        return _status(spool, options) if options.to is None else _sync(spool, options)


def _add(options: argparse.Namespace) -> int:
    """Add frames to the spool; return 2 if a frame cannot be read."""
    sequences = sequences_of(options.paths, options)
    frames = [(run, frame) for run in sequences for frame in run.frames[:: options.every]]
    new, there, errors = 0, 0, []
    with Spool(options.spool, options.most_bytes) as spool:
        before = spool.status()
        try:
            for sequence, frame in tqdm(frames, desc="spool", unit="frame", disable=None):
                try:
                    is_new = spool.add(frame, frame_metadata(options, sequence, frame))
                    new, there = new + is_new, there + (not is_new)
                except OF_FRAME as error:
                    errors.append(f"{one_line(frame.name)}: {one_line(str(error))}")
        finally:  # report the added frames even after an error
            now = spool.status()
            skipped = len(frames) - new - there - len(errors)
            print(
                f"{len(frames)} frames: {new} added, {there} already there, {len(errors)} refused"
                f"{f', {skipped} not added' if skipped else ''}; "
                f"{now.waiting} wait, {now.thinned - before.thinned} thinned"
            )
            for sequence in sequences:
                print_note(sequence)
            for line in errors:
                print_error(line)
    return 2 if errors else 0


def _refusals(spool: Spool) -> list[str]:
    return [f"{one_line(o.name or 'a frame')}: {one_line(o.reason)}" for o in spool.refusals()]


def _status(spool: Spool, options: argparse.Namespace) -> int:
    now = spool.status()
    if options.json:
        oldest = None if now.oldest is None else now.oldest.isoformat()
        reasons = [{"name": refusal.name, "reason": refusal.reason} for refusal in spool.refusals()]
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
    for line in _refusals(spool):
        print(f"  {line}")
    return 0


def _sync(spool: Spool, options: argparse.Namespace) -> int:
    """Upload the waiting frames; return 2 if frames are refused or still wait."""
    if options.retry_refused:
        spool.retry_refused()
    before = spool.status()
    report: SyncReport | None = None
    with open_client(options) as client:
        try:
            with progress_bar("upload", total=before.waiting) as progress:
                report = spool.sync(
                    client, options.to, priority=options.priority, if_novel=options.if_novel,
                    progress=progress,
                )  # fmt: skip
        finally:  # report the uploaded frames even after an error
            now = spool.status()
            parts = f", {report.there} of them already there" if report and report.there else ""
            print(
                f"{now.uploaded - before.uploaded} frames uploaded{parts}; {now.refused} refused, "
                f"{now.waiting} wait"
            )
    for line in _refusals(spool):
        print_error(line)
    if report.done:
        print(report.summary.text)
    return 2 if now.refused else 0
