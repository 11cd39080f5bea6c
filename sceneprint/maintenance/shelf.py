"""Snapshots that are taken over the service: a few, in a folder of the data folder.

    job of kind snapshot  --snapshot_handler-->  ID.tar, ID.json

An archive counts when its record lies beside it, which is written last.
"""

from __future__ import annotations

import hashlib
import logging
import re
import time
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path

from pydantic import ValidationError

from sceneprint.engine.slices import Outcome, Task
from sceneprint.errors import SnapshotError, UnknownSnapshot, UnusableStore
from sceneprint.maintenance.snapshots import take_snapshot
from sceneprint.schemas.snapshots import SnapshotFile
from sceneprint.settings import Settings
from sceneprint.writing import make_folder, sync_folder, write_durable

log = logging.getLogger(__name__)

#: Kind of the jobs.
SNAPSHOT = "snapshot"
#: Longest time for one, seconds: what a terabyte takes.
LONGEST_S = 6 * 3600.0
#: Seconds after which an archive without a record is of a worker that died.
_ABANDONED_S = 3600.0
_ID = re.compile(r"[0-9]{8}T[0-9]{6}Z-[0-9a-f]{8}")


class Shelf:
    """The folder of snapshots of a data folder.

    Parameters
    ----------
    settings : see Settings
    """

    def __init__(self, settings: Settings) -> None:
        self._settings, self._folder = settings, settings.snapshot_dir

    def list(self) -> tuple[SnapshotFile, ...]:
        """All snapshots, the newest first."""
        found = []
        for path in self._folder.glob("*.json"):
            with suppress(UnknownSnapshot):  # removed meanwhile, or no record of ours
                found.append(self.find(path.stem))
        return tuple(sorted(found, key=lambda one: one.snapshot_id, reverse=True))

    def find(self, snapshot_id: str) -> SnapshotFile:
        """A snapshot; UnknownSnapshot where there is none."""
        if _ID.fullmatch(snapshot_id) and self._archive(snapshot_id).is_file():
            with suppress(OSError, ValidationError):
                return SnapshotFile.model_validate_json(self._record(snapshot_id).read_bytes())
        raise _unknown(snapshot_id)

    def path(self, snapshot_id: str) -> Path:
        """The archive of a snapshot; UnknownSnapshot where there is none."""
        return self._archive(self.find(snapshot_id).snapshot_id)

    def delete(self, snapshot_id: str) -> None:
        """Remove a snapshot; UnknownSnapshot where there is none."""
        self.find(snapshot_id)
        self._remove(snapshot_id)

    def take(self, snapshot_id: str) -> SnapshotFile:
        """Take a snapshot, and remove the oldest of those that are too many.

        Parameters
        ----------
        snapshot_id : that it gets; one of that id that is there already is left as it is

        Raises
        ------
        SnapshotError : it cannot be taken.
        """
        with suppress(UnknownSnapshot):
            return self.find(snapshot_id)
        try:
            make_folder(self._folder)
            self._folder.chmod(0o700)  # archives have all frames, and the hashes of keys
            archive = self._archive(snapshot_id)
            archive.unlink(missing_ok=True)  # of a worker that died before its record
            taken = take_snapshot(self._settings, archive)
            with archive.open("rb") as file:
                digest = hashlib.file_digest(file, "sha256").hexdigest()
            made = SnapshotFile(
                snapshot_id=snapshot_id,
                created_at=taken.manifest.created_at,
                bytes=archive.stat().st_size,
                sha256=digest,
                maps=taken.manifest.maps,
                frames=taken.manifest.n_frames,
                blobs=taken.manifest.blobs.count,
                damaged=len(taken.damaged),
            )
            write_durable(self._record(snapshot_id), made.model_dump_json().encode())
            self._tidy()
        except UnusableStore as error:  # in the words of a snapshot: another try finds the same
            raise SnapshotError(str(error)) from error
        except OSError as error:
            raise SnapshotError(
                f"{self._folder}: no snapshot can be written ({error.strerror or error}). See "
                "that the service may write there."
            ) from error
        return made

    def _tidy(self) -> None:
        """Remove what is too much, and archives that nobody will finish."""
        for one in self.list()[self._settings.snapshots_kept :]:
            log.info("snapshot removed", extra={"snapshot": one.snapshot_id})
            self._remove(one.snapshot_id)
        for path in self._folder.glob("*.tar"):
            with suppress(FileNotFoundError):
                old = path.stat().st_mtime + _ABANDONED_S < time.time()
                if old and _ID.fullmatch(path.stem) and not self._record(path.stem).exists():
                    path.unlink()

    def _remove(self, snapshot_id: str) -> None:
        self._record(snapshot_id).unlink(missing_ok=True)
        self._archive(snapshot_id).unlink(missing_ok=True)
        sync_folder(self._folder)

    def _archive(self, snapshot_id: str) -> Path:
        return self._folder / f"{snapshot_id}.tar"

    def _record(self, snapshot_id: str) -> Path:
        return self._folder / f"{snapshot_id}.json"


def snapshot_handler(settings: Settings) -> Callable[[Task, float], Outcome]:
    """What does jobs of kind `snapshot`, in one slice each."""

    def handle(task: Task, until: float) -> Outcome:
        del until
        job = task.claim.job
        begun = datetime.fromtimestamp(job.created_at, UTC)
        made = Shelf(settings).take(f"{begun:%Y%m%dT%H%M%SZ}-{job.id[:8]}")
        return Outcome(
            over=True, progress={"done": made.bytes, "total": made.bytes},
            result=made.model_dump(mode="json"),
        )  # fmt: skip

    return handle


def _unknown(snapshot_id: str) -> UnknownSnapshot:
    return UnknownSnapshot(
        f"There is no snapshot {snapshot_id!r:.80}, or no longer: only the newest are kept. List "
        "them with GET /v1/snapshots."
    )
