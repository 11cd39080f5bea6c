"""Which frames of a map a command asks among."""

from __future__ import annotations

import argparse
from typing import Any

from sceneprint.errors import InvalidRequest


def add_filter_options(command: argparse.ArgumentParser) -> None:
    """`--robot` and its like; all that are given must hold."""
    group = command.add_argument_group(
        "filter",
        "search only frames of which all of this is true; a frame that does not say is out",
    )
    group.add_argument("--robot", action="append", metavar="NAME", help="several: any of them")
    group.add_argument("--session", action="append", metavar="NAME", help="several: any of them")
    group.add_argument(
        "--after", metavar="TIME", help="taken then or later, such as 2026-11-16T09:30:00Z"
    )
    group.add_argument("--before", metavar="TIME", help="taken then or earlier")
    group.add_argument("--tag", action="append", metavar="TAG", help="several: all of them")
    group.add_argument(
        "--not-within",
        type=float,
        metavar="SECONDS",
        help="not of the query's own session and so near to it in time: for loop closure",
    )
    group.add_argument(
        "--region",
        type=_box,
        metavar="X0,Y0,Z0,X1,Y1,Z1",
        help="its pose lies in there, metres (write --region=-1,... where it begins with a minus)",
    )
    group.add_argument("--region-frame", metavar="NAME", help="the frame that those poses lead to")
    group.add_argument(
        "--exclude", action="append", metavar="FRAME", help="not this frame; several: none of them"
    )


def filter_of(options: argparse.Namespace) -> dict[str, Any] | None:
    """The filter that the options describe, as JSON has it; None where there is none.

    Raises
    ------
    InvalidRequest : one of --region and --region-frame without the other.
    """
    region = None
    if (options.region is None) != (options.region_frame is None):
        raise InvalidRequest(
            "A box is of poses that lead to one frame. Give --region and --region-frame together."
        )
    if options.region is not None:
        least, most = options.region
        region = {"parent_frame": options.region_frame, "min": least, "max": most}
    given = {
        "robot": options.robot,
        "session": options.session,
        "captured_after": options.after,
        "captured_before": options.before,
        "tags": options.tag,
        "not_within_s": options.not_within,
        "region": region,
        "exclude_frames": options.exclude,
    }
    return {name: value for name, value in given.items() if value is not None} or None


def _box(text: str) -> tuple[dict[str, float], dict[str, float]]:
    """Two corners."""
    try:
        numbers = [float(one) for one in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != 6:
        raise argparse.ArgumentTypeError(f"{text!r} is not six numbers with commas between them")
    x, y, z = zip(numbers[:3], numbers[3:], strict=True)
    return {"x": x[0], "y": y[0], "z": z[0]}, {"x": x[1], "y": y[1], "z": z[1]}
