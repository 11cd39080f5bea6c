"""Numbers on the command line, checked where they are read."""

from __future__ import annotations

import argparse
import math
import re
from datetime import timedelta


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


_SECONDS = {"m": 60, "h": 3600, "d": 86400, "w": 7 * 86400}


def duration(text: str) -> timedelta:
    """A duration such as 12h."""
    found = re.fullmatch(r"([1-9][0-9]{0,4})([mhdw])", text)
    if found is None:
        raise argparse.ArgumentTypeError(f"{text!r} is not a duration such as 12h, 30d or 8w")
    return timedelta(seconds=int(found[1]) * _SECONDS[found[2]])
