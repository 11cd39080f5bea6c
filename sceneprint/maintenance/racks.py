"""Where snapshots that are taken over the service lie: a folder, or an object store.

    snapshot_url  --open_rack-->  Rack: ID.tar, ID.json

An archive counts when its record lies beside it, which is written last and removed first.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, Protocol

from sceneprint.settings import Settings
from sceneprint.writing import make_folder, sync_folder, write_durable

if TYPE_CHECKING:
    from sceneprint.store.objects import Objects

_BELOW = "snapshots/"


class Rack(Protocol):
    """Archives and their records; FileNotFoundError for what is not there."""

    #: To be told.
    place: str

    def ids(self, kind: str) -> Iterator[tuple[str, float]]:
        """Ids of what there is of a kind, `tar` or `json`, each with when it was written."""

    def record(self, snapshot_id: str) -> bytes:
        """The record of an archive."""

    def holds(self, snapshot_id: str) -> bool:
        """Whether the archive itself is there."""

    def open(self, snapshot_id: str) -> BinaryIO:
        """The archive as a file that can be sought in."""

    def local(self, snapshot_id: str, folder: Path) -> Path:
        """A file of this machine that is the archive; where it has to be fetched, in a folder."""

    def put(self, snapshot_id: str, archive: Path, record: bytes) -> None:
        """Take a file along, which is gone then, and its record."""

    def remove(self, snapshot_id: str) -> None:
        """Forget both, whichever is there."""


def open_rack(settings: Settings) -> Rack:
    """The one of a node's settings; nothing is asked of it yet."""
    if settings.snapshot_url is None:
        return _Folder(settings.snapshot_dir)
    from sceneprint.store.object_urls import open_objects

    return _Objects(open_objects(settings.snapshot_url, "SCENEPRINT_SNAPSHOT_URL"))


class _Folder:
    """Files of a folder, which is made with the first of them."""

    def __init__(self, folder: Path) -> None:
        self._folder, self.place = folder, str(folder)

    def ids(self, kind: str) -> Iterator[tuple[str, float]]:
        for path in self._folder.glob(f"*.{kind}"):
            with suppress(FileNotFoundError):  # removed meanwhile
                yield path.stem, path.stat().st_mtime

    def record(self, snapshot_id: str) -> bytes:
        return self._path(snapshot_id, "json").read_bytes()

    def holds(self, snapshot_id: str) -> bool:
        return self._path(snapshot_id, "tar").is_file()

    def open(self, snapshot_id: str) -> BinaryIO:
        return self._path(snapshot_id, "tar").open("rb")

    def local(self, snapshot_id: str, folder: Path) -> Path:
        del folder
        return self._path(snapshot_id, "tar")

    def put(self, snapshot_id: str, archive: Path, record: bytes) -> None:
        make_folder(self._folder)
        self._folder.chmod(0o700)  # archives have all frames, and the hashes of keys
        archive.replace(self._path(snapshot_id, "tar"))
        write_durable(self._path(snapshot_id, "json"), record)

    def remove(self, snapshot_id: str) -> None:
        for kind in ("json", "tar"):
            self._path(snapshot_id, kind).unlink(missing_ok=True)
        sync_folder(self._folder)

    def _path(self, snapshot_id: str, kind: str) -> Path:
        return self._folder / f"{snapshot_id}.{kind}"


class _Objects:
    """Objects below a prefix, for all hosts of a fleet."""

    def __init__(self, objects: Objects) -> None:
        self._objects, self.place = objects, objects.url

    def ids(self, kind: str) -> Iterator[tuple[str, float]]:
        for one in self._objects.list(_BELOW):
            name, _, end = one.key.rpartition("/")[2].rpartition(".")
            if end == kind:
                yield name, one.changed_at

    def record(self, snapshot_id: str) -> bytes:
        return self._objects.get(_key(snapshot_id, "json"))

    def holds(self, snapshot_id: str) -> bool:
        return self._objects.size(_key(snapshot_id, "tar")) is not None

    def open(self, snapshot_id: str) -> BinaryIO:
        return self._objects.open(_key(snapshot_id, "tar"))

    def local(self, snapshot_id: str, folder: Path) -> Path:
        path = folder / "archive"
        self._objects.get_file(_key(snapshot_id, "tar"), path)
        return path

    def put(self, snapshot_id: str, archive: Path, record: bytes) -> None:
        self._objects.put_file(_key(snapshot_id, "tar"), archive)
        self._objects.put(_key(snapshot_id, "json"), record)
        archive.unlink()

    def remove(self, snapshot_id: str) -> None:
        for kind in ("json", "tar"):
            self._objects.delete(_key(snapshot_id, kind))


def _key(snapshot_id: str, kind: str) -> str:
    return f"{_BELOW}{snapshot_id}.{kind}"
