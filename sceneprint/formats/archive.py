"""Read frames in tar and zip files in place, so that no archive decides where a file is written.

file  --open_archive-->  Archive: sequences, refused, frame_of(reference)
file  --tar_entries, zip_entries-->  ArchiveEntry, ...  --read_entry-->  bytes
name  --parts_of-->  parts of a relative path

Only files of cameras, poses and lists are unpacked, into a private folder, with limits on their
size and names. Images are empty files there, so `find_each` finds sequences as it does on a disk.
An image is read from the archive when it is needed.

`tarfile` and `zipfile` trust the sizes in headers. This module limits the number of members, the
size of headers, and the names.
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
from contextlib import contextmanager
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

# Members of a tar or a zip, read by the standard library within limits.

#: Maximum number of members: a hundred thousand files are a month of one robot.
MOST_MEMBERS = 100_000
#: Maximum length of a member's name, bytes, and maximum number of folders in it.
LONGEST_NAME, DEEPEST = 1024, 16
_LONGEST_PART = 200  #: bytes: no file system takes more than 255
_ENCRYPTED = 0x1 | 0x40 | 0x2000  #: flags of a zip's member
_UNIX = 3  #: system whose modes a zip's member may have
#: What the standard library raises for malformed archives.
_MALFORMED = (
    tarfile.TarError, zipfile.BadZipFile, zlib.error, struct.error, EOFError, LookupError,
    OverflowError, RuntimeError, ValueError,
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class ArchiveEntry:
    """A member of an archive that has not been read.

    Parameters
    ----------
    name : name in the archive; never used as a path
    size : announced size of the content, bytes
    start : offset of the content in a tar
    packed : size of the content in the tar, bytes
    open : opens the content of a zip's member
    trouble : reason why the member cannot be read, or None
    """

    name: str
    size: int = 0
    start: int = 0
    packed: int = 0
    open: Callable[[], IO[bytes]] | None = None
    trouble: str | None = None


class OddName(Exception):
    """A member's name cannot be used as a relative path; the message says why."""


def parts_of(name: str) -> tuple[str, ...]:
    """Return the parts of a member's name as a relative path.

    Returns
    -------
    parts : printable names; none is empty, `.` or `..`

    Raises
    ------
    OddName : The name is absolute, leads upwards, is too long or too deep, or not printable.
    """
    text = name.replace("\\", "/")  # some programs for Windows write backslashes
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


def printable_name(name: str) -> str:
    """Return a member's name for a message: one line of limited length."""
    text = name if name.isprintable() else ascii(name)[1:-1]
    return text if len(text) <= 200 else f"{text[:120]}...{text[-60:]}"


def _is_plain(part: str) -> bool:
    # "C*": control, format, surrogate, private, unassigned
    return not any(unicodedata.category(letter).startswith("C") for letter in part)


#: Maximum sizes of one member's headers and of a zip's directory, bytes: the standard library
#: reads them into memory.
_MAXIMUM_HEADERS, _MAXIMUM_DIRECTORY = 65_536, 64 << 20
_DIRECTORY_ENTRY = b"PK\x01\x02"
BLOCK = tarfile.BLOCKSIZE
PIECE = 1 << 20  #: size of the pieces that are decompressed, bytes
_DAMAGED = "the tar is damaged after it, and the rest cannot be found"


class _HeaderFile:
    """A file from which the standard library may read `allowance` more bytes."""

    def __init__(self, file: BinaryIO, allowance: int) -> None:
        self.allowance = allowance
        self.seek, self.tell, self._read = file.seek, file.tell, file.read

    def read(self, size: int = -1) -> bytes:
        data = self._read(size if 0 <= size <= self.allowance else self.allowance + 1)
        self.allowance -= len(data)
        if self.allowance < 0:
            raise UnreadableArchive("The headers of the archive are too long. Pack it again.")
        if data.count(_DIRECTORY_ENTRY) > MOST_MEMBERS:
            raise _too_many()
        return data

    def seekable(self) -> bool:
        return True


def is_tar_header(block: bytes) -> bool:
    """Return whether a block is the header of a tar's member."""
    try:
        tarfile.TarInfo.frombuf(block[:BLOCK], "utf-8", "surrogateescape")
    except tarfile.HeaderError:
        return False
    return True


def tar_entries(file: BinaryIO) -> Iterator[ArchiveEntry]:
    """Yield the members of a tar except folders; unreadable members have `trouble`.

    If the tar is damaged or truncated, the last member says so, and those before it are sound.

    Parameters
    ----------
    file : a seekable file that is not compressed

    Raises
    ------
    UnreadableArchive : There are too many members, or the first is unreadable.
    """
    end = file.seek(0, os.SEEK_END)
    file.seek(0)
    headers, last = _HeaderFile(file, _MAXIMUM_HEADERS), ""
    try:
        # TarFile itself, because `tarfile.open` continues after an error
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
        if info is None:  # the end, or an unknown header
            file.seek(tar.offset)
            if any(file.read(BLOCK)):
                yield ArchiveEntry(last, trouble=_DAMAGED)
            return
        # TarFile keeps all members and their headers; the attribute is missing in typeshed
        cast("Any", tar).members.clear()
        tar.pax_headers = {}
        if info.size < 0:
            yield ArchiveEntry(last, trouble=_DAMAGED)
            return
        last = info.name
        cut = tar.offset > end < info.offset_data + info.size
        if not info.isdir() and not last.endswith("/"):
            trouble = "the archive ends within it" if cut else _tar_trouble(info)
            yield ArchiveEntry(last, info.size, info.offset_data, info.size, trouble=trouble)
        if cut:
            return
    raise _too_many()


def _tar_trouble(info: tarfile.TarInfo) -> str | None:
    if info.issym() or info.islnk():
        return "it is a link"
    if info.isdev():
        return "it is a pipe" if info.isfifo() else "it is a device"
    if info.issparse():
        return "it is a file with holes"
    return None if info.isreg() else "it is no plain file"


def zip_entries(file: BinaryIO) -> Iterator[ArchiveEntry]:
    """Yield the members of a zip except folders; unreadable members have `trouble`.

    Parameters
    ----------
    file : a seekable file that stays open

    Raises
    ------
    UnreadableArchive : The directory is missing or damaged, or has too many entries.
    """
    end = file.seek(0, os.SEEK_END)
    headers = _HeaderFile(file, _MAXIMUM_DIRECTORY)
    try:
        packed = _opened_zip(headers)
    except _MALFORMED as error:
        raise UnreadableArchive(
            f"The zip is damaged, or ends early ({error}). Pack it again, or copy it once more."
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


def _opened_zip(headers: _HeaderFile) -> zipfile.ZipFile:
    file = cast("BinaryIO", headers)
    try:  # most programs write UTF-8, with or without the flag
        return zipfile.ZipFile(file, metadata_encoding="utf-8")
    except UnicodeDecodeError:
        return zipfile.ZipFile(file)


def _zip_trouble(info: zipfile.ZipInfo, mode: int, beyond: bool) -> str | None:
    if info.flag_bits & _ENCRYPTED:
        return "it is encrypted"
    if stat.S_ISLNK(mode):
        return "it is a link"
    if stat.S_IFMT(mode) not in (0, stat.S_IFREG):
        return "it is no plain file"
    # LZMA is refused as well, because the file decides how much memory it needs
    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        return (
            f"it is packed by method {info.compress_type}, and only stored and deflated ones are "
            "read"
        )
    return "it begins or ends beyond the archive" if beyond else None


def read_entry(file: BinaryIO, entry: ArchiveEntry) -> bytes:
    """Return the content of a member without `trouble`.

    Raises
    ------
    UnreadableArchive : The content is damaged, or of another size than announced.
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
            f"it is damaged (it has {len(data)} bytes, and announces {entry.size})"
        )
    return data


def _too_many() -> UnreadableArchive:
    return UnreadableArchive(
        f"The archive has more than {MOST_MEMBERS} members. Pack fewer into one."
    )


# Decompression of tars while they are received: members are read later by random access, perhaps
# from an object store. `gzip.open` and its like pull from a file, but the chunks of a request are
# pushed, so this class calls the decompressors, and stops a bomb early.
#
# chunks  --Inflater.pieces-->  bytes of a zip or of a plain tar

#: Maximum ratio of content to archive size, beyond `FREE` bytes of content. Depth images are
#: compressed already, and NPY files of noisy depth shrink to a fifth.
MOST_RATIO, FREE = 50, 64 << 20
_MAXIMUM_STREAMS = 65_536  #: concatenated streams, which parallel compressors write
_XZ_MEMORY = 192 << 20  #: bytes; `xz -9` needs less

_MAGIC = (b"PK\x03\x04", b"\x1f\x8b", b"BZh", b"\xfd7zXZ\x00")
_KINDS = "a zip, or a tar (plain, .gz, .bz2 or .xz)"
_NO_TAR = f"What is compressed here is no tar. Send {_KINDS}."


class _Stream(Protocol):
    @property
    def eof(self) -> bool: ...

    @property
    def unused_data(self) -> bytes: ...

    def decompress(self, data: bytes, max_length: int, /) -> bytes: ...


def is_archive(head: bytes) -> bool:
    """Return whether the first bytes of a file are those of a readable archive."""
    return head.startswith(_MAGIC) or is_tar_header(head[:BLOCK])


class Inflater:
    """Receives an archive in chunks of any size, and returns it in pieces, tars decompressed.

    Parameters
    ----------
    most_bytes : maximum size of the returned archive
    """

    def __init__(self, most_bytes: int) -> None:
        self._most = most_bytes
        self._head: bytes | None = b""
        self._packing: bytes | None = None  # magic number of the tar's compression
        self._stream: _Stream | None = None
        self._streams = 0
        self._start = b""  # first bytes of the tar
        #: Bytes received, and bytes returned.
        self.taken, self.given = 0, 0

    def pieces(self, chunk: bytes) -> Iterator[bytes]:
        """Yield the pieces of the archive that a chunk completes.

        Raises
        ------
        UnreadableArchive : The file is no archive, is damaged, or exceeds `most_bytes`.
        """
        self.taken += len(chunk)
        if self._head is not None:
            self._head += chunk
            if len(self._head) < BLOCK:
                return
            chunk, self._head = self._head, None
            self._open(chunk)
        yield from self._given(chunk)

    def end(self) -> Iterator[bytes]:
        """Yield the remaining pieces after the last chunk; raises as `pieces`."""
        if self._head is not None:  # shorter than a block: an empty zip, or an empty file
            chunk, self._head = self._head, None
            self._open(chunk)
            yield from self._given(chunk)
        if self._stream is not None:
            raise UnreadableArchive("The archive ends early. Copy or pack it again.")
        if self._packing is not None and len(self._start) < BLOCK:
            raise UnreadableArchive(_NO_TAR)

    def _open(self, head: bytes) -> None:
        if not head:
            raise UnreadableArchive("The archive is empty. Copy or pack it again.")
        if not is_archive(head):
            raise UnreadableArchive(
                f"This is no archive that is read. Send {_KINDS} of a sequence; one frame is sent "
                "as a frame."
            )
        for magic in _MAGIC[1:]:
            if head.startswith(magic):
                self._packing, self._stream = magic, _open_entry(magic)

    def _given(self, chunk: bytes) -> Iterator[bytes]:
        for piece in [chunk] if self._packing is None else self._inflated(chunk):
            self.given += len(piece)
            if self.given > self._most or self.given > FREE + MOST_RATIO * self.taken:
                raise UnreadableArchive(
                    f"The archive holds more than {self._most} bytes, or {MOST_RATIO} times what "
                    "it weighs, which no depth images do. Send it in parts, or packed less."
                )
            if self._packing is not None and len(self._start) < BLOCK:
                self._start += piece[: BLOCK - len(self._start)]
                if len(self._start) == BLOCK and not is_tar_header(self._start):
                    raise UnreadableArchive(_NO_TAR)
            yield piece

    def _inflated(self, chunk: bytes) -> Iterator[bytes]:
        data = chunk
        while True:
            if self._stream is None:  # between two streams, or after the last
                data = data.lstrip(b"\0")
                if not data:
                    return
                assert self._packing is not None
                self._streams += 1
                if self._streams > _MAXIMUM_STREAMS:
                    raise UnreadableArchive(
                        "The archive is packed in too many small parts. Pack it again, as one."
                    )
                self._stream = _open_entry(self._packing)
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
            # zlib returns unused input in this attribute; the others keep it
            data = getattr(self._stream, "unconsumed_tail", b"")
            if not data and len(piece) < PIECE:
                return


def _open_entry(magic: bytes) -> _Stream:
    if magic == _MAGIC[1]:
        return zlib.decompressobj(16 + zlib.MAX_WBITS)
    if magic == _MAGIC[2]:
        return bz2.BZ2Decompressor()
    return lzma.LZMADecompressor(lzma.FORMAT_XZ, memlimit=_XZ_MEMORY)


# Sequences in an archive.

#: Default name of an archive and its sequence.
DEFAULT_NAME = "import"
_LISTS = ("depth.txt", "groundtruth.txt", TRANSFORMS)
_TEXTS = (INTRINSICS_FILE, CLOUDS_FILE, "TrainSplit.txt", "TestSplit.txt")
#: Maximum sizes of a list, of another text, and of all texts together, bytes.
_MAXIMUM_LIST, _MAXIMUM_TEXT, _MAXIMUM_TEXTS = 1 << 26, 1 << 16, 1 << 27
_HEAD_BYTES = 1024  #: first bytes of an image, which show its size
_PARENTS = ("0", "1", "2", "3", "4")  #: parents of the root, in which a camera is searched

#: Errors of a file system if a file and a folder have the same name, or a name is invalid.
_CLASHES = (errno.EEXIST, errno.ENOTDIR, errno.EISDIR, errno.ENAMETOOLONG, errno.EINVAL)

Wanted = Literal["image", "text"]


class Archive:
    """An open archive; see `open_archive`.

    Parameters
    ----------
    file : the archive
    root : private folder for the layout of its sequences
    """

    def __init__(self, file: BinaryIO, root: Path) -> None:
        self._file, self._root = file, root
        self._members: dict[Path, ArchiveEntry] = {}
        #: Names of refused members and sequences, with the reasons.
        self.refused: list[tuple[str, str]] = []
        #: Number of members that belong to no sequence, such as colour images.
        self.ignored = 0
        #: Whether the archive has depth of Record3D.
        self.is_record3d = False
        #: The sequences; each of their frames may still be damaged.
        self.sequences: tuple[FrameSequence, ...] = ()

    def name_of(self, reference: FrameReference) -> str:
        """Return the name of a frame's member in the archive."""
        return printable_name(self._members[reference.path].name)

    def size_of(self, reference: FrameReference) -> int:
        """Return the announced size of a frame's member, bytes."""
        return self._members[reference.path].size

    def data_of(self, reference: FrameReference) -> bytes:
        """Return the bytes of a frame.

        Raises
        ------
        UnreadableArchive : The member is damaged, encrypted or too large.
        """
        limit = MAXIMUM_IMAGE_BYTES if reference.cloud is None else MAXIMUM_CLOUD_BYTES
        data = self._read(self._members[reference.path], limit)
        if reference.row is not None:
            return rows_as_npy(data, reference.row)
        # units that no camera file can express
        return reference.source.converted(data) if isinstance(reference.source, ScaledNpy) else data

    def told(self, error: SceneprintError) -> str:
        """Return the message of an error without the private folder."""
        return str(error).replace(f"{self._root}/", "")

    def _read(self, member: ArchiveEntry, limit: int) -> bytes:
        name = printable_name(member.name)
        if member.trouble is not None:
            raise UnreadableArchive(f"{name}: {member.trouble}. Pack it again as a plain file.")
        if max(member.size, member.packed) > limit:
            raise UnreadableArchive(
                f"{name}: it has {member.size} bytes, and at most {limit} are read. Check that it "
                "is the file you meant."
            )
        try:
            return read_entry(self._file, member)
        except UnreadableArchive as error:
            raise UnreadableArchive(f"{name}: {error}. Pack it again.") from error

    def lay_out(self, name: str) -> None:
        """Fill the folder, and find the sequences in it."""
        found = self._wanted()
        tops = {parts[0] for parts, _, _ in found}
        single = len(tops) == 1 and all(len(parts) > 1 for parts, _, _ in found)
        above = self._root.joinpath(name)
        weight = self._file.seek(0, 2)
        # a zip's members may overlap, so their total may exceed the archive's size
        unpacked = sum(member.size for _, member, _ in found)
        if unpacked > FREE + MOST_RATIO * weight:
            raise UnreadableArchive(
                f"The archive holds {unpacked} bytes, more than {MOST_RATIO} times what it "
                "weighs, which no depth images do. Pack them less."
            )
        left = _MAXIMUM_TEXTS
        # cameras of other systems describe colour images; depth images show their own size
        of_exports = any(_is_of_export(parts) for parts, _, _ in found)
        for parts, member, wanted in found:
            path = above.joinpath(*parts)
            if path in self._members:
                again = "there is another member of this name before it"
                self._refuse(member, member.trouble or again)
                continue
            try:
                path.parent.mkdir(parents=True, exist_ok=True)
                path.touch(exist_ok=False)
            except OSError as error:
                if error.errno not in _CLASHES:  # the archive does not cause a full disk
                    raise
                self._refuse(member, "another member has the name of its folder, or its own")
                continue
            self._members[path] = member
            if wanted == "image" and of_exports and member.trouble is None:
                path.write_bytes(self._head(member))
            if wanted == "text" and member.trouble is not None:
                self._refuse(member, member.trouble)
            elif wanted == "text":
                left -= self._unpack(path, member, left)
        root = above / tops.pop() if single else above
        if root.is_dir():
            try:
                self.sequences, refused = find_each(root)
            except DatasetError as error:
                raise UnreadableArchive(self.told(error)) from error
            self.refused += [(printable_name(one), self.told(error)) for one, error in refused]

    def _head(self, member: ArchiveEntry) -> bytes:
        """Return the first bytes of a member; empty if it is unreadable."""
        if member.open is None:
            self._file.seek(member.start)
            return self._file.read(min(_HEAD_BYTES, member.size))
        try:
            with member.open() as content:
                return content.read(_HEAD_BYTES)
        except _MALFORMED:
            return b""

    def _unpack(self, path: Path, member: ArchiveEntry, left: int) -> int:
        """Write a text; a damaged one stays empty, so its reader refuses it."""
        limit = min(_MAXIMUM_LIST if path.name in _LISTS else _MAXIMUM_TEXT, left)
        try:
            data = self._read(member, limit)
        except UnreadableArchive as error:
            self.refused.append((printable_name(member.name), str(error)))
            return 0
        path.write_bytes(data)
        return len(data)

    def _wanted(self) -> list[tuple[tuple[str, ...], ArchiveEntry, Wanted]]:
        """Return the members that may belong to a sequence, with the parts of their names."""
        found: list[tuple[tuple[str, ...], ArchiveEntry, Wanted]] = []
        for count, member in enumerate(_entries_of(self._file), start=1):
            if count > MOST_MEMBERS:
                raise UnreadableArchive(
                    f"The archive has more than {MOST_MEMBERS} members. Pack fewer into one."
                )
            try:
                parts = parts_of(member.name)
            except OddName as error:
                self._refuse(member, str(error))
                continue
            wanted = _wanted(parts)
            if wanted is not None:
                found.append((parts, member, wanted))
            elif member.trouble is not None and not member.size:  # links, and damage of a tar
                self._refuse(member, member.trouble)
            else:
                self.ignored += 1
                self.is_record3d |= parts[-2:-1] == (FRAMES,) and parts[-1].endswith(DEPTH_SUFFIX)
        return found

    def _refuse(self, member: ArchiveEntry, reason: str) -> None:
        self.refused.append(
            (printable_name(member.name), f"{printable_name(member.name)}: {reason}.")
        )


@contextmanager
def open_archive(file: BinaryIO, folder: Path, name: str = DEFAULT_NAME) -> Iterator[Archive]:
    """Open an archive and find its sequences.

    Parameters
    ----------
    file : a zip, or a tar that is not compressed; it stays open while the archive is used
    folder : parent of the private folder, which is removed at the end
    name : name of the scene if the archive has no folder for it; one part of a path

    Raises
    ------
    UnreadableArchive : The file is no archive, is damaged, exceeds a limit, has no depth, or has
        two scenes of the same name.
    OSError : The folder cannot be written.
    """
    with tempfile.TemporaryDirectory(prefix="archive-", dir=folder) as private:
        archive = Archive(file, Path(private).joinpath(*_PARENTS).absolute())
        try:
            own = parts_of(name)[-1]
        except OddName as error:
            raise UnreadableArchive(
                f"The archive cannot be called {printable_name(name)}: {error}."
            ) from error
        archive.lay_out(own)
        if not archive.sequences and archive.is_record3d:
            raise UnreadableArchive(
                "This is a capture of Record3D, whose depth a service does not inflate. Run "
                "`sceneprint upload MAP FILE.r3d`."
            )
        if not archive.sequences and not archive.refused:
            raise UnreadableArchive(
                "There is no depth image or cloud in the archive, or only in archives within it. "
                "Pack a 7-Scenes scene or sequence, a TUM RGB-D folder (depth.txt), or a folder of "
                f"depth images ({titles_of('depth')}) with its intrinsics.json; one of clouds "
                f"({titles_of('cloud')}); or an export of Polycam or nerfstudio."
            )
        yield archive


def _entries_of(file: BinaryIO) -> Iterator[ArchiveEntry]:
    file.seek(0)
    head = file.read(BLOCK)
    if is_tar_header(head):
        return tar_entries(file)
    if head.startswith((b"PK\x03\x04", b"PK\x05\x06")):
        return zip_entries(file)
    raise UnreadableArchive("This is neither a zip nor a tar. Pack the sequence again.")


def _is_of_export(parts: tuple[str, ...]) -> bool:
    """Return whether other systems write a member of this name beside their depth images."""
    *folders, name = parts
    of_camera = name.lower().endswith(".json") and folders[-1:] in ([one] for one in CAMERAS)
    return of_camera or name == TRANSFORMS


def _wanted(parts: tuple[str, ...]) -> Wanted | None:
    """Return the role of a member in a sequence by its name; None for hidden files and colour."""
    *folders, name = parts
    hidden = any(part.startswith(".") or part == "__MACOSX" for part in parts)
    # the first folder may be the one that was packed, whatever its name
    if hidden or any(is_beside_depth(folder) for folder in folders[1:]):
        return None
    # `find_pose_file` finds the one that belongs to a frame
    is_pose = name.endswith(".txt") and ("pose" in name or {*folders[-1:]} & {*POSE_FOLDERS})
    if name in _TEXTS or name in _LISTS or is_pose or _is_of_export(parts):
        return "text"
    if is_image(name) and not name.lower().endswith(".color.png"):
        return "image"
    if is_cloud(name):
        return "image"
    return None
