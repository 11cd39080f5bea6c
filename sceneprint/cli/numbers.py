"""Numbers on the command line, checked where they are read."""

from __future__ import annotations

import argparse


def whole(text: str) -> int:
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
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from {least} up")
    return number
