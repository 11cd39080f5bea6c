"""Numbers on the command line, checked where they are read."""

from __future__ import annotations

import argparse
import math


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


def metres(text: str) -> float:
    """A positive distance."""
    try:
        distance = float(text)
    except ValueError:
        distance = math.nan
    if not 0 < distance <= 1e4:  # false for NaN as well
        raise argparse.ArgumentTypeError(f"{text!r} is not a distance of up to 10000 m")
    return distance
