"""What options of `sceneprint upload` say, read from text."""

from __future__ import annotations

import argparse

from sceneprint.errors import InvalidRequest
from sceneprint.schemas.frames import MOST_PRIORITY, GivenBase
from sceneprint.schemas.novelty import novelty_of


def base_of(text: str) -> GivenBase:
    """Seven numbers."""
    try:
        tx, ty, tz, qx, qy, qz, qw = (float(part) for part in text.split(","))
        return GivenBase.model_validate(
            {
                "translation": {"x": tx, "y": ty, "z": tz},
                "rotation": {"x": qx, "y": qy, "z": qz, "w": qw},
            }
        )
    except ValueError as error:  # pydantic's too
        raise argparse.ArgumentTypeError(
            f"{text!r} is not seven numbers with commas between: metres and a unit quaternion"
        ) from error


def priority_of(text: str) -> int:
    """A whole number from -10 to 10."""
    if text.removeprefix("-") not in {str(number) for number in range(MOST_PRIORITY + 1)}:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from -10 to 10")
    return int(text)


def share_of(text: str) -> float:
    """A share of the distance of unrelated frames."""
    try:
        share = novelty_of(text)
    except InvalidRequest:
        share = None
    if share is None:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number above 0, up to 1")
    return share
