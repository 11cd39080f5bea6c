"""What `sceneprint doctor` has found by one look."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Verdict = Literal["ok", "note", "WRONG"]

#: Free space below which uploads are soon refused, and below which it is time to look, bytes.
LEAST_FREE, LITTLE_FREE = 100 << 20, 5 << 30
#: Clocks that differ by more are told, seconds.
APART_S = 2.0


@dataclass(frozen=True)
class Check:
    """What one look has shown.

    Parameters
    ----------
    verdict : ok; note: something optional is missing, or will be made when it is needed; WRONG:
        something needed is not there
    subject : what was looked at
    text : what is there, and what to do
    """

    verdict: Verdict
    subject: str
    text: str


def disk_check(subject: str, free: int) -> Check:
    """Whether there is room for frames to come.

    Parameters
    ----------
    subject : whose disk it is
    free : bytes left on it
    """
    text = f"{free / 1e9:.1f} GB free; a frame takes about 0.8 MB"
    if free < LEAST_FREE:
        return Check("WRONG", subject, f"{text}. Free some space, or uploads will be rejected.")
    return Check("note" if free < LITTLE_FREE else "ok", subject, text)


def seconds_apart(before: float, there: float, after: float) -> float:
    """How much two clocks differ at least, seconds.

    Parameters
    ----------
    before, after : of this clock, when the other one was asked and when its answer was there
    there : what the other one said
    """
    return max(before - there, there - after, 0.0)
