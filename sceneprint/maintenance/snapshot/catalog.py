"""Snapshots that are taken over the service: a few, beside the data or in an object store.

job of kind snapshot  --snapshot_handler-->  an archive and its record
"""

from __future__ import annotations

import hashlib
import logging
import re
import secrets
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

from pydantic import ValidationError

from sceneprint.atomic_files import make_folder, sync_folder, write_durable
from sceneprint.engine.jobs.tasks import LongJob, SliceResult
from sceneprint.errors import SnapshotError, UnknownSnapshot, UnusableStore
from sceneprint.maintenance.snapshot.creation import Progress, take_snapshot
from sceneprint.maintenance.snapshot.files import check_room, staging
from sceneprint.settings import Settings
from sceneprint_client.api.admin import SnapshotFile

if TYPE_CHECKING:
    from sceneprint.store.blobs.object_client import Objects

# Where snapshots that are taken over the service lie: a folder, or an object store.
#
#     snapshot_url  --open_snapshot_storage-->  ID.tar, ID.json
#
# An archive counts when its record lies beside it, which is written last and removed first. What is
# not there is a FileNotFoundError.

_BELOW = "snapshots/"


def open_snapshot_storage(settings: Settings) -> _Folder | _Objects:
    """The one of a node's settings; nothing is asked of it yet."""
    if settings.snapshot_url is None:
        return _Folder(settings.snapshot_dir)
    from sceneprint.store.blobs.object_client import open_objects

    return _Objects(open_objects(settings.snapshot_url, "SCENEPRINT_SNAPSHOT_URL"))


class _Folder:
    """Files of a folder, which is made with the first of them."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def ids(self, kind: str) -> Iterator[tuple[str, float]]:
        """Ids of what there is of a kind, `tar` or `json`, each with when it was written."""
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
        """A file of this machine that is the archive; where it has to be fetched, in a folder."""
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
        self._objects = objects

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


log = logging.getLogger(__name__)

#: Kind of the jobs.
SNAPSHOT = "snapshot"
#: Longest time for one, seconds: what a terabyte takes.
LONGEST_S = 6 * 3600.0
#: Seconds after which an archive without a record is of a worker that died.
_ABANDONED_S = 3600.0
_STAGING = ".taking-"
_ID = re.compile(r"[0-9]{8}T[0-9]{6}Z-[0-9a-f]{8}")


class SnapshotCatalog:
    """The snapshots of a data folder, or of a fleet.

    Parameters
    ----------
    settings : see Settings
    """

    def __init__(self, settings: Settings) -> None:
        self._settings = settings

    @cached_property
    def _rack(self) -> _Folder | _Objects:
        return open_snapshot_storage(self._settings)

    def list(self) -> tuple[SnapshotFile, ...]:
        """All snapshots, the newest first."""
        found = []
        for name, _ in self._rack.ids("json"):
            with suppress(UnknownSnapshot):  # removed meanwhile, or no record of ours
                found.append(self.find(name))
        return tuple(sorted(found, key=lambda one: one.snapshot_id, reverse=True))

    def find(self, snapshot_id: str) -> SnapshotFile:
        """A snapshot; UnknownSnapshot where there is none."""
        if is_snapshot_id(snapshot_id) and self._rack.holds(snapshot_id):
            with suppress(OSError, ValidationError):
                return SnapshotFile.model_validate_json(self._rack.record(snapshot_id))
        raise _unknown(snapshot_id)

    def open(self, snapshot_id: str) -> BinaryIO:
        """An archive as a file that can be sought in; UnknownSnapshot where there is none."""
        self.find(snapshot_id)
        try:
            return self._rack.open(snapshot_id)
        except FileNotFoundError as error:  # removed meanwhile
            raise _unknown(snapshot_id) from error

    @contextmanager
    def local(self, snapshot_id: str, folder: Path) -> Iterator[Path]:
        """The archive as a file of this machine, in the end perhaps no more.

        Parameters
        ----------
        snapshot_id : UnknownSnapshot where there is none
        folder : in which it may be put meanwhile; made where missing
        """
        found = self.find(snapshot_id)
        make_folder(folder)
        with staging(folder, _STAGING) as place:
            check_room(place, found.bytes, "the snapshot")
            yield self._rack.local(snapshot_id, place)

    def delete(self, snapshot_id: str) -> None:
        """Remove a snapshot; UnknownSnapshot where there is none."""
        self.find(snapshot_id)
        self._rack.remove(snapshot_id)

    def take(self, snapshot_id: str, progress: Progress | None = None) -> SnapshotFile:
        """Take a snapshot, and remove the oldest of those that are too many.

        Parameters
        ----------
        snapshot_id : that it gets; one of that id that is there already is left as it is
        progress : told of bytes done and bytes in all

        Raises
        ------
        SnapshotError : it cannot be taken.
        """
        with suppress(UnknownSnapshot):
            return self.find(snapshot_id)
        place = self._settings.snapshot_dir
        try:
            make_folder(place)
            # archives have all frames, and the hashes of keys
            with staging(place, _STAGING) as folder:
                taken = take_snapshot(self._settings, folder / "archive", progress)
                with taken.path.open("rb") as file:
                    digest = hashlib.file_digest(file, "sha256").hexdigest()
                made = SnapshotFile(
                    snapshot_id=snapshot_id,
                    created_at=taken.manifest.created_at,
                    bytes=taken.path.stat().st_size,
                    sha256=digest,
                    maps=taken.manifest.maps,
                    frames=taken.manifest.n_frames,
                    blobs=taken.manifest.blobs.count,
                    damaged=len(taken.damaged),
                )
                self._rack.put(snapshot_id, taken.path, made.model_dump_json().encode())
            self._tidy()
        except UnusableStore as error:  # in the words of a snapshot: another try finds the same
            raise SnapshotError(str(error)) from error
        except OSError as error:
            raise SnapshotError(
                f"{place}: no snapshot can be written ({error.strerror or error}). See "
                "that the service may write there."
            ) from error
        return made

    def _tidy(self) -> None:
        """Remove what is too much, and archives that nobody will finish."""
        for one in self.list()[self._settings.snapshots_kept :]:
            log.info("snapshot removed", extra={"snapshot": one.snapshot_id})
            self._rack.remove(one.snapshot_id)
        known = {name for name, _ in self._rack.ids("json")}
        for name, written_at in self._rack.ids("tar"):
            if (
                written_at + _ABANDONED_S < time.time()
                and is_snapshot_id(name)
                and name not in known
            ):
                self._rack.remove(name)


def is_snapshot_id(given: str) -> bool:
    """Whether it can be the id of a snapshot that was taken over the service."""
    return _ID.fullmatch(given) is not None


def new_snapshot_id() -> str:
    """An id for a snapshot that is taken now, and not by a job."""
    return f"{datetime.now(UTC):%Y%m%dT%H%M%SZ}-{secrets.token_hex(4)}"


def snapshot_handler(settings: Settings) -> Callable[[LongJob, float], SliceResult]:
    """What does jobs of kind `snapshot`, in one slice each."""

    def handle(task: LongJob, until: float) -> SliceResult:
        del until
        job = task.job
        begun = datetime.fromtimestamp(job.created_at, UTC)
        made = SnapshotCatalog(settings).take(f"{begun:%Y%m%dT%H%M%SZ}-{job.id[:8]}")
        return SliceResult(
            over=True, progress={"done": made.bytes, "total": made.bytes},
            result=made.model_dump(mode="json"),
        )  # fmt: skip

    return handle


def _unknown(snapshot_id: str) -> UnknownSnapshot:
    return UnknownSnapshot(
        f"There is no snapshot {snapshot_id!r:.80}, or no longer: only the newest are kept. List "
        "them with GET /v1/snapshots."
    )
