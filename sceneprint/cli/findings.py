"""What a look at one part of the machine has shown."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Verdict = Literal["ok", "note", "WRONG"]


@dataclass(frozen=True)
class Finding:
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
