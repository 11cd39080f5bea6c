"""Reading of frames from tar and zip archives without unpacking: archives cannot choose paths.

file  --open_archive-->  Archive: sequences, refused, data_of(reference)
file  --tar_entries, zip_entries-->  ArchiveEntry, ...  --read_entry-->  bytes
name  --parts_of-->  parts of a relative path

Only files with cameras, poses and lists are unpacked, into a private folder and with limits on size
and name. The folder has an empty file for each image, so `find_each` finds sequences in it as in
any folder. Images are read from the archive when they are needed.

`tarfile` and `zipfile` trust the sizes in headers. Therefore, this module limits the number of
members, the size of headers, and the names.
"""

from __future__ import annotations

import bz2
import errno
import lzma
import os
import re
import stat
import struct
import sys
import tarfile
import tempfile
import unicodedata
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import IO, Any, BinaryIO, Literal, Protocol, cast

from sceneprint.errors import DatasetError, SceneprintError, UnreadableArchive
from sceneprint.formats.dataset.frame_names import is_beside_depth, is_image
from sceneprint.formats.dataset.frame_reference import FrameReference, FrameSequence
from sceneprint.formats.dataset.sequences import find_each
from sceneprint.formats.exports.nerfstudio import TRANSFORMS, ScaledNpy
from sceneprint.formats.exports.polycam import CAMERAS
from sceneprint.formats.exports.record3d import DEPTH_SUFFIX, FRAMES
from sceneprint_client.files import MAXIMUM_CLOUD_BYTES, MAXIMUM_IMAGE_BYTES
from sceneprint_client.formats import is_cloud, titles_of
from sceneprint_client.frame_files import POSE_FOLDERS, rows_as_npy
from sceneprint_client.sidecars import CLOUDS_FILE, INTRINSICS_FILE

# The standard library reads the members of an archive, within limits.

#: Maximum number of members, approximately as many as a robot records in a month.
MOST_MEMBERS = 100_000
#: Maximum length of a member's name, bytes, and maximum number of folders in it.
LONGEST_NAME, DEEPEST = 1024, 16
_LONGEST_PART = 200  #: bytes; file systems accept at most 255
_ENCRYPTED = 0x1 | 0x40 | 0x2000  #: flags of an encrypted zip member
_UNIX = 3  #: `create_system` of zip members with Unix file modes
#: Exceptions that the standard library raises for malformed archives.
_MALFORMED = (
    tarfile.TarError, zipfile.BadZipFile, zlib.error, struct.error, EOFError, LookupError,
    OverflowError, RuntimeError, ValueError,
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class ArchiveEntry:
    """A member of an archive; its content has not been read.

    Parameters
    ----------
    name : name in the archive; never used as a path
    size : declared size of the content, bytes
    start : offset of the content in the archive, bytes
    packed : size of the content in the archive, bytes
    open : function that opens the content of a zip member; None for a tar
    trouble : reason why the member cannot be read; None if it can
    """

    name: str
    size: int = 0
    start: int = 0
    packed: int = 0
    open: Callable[[], IO[bytes]] | None = None
    trouble: str | None = None


class UnusableName(Exception):
    """Error for a member's name that is not a relative path; the message states the reason."""


def parts_of(name: str) -> tuple[str, ...]:
    """Split a member's name into the parts of a relative path.

    Returns
    -------
    parts : printable names, without empty parts, `.` and `..`

    Raises
    ------
    UnusableName : If the name is absolute, has a part `..`, is too long or too deep, or has a
        character that is not printable.
    """
    text = name.replace("\\", "/")  # some Windows programs write backslashes
    if len(name.encode(errors="replace")) > LONGEST_NAME:
        raise UnusableName(f"its name has more than {LONGEST_NAME} bytes")
    if text.startswith("/") or re.match(r"[A-Za-z]:", text):
        raise UnusableName("its name is absolute")
    parts = tuple(part for part in text.split("/") if part not in ("", "."))
    if ".." in parts:
        raise UnusableName("its name points outside the archive")
    if not parts or not all(map(_is_plain, parts)):
        raise UnusableName("its name is empty or has a character that is not printable")
    if len(parts) > DEEPEST:
        raise UnusableName(f"it is nested in more than {DEEPEST - 1} folders")
    if any(len(part.encode()) > _LONGEST_PART for part in parts):
        raise UnusableName(f"a part of its name has more than {_LONGEST_PART} bytes")
    return parts


def printable_name(name: str) -> str:
    """Return a member's name as one printable line of at most 200 characters."""
    text = name if name.isprintable() else ascii(name)[1:-1]
    return text if len(text) <= 200 else f"{text[:120]}...{text[-60:]}"


def _is_plain(part: str) -> bool:
    # categories "C*": control, format, surrogate, private use, unassigned
    return not any(unicodedata.category(letter).startswith("C") for letter in part)


#: Maximum size of a member's headers, and of a zip's directory, bytes. The standard library reads
#: both into memory.
_MAXIMUM_HEADERS, _MAXIMUM_DIRECTORY = 65_536, 64 << 20
_DIRECTORY_ENTRY = b"PK\x01\x02"
BLOCK = tarfile.BLOCKSIZE
PIECE = 1 << 20  #: maximum size of decompressed pieces, bytes
_DAMAGED = "the tar is damaged after this member, and the rest cannot be read"


class _HeaderFile:
    """A file from which the standard library may read at most `allowance` more bytes."""

    def __init__(self, file: BinaryIO, allowance: int) -> None:
        self.allowance = allowance
        self.seek, self.tell, self._read = file.seek, file.tell, file.read

    def read(self, size: int = -1) -> bytes:
        data = self._read(size if 0 <= size <= self.allowance else self.allowance + 1)
        self.allowance -= len(data)
        if self.allowance < 0:
            raise UnreadableArchive(
                "The headers of the archive are too long. Pack the archive again."
            )
        if data.count(_DIRECTORY_ENTRY) > MOST_MEMBERS:
            raise _too_many_members()
        return data

    def seekable(self) -> bool:
        return True


def is_tar_header(block: bytes) -> bool:
    """Return whether a block is the header of a tar member."""
    try:
        tarfile.TarInfo.frombuf(block[:BLOCK], "utf-8", "surrogateescape")
    except tarfile.HeaderError:
        return False
    return True


def tar_entries(file: BinaryIO) -> Iterator[ArchiveEntry]:
    """Yield the members of a tar except folders; unreadable members have `trouble`.

    If the tar is damaged or truncated, the last member has `trouble`.

    `file`: seekable tar without compression. Raise UnreadableArchive if the tar has too many
    members, or the first member is unreadable.
    """
    end = file.seek(0, os.SEEK_END)
    file.seek(0)
    headers, last = _HeaderFile(file, _MAXIMUM_HEADERS), ""
    try:
        # `tarfile.open` would skip damaged headers silently
        tar = tarfile.TarFile(fileobj=cast("BinaryIO", headers), encoding="utf-8")
    except (UnreadableArchive, *_MALFORMED) as error:
        raise UnreadableArchive("The tar is damaged at its start. Pack it again.") from error
    for _ in range(2 * MOST_MEMBERS):
        headers.allowance = _MAXIMUM_HEADERS
        try:
            info = tar.next()
        except (UnreadableArchive, *_MALFORMED):
            yield ArchiveEntry(last, trouble=_DAMAGED)
            return
        if info is None:  # the end of the archive, or an invalid header
            file.seek(tar.offset)
            if any(file.read(BLOCK)):
                yield ArchiveEntry(last, trouble=_DAMAGED)
            return
        # TarFile stores all members in memory; typeshed lacks the attribute
        cast("Any", tar).members.clear()
        tar.pax_headers = {}
        if info.size < 0:
            yield ArchiveEntry(last, trouble=_DAMAGED)
            return
        last = info.name
        cut = tar.offset > end < info.offset_data + info.size
        if not info.isdir() and not last.endswith("/"):
            trouble = "the archive ends within this member" if cut else _tar_trouble(info)
            yield ArchiveEntry(last, info.size, info.offset_data, info.size, trouble=trouble)
        if cut:
            return
    raise _too_many_members()


def _tar_trouble(info: tarfile.TarInfo) -> str | None:
    if info.issym() or info.islnk():
        return "it is a link"
    if info.isdev():
        return "it is a pipe" if info.isfifo() else "it is a device"
    if info.issparse():
        return "it is a sparse file"
    return None if info.isreg() else "it is not a regular file"


def zip_entries(file: BinaryIO) -> Iterator[ArchiveEntry]:
    """Yield the members of a zip except folders; unreadable members have `trouble`.

    `file`: seekable zip, which must stay open. Raise UnreadableArchive if the directory is missing
    or damaged, or has too many entries.
    """
    end = file.seek(0, os.SEEK_END)
    headers = _HeaderFile(file, _MAXIMUM_DIRECTORY)
    try:
        packed = _open_zip(headers)
    except _MALFORMED as error:
        raise UnreadableArchive(
            f"The zip is damaged or truncated ({error}). Copy or pack it again."
        ) from error
    headers.allowance = sys.maxsize  # members are read in pieces
    for info in packed.infolist():
        mode = info.external_attr >> 16 if info.create_system == _UNIX else 0
        if info.filename.endswith("/") or stat.S_ISDIR(mode):
            continue
        beyond = info.header_offset < 0 or info.header_offset + info.compress_size > end
        yield ArchiveEntry(
            info.filename, info.file_size, info.header_offset, info.compress_size,
            partial(packed.open, info), _zip_trouble(info, mode, beyond),
        )  # fmt: skip


def _open_zip(headers: _HeaderFile) -> zipfile.ZipFile:
    file = cast("BinaryIO", headers)
    try:  # most programs write UTF-8, with or without the UTF-8 flag
        return zipfile.ZipFile(file, metadata_encoding="utf-8")
    except UnicodeDecodeError:
        return zipfile.ZipFile(file)


def _zip_trouble(info: zipfile.ZipInfo, mode: int, beyond: bool) -> str | None:
    if info.flag_bits & _ENCRYPTED:
        return "it is encrypted"
    if stat.S_ISLNK(mode):
        return "it is a link"
    if stat.S_IFMT(mode) not in (0, stat.S_IFREG):
        return "it is not a regular file"
    # LZMA is rejected too, because the file determines the memory of its decoder
    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        return (
            f"it is compressed with method {info.compress_type}; only stored and deflated members "
            "are supported"
        )
    return "it extends beyond the archive" if beyond else None


def read_entry(file: BinaryIO, entry: ArchiveEntry) -> bytes:
    """Read the content of a member without `trouble`.

    Raise UnreadableArchive if the content is damaged, or its size differs from the declared size.
    """
    if entry.open is None:
        file.seek(entry.start)
        return file.read(entry.size)
    try:
        with entry.open() as content:
            data = b"".join(iter(partial(content.read, PIECE), b""))
    except _MALFORMED as cause:
        raise UnreadableArchive(f"it is damaged ({cause})") from cause
    if len(data) != entry.size:
        raise UnreadableArchive(
            f"it is damaged (it has {len(data)} bytes, but declares {entry.size})"
        )
    return data


def _too_many_members() -> UnreadableArchive:
    return UnreadableArchive(
        f"The archive has more than {MOST_MEMBERS} members. Split it into several archives."
    )


# Tars are decompressed while they are received, because members are read later by random access,
# possibly from an object store. `gzip.open` and similar functions pull bytes from a file, but the
# chunks of a request are pushed. Therefore, `Inflater` calls the decompressors itself; it stops
# decompression bombs early.
#
# chunks  --Inflater.pieces-->  bytes of a zip or of a plain tar

#: Maximum ratio of content size to archive size, and amount of content that is exempt from this
#: limit, bytes. Depth images are already compressed; NPY files of noisy depth shrink to a fifth.
MOST_RATIO, FREE = 50, 64 << 20
#: Maximum number of concatenated streams; parallel compressors write many streams.
_MAXIMUM_STREAMS = 65_536
_XZ_MEMORY = 192 << 20  #: bytes; `xz -9` needs less

_MAGIC = (b"PK\x03\x04", b"\x1f\x8b", b"BZh", b"\xfd7zXZ\x00")
_KINDS = "a zip, or a tar (plain, .gz, .bz2 or .xz)"
_NO_TAR = f"The compressed file is not a tar. Decompress a recording or frame; else send {_KINDS}."


class _Stream(Protocol):
    @property
    def eof(self) -> bool: ...

    @property
    def unused_data(self) -> bytes: ...

    def decompress(self, data: bytes, max_length: int, /) -> bytes: ...


def is_archive(head: bytes) -> bool:
    """Return whether a file that starts with `head` is a zip, a tar or a compressed file."""
    return head.startswith(_MAGIC) or is_tar_header(head[:BLOCK])


class Inflater:
    """A decompressor of tars that are received in chunks of any size; zips pass unchanged.

    `most_bytes`: maximum size of the decompressed archive.
    """

    def __init__(self, most_bytes: int) -> None:
        self._most = most_bytes
        self._head: bytes | None = b""
        self._packing: bytes | None = None  # magic number of the compression
        self._stream: _Stream | None = None
        self._streams = 0
        self._start = b""  # first bytes of the tar
        self.bytes_in, self.bytes_out = 0, 0

    def pieces(self, chunk: bytes) -> Iterator[bytes]:
        """Decompress the next chunk of the archive; yield pieces of at most PIECE bytes.

        Raise UnreadableArchive if the file is not an archive, is damaged, or exceeds `most_bytes`.
        """
        self.bytes_in += len(chunk)
        if self._head is not None:
            self._head += chunk
            if len(self._head) < BLOCK:
                return
            chunk, self._head = self._head, None
            self._open(chunk)
        yield from self._checked_pieces(chunk)

    def end(self) -> Iterator[bytes]:
        """Yield the remaining pieces after the last chunk; raise errors as `pieces` does."""
        if self._head is not None:  # shorter than a block, such as an empty zip
            chunk, self._head = self._head, None
            self._open(chunk)
            yield from self._checked_pieces(chunk)
        if self._stream is not None:
            raise UnreadableArchive("The archive is truncated. Copy or pack it again.")
        if self._packing is not None and len(self._start) < BLOCK:
            raise UnreadableArchive(_NO_TAR)

    def _open(self, head: bytes) -> None:
        if not head:
            raise UnreadableArchive("The archive is empty. Copy or pack it again.")
        if not is_archive(head):
            raise UnreadableArchive(
                f"This is not a supported archive. Send a sequence as {_KINDS}, and a single frame "
                "without an archive."
            )
        for magic in _MAGIC[1:]:
            if head.startswith(magic):
                self._packing, self._stream = magic, _open_stream(magic)

    def _checked_pieces(self, chunk: bytes) -> Iterator[bytes]:
        for piece in [chunk] if self._packing is None else self._inflate(chunk):
            self.bytes_out += len(piece)
            if self.bytes_out > self._most or self.bytes_out > FREE + MOST_RATIO * self.bytes_in:
                raise UnreadableArchive(
                    f"The content of the archive exceeds {self._most} bytes or {MOST_RATIO} times "
                    "the size of the archive. Depth images do not compress this well. Send the "
                    "archive in parts, or with less compression."
                )
            if self._packing is not None and len(self._start) < BLOCK:
                self._start += piece[: BLOCK - len(self._start)]
                if len(self._start) == BLOCK and not is_tar_header(self._start):
                    raise UnreadableArchive(_NO_TAR)
            yield piece

    def _inflate(self, chunk: bytes) -> Iterator[bytes]:
        """Yield the decompressed pieces of a chunk; the archive may consist of several streams."""
        data = chunk
        while True:
            if self._stream is None:  # between two streams, or after the last stream
                data = data.lstrip(b"\0")
                if not data:
                    return
                assert self._packing is not None
                self._streams += 1
                if self._streams > _MAXIMUM_STREAMS:
                    raise UnreadableArchive(
                        f"The archive has more than {_MAXIMUM_STREAMS} compressed streams. Pack it "
                        "again as one stream."
                    )
                self._stream = _open_stream(self._packing)
            try:
                piece = self._stream.decompress(data, PIECE)
            except (zlib.error, OSError, EOFError, ValueError, lzma.LZMAError) as cause:
                raise UnreadableArchive(
                    f"The archive is damaged ({cause}). Copy or pack it again."
                ) from cause
            if piece:
                yield piece
            if self._stream.eof:
                data, self._stream = self._stream.unused_data, None
                continue
            # zlib returns unused input in this attribute; the other decompressors buffer it
            data = getattr(self._stream, "unconsumed_tail", b"")
            if not data and len(piece) < PIECE:
                return


def _open_stream(magic: bytes) -> _Stream:
    if magic == _MAGIC[1]:
        return zlib.decompressobj(16 + zlib.MAX_WBITS)
    if magic == _MAGIC[2]:
        return bz2.BZ2Decompressor()
    return lzma.LZMADecompressor(lzma.FORMAT_XZ, memlimit=_XZ_MEMORY)


#: Default name of an archive and its sequence.
DEFAULT_NAME = "import"
_LISTS = ("depth.txt", "groundtruth.txt", TRANSFORMS)
_TEXTS = (INTRINSICS_FILE, CLOUDS_FILE, "TrainSplit.txt", "TestSplit.txt")
#: Maximum size of a list, of any other text file, and of all text files together, bytes.
_MAXIMUM_LIST, _MAXIMUM_TEXT, _MAXIMUM_TEXTS = 1 << 26, 1 << 16, 1 << 27
_HEAD_BYTES = 1024  #: number of first bytes that contain the size of an image
#: Nested private folders, because camera files are also searched for in parent folders.
_PARENTS = ("0", "1", "2", "3", "4")

#: Error codes for an invalid name, or for a file and a folder with the same name.
_CLASHES = (errno.EEXIST, errno.ENOTDIR, errno.EISDIR, errno.ENAMETOOLONG, errno.EINVAL)

Role = Literal["image", "text"]


class Archive:
    """An open archive; see `open_archive`.

    `root`: private folder that represents the content of the archive.
    """

    def __init__(self, file: BinaryIO, root: Path) -> None:
        self._file, self._root = file, root
        self._members: dict[Path, ArchiveEntry] = {}
        #: Folders that are omitted because of their names; a note lists them
        self._omitted: set[tuple[str, ...]] = set()
        #: Names of rejected members and sequences, with the reasons
        self.refused: list[tuple[str, str]] = []
        #: Number of members outside all sequences, such as colour images
        self.ignored = 0
        #: Whether the archive has depth files of Record3D
        self.is_record3d = False
        #: Sequences in the archive; the content of their frames has not been read
        self.sequences: tuple[FrameSequence, ...] = ()

    def name_of(self, reference: FrameReference) -> str:
        """Return the name of a frame's member in the archive."""
        return printable_name(self._members[reference.path].name)

    def size_of(self, reference: FrameReference) -> int:
        """Return the declared size of a frame's member, bytes."""
        return self._members[reference.path].size

    def data_of(self, reference: FrameReference) -> bytes:
        """Return the bytes of a frame.

        Raise UnreadableArchive if the member is damaged, encrypted or too large.
        """
        limit = MAXIMUM_IMAGE_BYTES if reference.cloud is None else MAXIMUM_CLOUD_BYTES
        data = self._read(self._members[reference.path], limit)
        if reference.row is not None:
            return rows_as_npy(data, reference.row)
        # the frame's camera file cannot state the unit of such depth images, so they are converted
        return reference.source.converted(data) if isinstance(reference.source, ScaledNpy) else data

    def message_of(self, error: SceneprintError) -> str:
        """Return the message of an error without the path of the private folder."""
        return str(error).replace(f"{self._root}/", "")

    def _read(self, member: ArchiveEntry, limit: int) -> bytes:
        name = printable_name(member.name)
        if member.trouble is not None:
            raise UnreadableArchive(f"{name}: {member.trouble}. Pack it again as a plain file.")
        if max(member.size, member.packed) > limit:
            raise UnreadableArchive(
                f"{name}: it has {member.size} bytes; the limit is {limit}. Check that it is the "
                "right file."
            )
        try:
            return read_entry(self._file, member)
        except UnreadableArchive as error:
            raise UnreadableArchive(f"{name}: {error}. Pack it again.") from error

    def lay_out(self, name: str) -> None:
        """Create the files of the private folder, find the sequences in it, and set `sequences`,
        `refused`, `ignored` and `is_record3d`.

        `name`: name of the scene if the archive has no folder for it. Raise UnreadableArchive if
        the content is too large or damaged, or two scenes have the same name.
        """
        members = self._sequence_members()
        tops = {parts[0] for parts, _, _ in members}
        single = len(tops) == 1 and all(len(parts) > 1 for parts, _, _ in members)
        above = self._root.joinpath(name)
        weight = self._file.seek(0, 2)
        # members of a zip may overlap, so the archive's size does not limit their total size
        unpacked = sum(member.size for _, member, _ in members)
        if unpacked > FREE + MOST_RATIO * weight:
            raise UnreadableArchive(
                f"The content of the archive has {unpacked} bytes, more than {MOST_RATIO} times "
                "the size of the archive. Depth images do not compress this well. Pack them with "
                "less compression."
            )
        budget = _MAXIMUM_TEXTS
        # camera files of exports describe colour images, so the sizes of depth images are needed
        of_exports = any(_is_export_file(parts) for parts, _, _ in members)
        for parts, member, role in members:
            path = above.joinpath(*parts)
            if path in self._members:
                self._refuse(member, member.trouble or "an earlier member has the same name")
                continue
            try:
                path.parent.mkdir(parents=True, exist_ok=True)
                path.touch(exist_ok=False)
            except OSError as error:
                if error.errno not in _CLASHES:  # another error, such as a full disk
                    raise
                self._refuse(member, "its name conflicts with the name of another member")
                continue
            self._members[path] = member
            if role == "image" and of_exports and member.trouble is None:
                path.write_bytes(self._head(member))
            if role == "text" and member.trouble is not None:
                self._refuse(member, member.trouble)
            elif role == "text":
                budget -= self._unpack(path, member, budget)
        for parts in self._omitted:
            with suppress(FileExistsError, NotADirectoryError):  # a member already has this name
                above.joinpath(*parts).mkdir(parents=True, exist_ok=True)
        root = above / tops.pop() if single else above
        if root.is_dir():
            try:
                self.sequences, refused = find_each(root)
            except DatasetError as error:
                raise UnreadableArchive(self.message_of(error)) from error
            self.refused += [
                (printable_name(name), self.message_of(error)) for name, error in refused
            ]

    def _head(self, member: ArchiveEntry) -> bytes:
        """Return the first bytes of a member; b"" if the member is unreadable."""
        if member.open is None:
            self._file.seek(member.start)
            return self._file.read(min(_HEAD_BYTES, member.size))
        try:
            with member.open() as content:
                return content.read(_HEAD_BYTES)
        except _MALFORMED:
            return b""

    def _unpack(self, path: Path, member: ArchiveEntry, budget: int) -> int:
        """Unpack a text file of at most `budget` bytes, and return its size.

        An unreadable file remains empty, and is added to `refused`.
        """
        limit = min(_MAXIMUM_LIST if path.name in _LISTS else _MAXIMUM_TEXT, budget)
        try:
            data = self._read(member, limit)
        except UnreadableArchive as error:
            self.refused.append((printable_name(member.name), str(error)))
            return 0
        path.write_bytes(data)
        return len(data)

    def _sequence_members(self) -> list[tuple[tuple[str, ...], ArchiveEntry, Role]]:
        """Return (name parts, entry, role) of each member that may belong to a sequence.

        Count the other members in `ignored`, and add unusable ones to `refused`.
        """
        members: list[tuple[tuple[str, ...], ArchiveEntry, Role]] = []
        for count, member in enumerate(_read_entries(self._file), start=1):
            if count > MOST_MEMBERS:
                raise _too_many_members()
            try:
                parts = parts_of(member.name)
            except UnusableName as error:
                self._refuse(member, str(error))
                continue
            role = _select_role(parts)
            if role is not None:
                members.append((parts, member, role))
            elif member.trouble is not None and not member.size:  # a link, or a damaged tar
                self._refuse(member, member.trouble)
            else:
                self.ignored += 1
                self.is_record3d |= parts[-2:-1] == (FRAMES,) and parts[-1].endswith(DEPTH_SUFFIX)
                omitted = None if _is_hidden(parts) else _omitted_folder(parts)
                if omitted is not None:
                    self._omitted.add(omitted)
        return members

    def _refuse(self, member: ArchiveEntry, reason: str) -> None:
        self.refused.append(
            (printable_name(member.name), f"{printable_name(member.name)}: {reason}.")
        )


@contextmanager
def open_archive(file: BinaryIO, folder: Path, name: str = DEFAULT_NAME) -> Iterator[Archive]:
    """Yield an open archive with the sequences in it.

    Parameters
    ----------
    file : zip, or tar without compression; it must stay open while the archive is used
    folder : parent of the private folder, which is removed at the end
    name : name of the scene if the archive has no folder for it; a single part of a path

    Raises
    ------
    UnreadableArchive : If the file is not an archive, is damaged, exceeds a limit, has no depth, or
        has two scenes with the same name.
    OSError : If the folder cannot be written.
    """
    with tempfile.TemporaryDirectory(prefix="archive-", dir=folder) as private:
        archive = Archive(file, Path(private).joinpath(*_PARENTS).absolute())
        try:
            own = parts_of(name)[-1]
        except UnusableName as error:
            raise UnreadableArchive(
                f"The archive cannot be named {printable_name(name)}: {error}. Choose another name."
            ) from error
        archive.lay_out(own)
        if not archive.sequences and archive.is_record3d:
            raise UnreadableArchive(
                "This is a Record3D capture, and the service cannot decompress the depth of such "
                "captures. Upload it with `sceneprint upload MAP FILE.r3d`."
            )
        if not archive.sequences and not archive.refused:
            raise UnreadableArchive(
                "The archive has no depth images or clouds; archives within it are not read. Pack "
                "a 7-Scenes scene or sequence, a TUM RGB-D folder (depth.txt), a folder of depth "
                f"images ({titles_of('depth')}) with its intrinsics.json, a folder of clouds "
                f"({titles_of('cloud')}), or an export of Polycam or nerfstudio."
            )
        yield archive


def _read_entries(file: BinaryIO) -> Iterator[ArchiveEntry]:
    file.seek(0)
    head = file.read(BLOCK)
    if is_tar_header(head):
        return tar_entries(file)
    if head.startswith((b"PK\x03\x04", b"PK\x05\x06")):
        return zip_entries(file)
    raise UnreadableArchive("This is neither a zip nor a tar. Pack the sequence again.")


def _is_export_file(parts: tuple[str, ...]) -> bool:
    """Return whether a name denotes a camera or pose file in another system's export."""
    *folders, name = parts
    of_camera = name.lower().endswith(".json") and folders[-1:] in ([folder] for folder in CAMERAS)
    return of_camera or name == TRANSFORMS


def _is_hidden(parts: tuple[str, ...]) -> bool:
    return any(part.startswith(".") or part == "__MACOSX" for part in parts)


def _omitted_folder(parts: tuple[str, ...]) -> tuple[str, ...] | None:
    """Return the path of a member's first folder named after colour or infrared images, or None.

    The topmost folder is skipped, because it may be the packed data set, whose name is arbitrary.
    """
    ends = (end for end in range(2, len(parts)) if is_beside_depth(parts[end - 1]))
    end = next(ends, None)
    return None if end is None else parts[:end]


def _select_role(parts: tuple[str, ...]) -> Role | None:
    """Return the role that a member's name indicates; None for other members."""
    *folders, name = parts
    if _is_hidden(parts) or _omitted_folder(parts) is not None:
        return None
    # `find_pose_file` assigns pose files to frames
    is_pose = name.endswith(".txt") and ("pose" in name or {*folders[-1:]} & {*POSE_FOLDERS})
    if name in _TEXTS or name in _LISTS or is_pose or _is_export_file(parts):
        return "text"
    if is_image(name) and not name.lower().endswith(".color.png"):
        return "image"
    if is_cloud(name):
        return "image"
    return None
