"""Incremental snapshots: archives without the blobs that earlier archives hold.

Blobs never change, and archives hold them in the order of their digests. So the archives that one
was taken since are read once, beside what refers to the blobs.

    archives  --BaseArchives.holds-->  blobs that need not be taken along
    archives  --BaseArchives.take-->  the bytes of those that were not
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType

from sceneprint.errors import DamagedSnapshot, SnapshotError
from sceneprint.maintenance.snapshot.files import (
    BLOBS,
    DATABASE,
    LONGEST,
    MANIFEST,
    ArchiveReader,
    BaseArchive,
    SnapshotManifest,
    read_manifest,
)

#: Archives that one can be taken since: the manifest has room for so many.
MOST_BASES = 8


class BaseArchives:
    """Archives that another one is or was taken since, each read once from its start.

    Parameters
    ----------
    paths : of the archives

    Raises
    ------
    SnapshotError : one of them is none, or is there twice; or they are too many.
    """

    def __init__(self, paths: Sequence[Path]) -> None:
        if len(paths) > MOST_BASES:
            raise SnapshotError(
                f"--since names {len(paths)} archives, and at most {MOST_BASES} can be. Take a "
                "full snapshot, and go on from that."
            )
        with ExitStack() as stack:
            self._bases = [_Base(stack, path) for path in paths]
            self._stack = stack.pop_all()
        #: What is known of them.
        self.known = tuple(sorted((one.told for one in self._bases), key=lambda one: one.sha256))
        if len({one.sha256 for one in self.known}) < len(paths):
            self._stack.close()
            raise SnapshotError("--since names an archive twice. Name each once.")

    def __enter__(self) -> BaseArchives:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:  # fmt: skip
        self._stack.close()

    def require(self, manifest: SnapshotManifest, archive: Path) -> None:
        """See that they are those that an archive was taken since.

        Raises
        ------
        SnapshotError : one is missing, or it was not taken since one of them.
        """
        if self.known == manifest.since:
            return
        if not manifest.since:
            raise SnapshotError(f"{archive} is a full snapshot. Leave out --since.")
        named = ", ".join(f"that of {one.created_at:%Y-%m-%dT%H:%M:%SZ}" for one in manifest.since)
        raise SnapshotError(
            f"{archive} has only what is new since earlier archives. Give each of them, and no "
            f"other, with --since: {named}."
        )

    def holds(self, digest: str) -> bool:
        """Whether one of them holds a blob; to be asked in the order of the digests."""
        return any(one.find(digest) for one in self._bases)

    def take(self, digest: str) -> Iterator[bytes] | None:
        """The bytes of a blob, to be read to their end; None where none of them holds it.

        In the order of the digests, each once.
        """
        for one in self._bases:
            if one.find(digest):
                return one.content()
        return None

    def size(self, digest: str) -> int | None:
        """Bytes of a blob that is about to be taken."""
        return next((one.blob_bytes for one in self._bases if one.find(digest)), None)


class _Base:
    """An archive, and the blob at which its reader is."""

    def __init__(self, stack: ExitStack, path: Path) -> None:
        if not path.is_file():
            raise SnapshotError(f"{path}: there is no such file. Name an archive with --since.")
        self._reader = ArchiveReader(stack.enter_context(path.open("rb")), path, lambda _: None)
        manifest = _manifest(self._reader, path)
        self.told = BaseArchive(created_at=manifest.created_at, sha256=manifest.database.sha256)
        self._digest: str | None = ""
        self.blob_bytes, self._taken = 0, True

    def find(self, digest: str) -> bool:
        """Go on to a blob, or to where it would be."""
        while self._digest is not None and (self._taken or self._digest < digest):
            if not self._taken:
                self._reader.skip(self.blob_bytes)
            member = self._reader.next()
            name = "" if member is None else member[0]
            self._digest = name.removeprefix(BLOBS) if name.startswith(BLOBS) else None
            self.blob_bytes, self._taken = 0 if member is None else member[1], False
        return self._digest == digest

    def content(self) -> Iterator[bytes]:
        """The bytes of the blob that was found."""
        self._taken = True
        return self._reader.content(self.blob_bytes)


def _manifest(reader: ArchiveReader, path: Path) -> SnapshotManifest:
    member = reader.next()
    if member is None or member[0] != MANIFEST or member[1] > LONGEST:
        raise DamagedSnapshot(f"{path}: no snapshot of sceneprint. Name another with --since.")
    manifest = read_manifest(b"".join(reader.content(member[1])), str(path))
    if reader.size != manifest.bytes or reader.next() != (DATABASE, manifest.database.bytes):
        raise reader.damaged("it is not as long as it was written, or its database is elsewhere")
    reader.skip(manifest.database.bytes)
    return manifest
