"""How a command asks a map; the same options for every command that does."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from sceneprint.cli.connection import one_line
from sceneprint.cli.filters import add_filter_options, filter_of
from sceneprint.cli.numbers import positive, whole

if TYPE_CHECKING:
    from sceneprint.schemas import Answer


def add_asking_options(command: argparse.ArgumentParser) -> None:
    """`--k` and its like, with the filter."""
    command.add_argument(
        "--k", type=positive, default=5, metavar="K", help="accepted matches wanted (default: 5)"
    )
    command.add_argument("--exact", action="store_true", help="compare every frame of the map")
    command.add_argument(
        "--seed", type=whole, default=0, metavar="S", help="of the random choices (default: 0)"
    )
    command.add_argument(
        "--candidates",
        type=positive,
        metavar="N",
        help="how many of the ranking are selected and validated (default: 10, or K if more)",
    )
    command.add_argument(
        "--diversity",
        type=setting,
        action="append",
        metavar="NAME=VALUE",
        help="a scale of the selection: sigma or omega; several: each",
    )
    command.add_argument(
        "--validation",
        type=setting,
        action="append",
        metavar="NAME=VALUE",
        help="what a match must stand, such as mode=paper or residual_m=0.05; several: each",
    )
    command.add_argument(
        "--deadline-ms", type=positive, metavar="MS", help="begin no candidate that ends later"
    )
    command.add_argument("--explain", action="store_true", help="say where each frame was lost")
    command.add_argument(
        "--explain-frame", metavar="FRAME", help="say where this frame of the map was lost"
    )
    command.add_argument(
        "--no-keep", action="store_true", help="do not keep the answer for `GET /v1/queries/ID`"
    )
    add_filter_options(command)


def options_of(options: argparse.Namespace) -> dict[str, Any]:
    """How to ask, as `Client.query` takes it."""
    return {
        "k": options.k,
        "exact": options.exact,
        "seed": options.seed,
        "candidates": options.candidates,
        "diversity": settings_of(options.diversity),
        "validation": settings_of(options.validation),
        "deadline_ms": options.deadline_ms,
        "explain": options.explain,
        "explain_frame": options.explain_frame,
        "keep": not options.no_keep,
        "filter": filter_of(options),
    }


def setting(text: str) -> tuple[str, str]:
    """A name and a value; whether there is such a name, the query knows."""
    name, equals, value = text.partition("=")
    if not equals or not name:
        raise argparse.ArgumentTypeError(f"{text!r} is not NAME=VALUE")
    return name, value


def settings_of(given: Sequence[tuple[str, str]] | None) -> dict[str, str] | None:
    """Names with their values; None where none was given."""
    return None if given is None else dict(given)


def explained_lines(answer: Answer) -> list[str]:
    """Why the frames of the ranking came as far as they did, a line each; none if not asked."""
    lines = [
        f"  {one.rank:4}  {one_line(one.frame_id)}  {one.similarity:4.2f}  {one.stage}: "
        f"{one.outcome.replace('_', ' ')}; {one_line(one.reason)}"
        for one in answer.explanations or []
    ]
    one = answer.explained_frame
    if one is not None:
        place = "not searched" if one.rank is None else f"rank {one.rank} of {one.of}"
        lost = "a match" if one.lost_at is None else f"lost at {one.lost_at}"
        lines.append(f"  {one_line(one.frame_id)}: {place}; {lost}: {one_line(one.reason)}")
    return lines
