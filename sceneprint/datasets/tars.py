"""The members of a tar, told by its headers alone; no header is believed beyond the file.

`tarfile` keeps whatever a header announces in memory, and follows links and sparse maps.

file  --tar_members-->  Member, ...
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from typing import BinaryIO

from sceneprint.datasets.members import LONGEST_NAME, MOST_MEMBERS, Member
from sceneprint.errors import UnreadableArchive

BLOCK = 512
_MAXIMUM_EXTRA = 65_536  #: bytes of a header that lengthens the next one
_REGULAR, _FOLDER = (b"0", b"\0", b"7"), b"5"
_ODD = {
    b"1": "it is a link", b"2": "it is a link", b"3": "it is a device", b"4": "it is a device",
    b"6": "it is a pipe", b"S": "it is a file with holes",
}  # fmt: skip


def is_tar_header(block: bytes) -> bool:
    """Whether a block is a header: its sum is the one that it tells."""
    if len(block) < BLOCK or not any(block[:BLOCK]):
        return False
    told = _octal(block[148:156])
    summed = sum(block[:148]) + 8 * ord(" ") + sum(block[156:BLOCK])
    return told == summed


def tar_members(file: BinaryIO) -> Iterator[Member]:
    """Yield the members; folders are left out, and what is odd has `trouble`.

    Where the tar is damaged or ends early, the last member says so: what comes before is sound.

    Parameters
    ----------
    file : that can be sought in; not compressed

    Raises
    ------
    UnreadableArchive : it has too many members, or not even the first one can be read.
    """
    end = file.seek(0, os.SEEK_END)
    place, count, last = 0, 0, ""
    longer: dict[str, str] = {}
    while place + BLOCK <= end:
        file.seek(place)
        block = file.read(BLOCK)
        if not any(block):
            return
        size = _number(block[124:136]) if is_tar_header(block) else None
        if size is None:
            if count == 0:
                raise UnreadableArchive("The tar is damaged at its start. Pack it again.")
            yield Member(last, trouble="the tar is damaged after it, and the rest cannot be found")
            return
        count += 1
        if count > 2 * MOST_MEMBERS:
            raise UnreadableArchive(
                f"The archive has more than {MOST_MEMBERS} members. Pack fewer into one."
            )
        kind, start = block[156:157], place + BLOCK
        place = start + -(-size // BLOCK) * BLOCK
        if kind in (b"L", b"x"):
            if size > _MAXIMUM_EXTRA or start + size > end:
                yield Member(last, trouble="the header after it is too long, or cut short")
                if start + size > end:
                    return
                continue
            longer |= _extra(kind, file.read(size))
            continue
        if kind in (b"K", b"g"):  # of links, and of all that follows: nothing we ask for
            continue
        size = int(longer["size"]) if "size" in longer else size
        place = start + -(-size // BLOCK) * BLOCK
        name, longer = longer.get("path") or _name(block), {}
        last = name
        if kind == _FOLDER or (kind in _REGULAR and name.endswith("/")):
            continue
        trouble = None if kind in _REGULAR else _ODD.get(kind, "it is no plain file")
        if start + size > end:
            trouble = "the archive ends within it"
        yield Member(name, size, start, size, trouble=trouble)


def _extra(kind: bytes, content: bytes) -> dict[str, str]:
    """What a header that comes before another one says of it: `path` and `size`."""
    if kind == b"L":
        return {"path": _text(content.rstrip(b"\0")[: LONGEST_NAME + 1])}
    found, place = dict[str, str](), 0
    while record := re.compile(rb"(\d{1,6}) (\w+)=").match(content, place):
        end = place + int(record[1])
        if end <= record.end() or end > len(content) or content[end - 1 : end] != b"\n":
            break
        value = content[record.end() : end - 1]
        if record[2] == b"path":
            found["path"] = _text(value[: LONGEST_NAME + 1])
        elif record[2] == b"size" and re.fullmatch(rb"\d{1,15}", value):
            found["size"] = value.decode()
        place = end
    return found


def _name(block: bytes) -> str:
    name, prefix = block[:100].partition(b"\0")[0], block[345:500].partition(b"\0")[0]
    has_prefix = prefix and block[257:263] == b"ustar\0"  # GNU's own has times there
    return _text(prefix + b"/" + name if has_prefix else name)


def _text(name: bytes) -> str:
    # what is no UTF-8 becomes characters that no path may have
    return name.decode("utf-8", "surrogateescape")


def _number(field: bytes) -> int | None:
    """A size: octal digits, or if they do not suffice, binary."""
    if field[0] == 0x80:
        size = int.from_bytes(field[1:], "big")
        return size if size < 1 << 50 else None
    return _octal(field)


def _octal(field: bytes) -> int | None:
    digits = field.strip(b" \0")
    return int(digits, 8) if re.fullmatch(rb"[0-7]{1,12}", digits) else None
