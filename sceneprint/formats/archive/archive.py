"""Sequences in an archive, read in place: nothing of it chooses where anything is written.

file  --open_archive-->  Archive: sequences, refused, frame_of(reference)

Only camera, pose and list files are unpacked, bounded, into a private folder, under names of
harmless parts; images are empty files there, so that `find_each` finds sequences as it does on a
disk. An image is read out of the archive when its turn comes.
"""

from __future__ import annotations

import errno
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO, Literal

from sceneprint.errors import DatasetError, SceneprintError, UnreadableArchive
from sceneprint.formats.archive.entries import (
    BLOCK,
    FREE,
    MOST_MEMBERS,
    MOST_RATIO,
    ArchiveEntry,
    OddName,
    is_tar_header,
    parts_of,
    printable_name,
    read_entry,
    tar_entries,
    zip_entries,
)
from sceneprint.formats.dataset.frame_reference import (
    FrameReference,
    FrameSequence,
)
from sceneprint.formats.dataset.sequences import find_each, is_of_colour
from sceneprint_client.files import MAXIMUM_CLOUD_BYTES, MAXIMUM_IMAGE_BYTES, is_cloud
from sceneprint_client.sidecars import CLOUDS_FILE, INTRINSICS_FILE

#: What an archive and its sequence are called where nobody says.
DEFAULT_NAME = "import"
_LISTS = ("depth.txt", "groundtruth.txt")
_TEXTS = (INTRINSICS_FILE, CLOUDS_FILE, "TrainSplit.txt", "TestSplit.txt")
_MAXIMUM_LIST, _MAXIMUM_TEXT, _MAXIMUM_TEXTS = 1 << 26, 1 << 16, 1 << 27  #: bytes; of all of them
_PARENTS = ("0", "1", "2", "3", "4")  #: a camera is looked for above the frames: not beyond these

#: What a file system says where a file and a folder have one name, or a name is none for it.
_CLASHES = (errno.EEXIST, errno.ENOTDIR, errno.EISDIR, errno.ENAMETOOLONG, errno.EINVAL)

Wanted = Literal["image", "text"]


class Archive:
    """An archive that is open; see `open_archive`.

    Parameters
    ----------
    file : of the archive
    root : private folder that its sequences are laid out in
    """

    def __init__(self, file: BinaryIO, root: Path) -> None:
        self._file, self._root = file, root
        self._members: dict[Path, ArchiveEntry] = {}
        #: Name of a member or a sequence, and why it is not taken.
        self.refused: list[tuple[str, str]] = []
        #: Members that are no part of a sequence, such as colour images.
        self.ignored = 0
        #: Sound ones, though each of their frames may still turn out damaged.
        self.sequences: tuple[FrameSequence, ...] = ()

    def name_of(self, reference: FrameReference) -> str:
        """The name of a frame's member, as the archive writes it."""
        return printable_name(self._members[reference.path].name)

    def size_of(self, reference: FrameReference) -> int:
        """Bytes of a frame of `sequences`, as the archive announces them."""
        return self._members[reference.path].size

    def data_of(self, reference: FrameReference) -> bytes:
        """The bytes of a frame of `sequences`.

        Raises
        ------
        UnreadableArchive : its member is damaged, encrypted or too large.
        """
        limit = MAXIMUM_IMAGE_BYTES if reference.cloud is None else MAXIMUM_CLOUD_BYTES
        return self._read(self._members[reference.path], limit)

    def told(self, error: SceneprintError) -> str:
        """What an error says, without the private folder."""
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
        # of a tar this is at most one; a zip's members may lie over each other
        unpacked = sum(member.size for _, member, _ in found)
        if unpacked > FREE + MOST_RATIO * weight:
            raise UnreadableArchive(
                f"The archive holds {unpacked} bytes, more than {MOST_RATIO} times what it "
                "weighs, which no depth images do. Pack them less."
            )
        left = _MAXIMUM_TEXTS
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
                if error.errno not in _CLASHES:  # a full disk is no fault of the archive's
                    raise
                self._refuse(member, "another member has the name of its folder, or its own")
                continue
            self._members[path] = member
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

    def _unpack(self, path: Path, member: ArchiveEntry, left: int) -> int:
        """Write a text; a damaged one stays empty, which its reader refuses."""
        limit = min(_MAXIMUM_LIST if path.name in _LISTS else _MAXIMUM_TEXT, left)
        try:
            data = self._read(member, limit)
        except UnreadableArchive as error:
            self.refused.append((printable_name(member.name), str(error)))
            return 0
        path.write_bytes(data)
        return len(data)

    def _wanted(self) -> list[tuple[tuple[str, ...], ArchiveEntry, Wanted]]:
        """Members that may be part of a sequence, with the parts of their names."""
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
            elif member.trouble is not None and not member.size:  # links, and where a tar breaks
                self._refuse(member, member.trouble)
            else:
                self.ignored += 1
        return found

    def _refuse(self, member: ArchiveEntry, reason: str) -> None:
        self.refused.append(
            (printable_name(member.name), f"{printable_name(member.name)}: {reason}.")
        )


@contextmanager
def open_archive(file: BinaryIO, folder: Path, name: str = DEFAULT_NAME) -> Iterator[Archive]:
    """Look into an archive, and find what sequences it has.

    Parameters
    ----------
    file : a zip, or a tar that is not compressed; stays open as long as the archive is used
    folder : below which a private one is made, and removed in the end
    name : of the place that the sequences are of, where the archive has no folder for it; a path's
        part

    Raises
    ------
    UnreadableArchive : it is none, damaged as a whole, holds too much, nothing that is depth, or
        two scenes of one name.
    OSError : the folder cannot be written.
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
        if not archive.sequences and not archive.refused:
            raise UnreadableArchive(
                "There is no depth image or cloud in the archive, or only in archives within it. "
                "Pack a 7-Scenes scene or sequence, a TUM RGB-D folder (depth.txt), or a folder of "
                "16-bit PNG or float NPY images, with its intrinsics.json; or one of PLY, PCD, "
                "KITTI .bin, LAS or LAZ clouds."
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


def _wanted(parts: tuple[str, ...]) -> Wanted | None:
    """What a member is to a sequence by its name; hidden files and colour are nothing."""
    *folders, name = parts
    hidden = any(part.startswith(".") or part == "__MACOSX" for part in parts)
    # the first folder may be what the packed folder was called
    if hidden or any(is_of_colour(folder) for folder in folders[1:]):
        return None
    if name in _TEXTS or name in _LISTS or name.endswith(".pose.txt"):
        return "text"
    lowered = name.lower()
    if lowered.endswith((".png", ".npy")) and not lowered.endswith(".color.png"):
        return "image"
    if is_cloud(name):
        return "image"
    return None
