"""The members of a zip, told by its directory; read without believing it.

`zipfile` reads the whole directory into memory, whatever it announces.

file  --zip_members-->  Member, ...  --read_zipped-->  bytes
"""

from __future__ import annotations

import os
import stat
import struct
import zlib
from collections.abc import Iterator
from typing import BinaryIO

from sceneprint.datasets.members import MOST_MEMBERS, Member
from sceneprint.errors import UnreadableArchive

_END, _END64, _LOCATOR = b"PK\x05\x06", b"PK\x06\x06", b"PK\x06\x07"
_ENTRY, _LOCAL = b"PK\x01\x02", b"PK\x03\x04"
_ENCRYPTED = 0x1 | 0x40 | 0x2000
_UTF8 = 0x800
_STORED, _DEFLATED = 0, 8
_UNIX = 3
_FULL = 0xFFFFFFFF  #: stands for a number that is in an extra field
_DAMAGED = "The zip is damaged: {}. Pack it again, or copy it once more."


def zip_members(file: BinaryIO) -> Iterator[Member]:
    """Yield the members; folders are left out, and what is odd has `trouble`.

    Parameters
    ----------
    file : that can be sought in

    Raises
    ------
    UnreadableArchive : its directory is missing or damaged, or has too many entries.
    """
    end = file.seek(0, os.SEEK_END)
    count, start, directory_end = _directory(file, end)
    if count > MOST_MEMBERS:
        raise UnreadableArchive(
            f"The archive has {count} members, and at most {MOST_MEMBERS} are read. Pack fewer "
            "into one."
        )
    place = start
    for _ in range(count):
        file.seek(place)
        head = file.read(46)
        if len(head) < 46 or head[:4] != _ENTRY or place + 46 > directory_end:
            raise UnreadableArchive(_DAMAGED.format("its directory ends early"))
        (
            _, _, made, _, flags, method, _, _, checksum, packed, size,
            n_name, n_extra, n_comment, _, _, attributes, offset,
        ) = struct.unpack("<4sBBHHHHHIIIHHHHHII", head)  # fmt: skip
        name, extra = file.read(n_name), file.read(n_extra)
        place += 46 + n_name + n_extra + n_comment
        if len(name) < n_name or len(extra) < n_extra or place > directory_end:
            raise UnreadableArchive(_DAMAGED.format("its directory ends early"))
        size, packed, offset = _wide(extra, size, packed, offset)
        text = _text(name, flags)
        mode = attributes >> 16 if made == _UNIX else 0
        if text.endswith("/") or stat.S_ISDIR(mode):
            continue
        yield Member(
            text, size, offset, packed, method == _DEFLATED, checksum,
            _trouble(flags, method, mode, offset + packed > end),
        )  # fmt: skip


def read_zipped(file: BinaryIO, member: Member) -> bytes:
    """The content of a member without `trouble`, checked against its sum; of its size at most.

    Raises
    ------
    UnreadableArchive : it is damaged, or of another size than announced.
    """
    file.seek(member.start)
    head = file.read(30)
    if len(head) < 30 or head[:4] != _LOCAL:
        raise UnreadableArchive("it is damaged: no header is where it should begin")
    n_name, n_extra = struct.unpack_from("<HH", head, 26)
    file.seek(member.start + 30 + n_name + n_extra)
    data = file.read(member.packed)
    if member.deflated:
        stream = zlib.decompressobj(-zlib.MAX_WBITS)
        try:
            data = stream.decompress(data, member.size + 1)
        except zlib.error as cause:
            raise UnreadableArchive(f"it is damaged ({cause})") from cause
    if len(data) != member.size:
        raise UnreadableArchive(
            f"it has {'more' if len(data) > member.size else 'fewer'} bytes than the "
            f"{member.size} that are announced"
        )
    if zlib.crc32(data) != member.checksum:
        raise UnreadableArchive("it is damaged: its check sum is wrong")
    return data


def _directory(file: BinaryIO, end: int) -> tuple[int, int, int]:
    """Number of entries, and start and end of the directory."""
    tail_start = max(end - 22 - 0xFFFF, 0)
    file.seek(tail_start)
    tail = file.read(end - tail_start)
    place = tail.rfind(_END)
    if place < 0 or len(tail) - place < 22:
        raise UnreadableArchive(_DAMAGED.format("it ends early, and has no directory"))
    disk, first, here, count, size, start = struct.unpack_from("<HHHHII", tail, place + 4)
    place += tail_start
    if place >= 20:
        file.seek(place - 20)
        locator = file.read(20)
        if locator[:4] == _LOCATOR:
            file.seek(struct.unpack_from("<Q", locator, 8)[0] & (1 << 62) - 1)
            wide = file.read(56)
            if len(wide) < 56 or wide[:4] != _END64:
                raise UnreadableArchive(_DAMAGED.format("its directory is not where it says"))
            disk, first, here, count, size, start = struct.unpack_from("<IIQQQQ", wide, 16)
    if disk or first or here != count:
        raise UnreadableArchive("The zip is one of several parts. Pack it as one file.")
    if start + size > place:
        raise UnreadableArchive(_DAMAGED.format("its directory is not where it says"))
    return count, start, start + size


def _wide(extra: bytes, size: int, packed: int, start: int) -> tuple[int, int, int]:
    """Numbers of 64 bits in the place of those that are full."""
    numbers, place = [size, packed, start], 0
    while place + 4 <= len(extra):
        kind, length = struct.unpack_from("<HH", extra, place)
        field, place = extra[place + 4 : place + 4 + length], place + 4 + length
        if kind == 1:
            for i, number in enumerate(numbers):
                if number == _FULL and len(field) >= 8:
                    numbers[i] = struct.unpack_from("<Q", field)[0] & (1 << 62) - 1
                    field = field[8:]
    return numbers[0], numbers[1], numbers[2]


def _text(name: bytes, flags: int) -> str:
    try:
        return name.decode("utf-8")  # most write it, whether they say so or not
    except UnicodeDecodeError:
        return name.decode("utf-8", "surrogateescape") if flags & _UTF8 else name.decode("cp437")


def _trouble(flags: int, method: int, mode: int, beyond: bool) -> str | None:
    if flags & _ENCRYPTED:
        return "it is encrypted"
    if stat.S_ISLNK(mode):
        return "it is a link"
    if stat.S_IFMT(mode) not in (0, stat.S_IFREG):
        return "it is no plain file"
    if method not in (_STORED, _DEFLATED):
        return f"it is packed by method {method}, and only stored and deflated ones are read"
    return "it begins or ends beyond the archive" if beyond else None
