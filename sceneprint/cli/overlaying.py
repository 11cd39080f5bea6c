"""The query's points laid on those of its best match, as a file for any viewer of clouds."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from sceneprint.errors import DatasetError, UnknownFrame
from sceneprint.schemas.kept import COLOURS, TRANSFORMS
from sceneprint.writing import check_writable, write_whole

if TYPE_CHECKING:
    from sceneprint.client import Client
    from sceneprint.schemas import Answer


def add_overlay_options(command: argparse.ArgumentParser) -> None:
    """Describe the overlay to the parser of a command that asks for one frame."""
    command.add_argument(
        "--overlay",
        type=Path,
        metavar="FILE.ply",
        help="of one frame: write its points and those of its first match, laid on each other",
    )
    command.add_argument(
        "--color",
        choices=COLOURS,
        default="source",
        help="what the overlay's colours tell: which frame a point is of, its normal, or how far "
        "it is from the other's surface (default: source)",
    )
    command.add_argument(
        "--by",
        choices=TRANSFORMS,
        default="aligned",
        help="the overlay's transform: as it was found, its best rival, or none (default: aligned)",
    )


def check_overlay(options: argparse.Namespace, frames: int) -> None:
    """See before the first query that the overlay can be written.

    Raises
    ------
    DatasetError : several frames would go to one file.
    OSError : the file cannot be written.
    """
    if options.overlay is None:
        return
    if frames != 1:
        raise DatasetError(
            f"{options.path}: has {frames} frames, and --overlay writes one file. Name one with "
            "--frame."
        )
    check_writable(options.overlay)


def save_overlay(client: Client, answer: Answer, options: argparse.Namespace) -> str:
    """Write the overlay; returns a line about it.

    Raises
    ------
    UnknownFrame : the answer has no match.
    InvalidRequest : its first match has no such transform.
    NotIndexed : the query was asked without validation.
    """
    if not answer.matches:
        raise UnknownFrame("The query has no match to be laid on. Ask a map that has frames.")
    best = answer.matches[0]
    data = client.overlay(
        answer.query_id, best.frame_id, best.map, color=options.color, transform=options.by
    )
    write_whole(options.overlay, data)
    return f"{options.overlay}: the query laid on {best.frame_id}"
