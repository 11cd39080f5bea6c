"""What an archive says of its members, and whether a name may be taken at its word.

name  --parts_of-->  parts of a relative path, or why there is none
"""

from __future__ import annotations

import re
import unicodedata
from dataclasses import dataclass

#: Members an archive may have: a hundred thousand files are a month of one robot.
MOST_MEMBERS = 100_000
#: Bytes of a member's name, and folders in it.
LONGEST_NAME, DEEPEST = 1024, 16
_LONGEST_PART = 200  #: bytes: no file system takes more than 255


@dataclass(frozen=True, slots=True)
class Member:
    """A member of an archive, not yet read.

    Parameters
    ----------
    name : as the archive writes it; of no use as a path
    size : of its content, bytes, as announced
    start : where its bytes begin in the archive; of a zip, where its own header does
    packed : bytes that it takes there
    deflated : whether they are packed
    checksum : CRC-32 of the content, or None where the archive has none
    trouble : why it cannot be read, or None
    """

    name: str
    size: int = 0
    start: int = 0
    packed: int = 0
    deflated: bool = False
    checksum: int | None = None
    trouble: str | None = None


class OddName(Exception):
    """A name that leads nowhere, or elsewhere; its text says why."""


def parts_of(name: str) -> tuple[str, ...]:
    """The parts of a member's name as a relative path.

    Returns
    -------
    parts : none of them empty, `.`, `..`, or with a character that is not printed

    Raises
    ------
    OddName : it is absolute, leads upwards, is too long or too deep, or cannot be printed.
    """
    text = name.replace("\\", "/")  # as some packers of Windows write them
    if len(name.encode(errors="replace")) > LONGEST_NAME:
        raise OddName(f"its name has more than {LONGEST_NAME} bytes")
    if text.startswith("/") or re.match(r"[A-Za-z]:", text):
        raise OddName("its name is absolute")
    parts = tuple(part for part in text.split("/") if part not in ("", "."))
    if ".." in parts:
        raise OddName("its name leads out of the archive")
    if not parts or not all(map(_is_plain, parts)):
        raise OddName("its name is empty, or has a character that cannot be printed")
    if len(parts) > DEEPEST:
        raise OddName(f"it lies below more than {DEEPEST} folders")
    if any(len(part.encode()) > _LONGEST_PART for part in parts):
        raise OddName(f"a part of its name has more than {_LONGEST_PART} bytes")
    return parts


def shown(name: str) -> str:
    """A member's name in a message: one line, of bounded length."""
    text = name if name.isprintable() else ascii(name)[1:-1]
    return text if len(text) <= 200 else f"{text[:120]}...{text[-60:]}"


def _is_plain(part: str) -> bool:
    # "C*": control, format, surrogate, private, unassigned
    return not any(unicodedata.category(letter).startswith("C") for letter in part)
