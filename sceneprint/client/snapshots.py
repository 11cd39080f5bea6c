"""Snapshots over the service.

A topic of the client: what it needs of a backend, both backends, and the calls of `Client`.
"""

from __future__ import annotations

import hashlib
import os
import secrets
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, Protocol, cast

from sceneprint.client.messages import snapshot_path
from sceneprint.client.sending import Sender
from sceneprint.errors import DamagedSnapshot, SnapshotError, Unreachable
from sceneprint.schemas import Job, JobState, Page
from sceneprint.schemas.snapshots import SnapshotFile

if TYPE_CHECKING:
    from sceneprint.client.backend import Backend
    from sceneprint.engine import Engine
    from sceneprint.maintenance.shelf import Shelf

#: Times that a download goes on where it broke off.
_TRIES = 5


class SnapshotsBackend(Protocol):
    """What this topic needs of whoever does the work."""

    def begin_snapshot(self) -> Job:
        """Queue the taking of a snapshot."""

    def list_snapshots(self) -> list[SnapshotFile]:
        """Snapshots that are kept."""

    def fetch_snapshot(self, snapshot_id: str, file: BinaryIO) -> None:
        """Write the bytes of one to a file."""

    def delete_snapshot(self, snapshot_id: str) -> None:
        """Remove one."""


class RemoteSnapshots(Sender):
    """Over HTTP."""

    def begin_snapshot(self) -> Job:
        """Queue the taking of a snapshot."""
        return self._ask(Job, "POST", "/v1/snapshots")

    def list_snapshots(self) -> list[SnapshotFile]:
        """Snapshots that are kept."""
        return self._ask(Page[SnapshotFile], "GET", "/v1/snapshots").items

    def fetch_snapshot(self, snapshot_id: str, file: BinaryIO) -> None:
        """Write the bytes of one to a file; a download that breaks off goes on."""
        import httpx

        from sceneprint.client.problems import refusal

        path, lost = snapshot_path(snapshot_id), 0
        while True:
            headers = {"Range": f"bytes={file.tell()}-"} if file.tell() else {}
            try:
                with self._http.stream("GET", path, headers=headers) as response:
                    if not response.is_success:
                        response.read()
                        raise refusal(response)
                    for chunk in response.iter_raw():
                        file.write(chunk)
                return
            except httpx.TransportError as error:
                lost += 1
                if lost == _TRIES:
                    raise Unreachable(
                        f"{self._url}: the download of snapshot {snapshot_id} broke off {lost} "
                        f"times ({error}). Try again when the network is better."
                    ) from error

    def delete_snapshot(self, snapshot_id: str) -> None:
        """Remove one."""
        self._delete(snapshot_path(snapshot_id))


class EmbeddedSnapshots:
    """In this process."""

    _engine: Engine

    @property
    def _shelf(self) -> Shelf:
        from sceneprint.maintenance.shelf import Shelf

        return Shelf(self._engine.settings)

    def begin_snapshot(self) -> Job:
        """Queue the taking of a snapshot."""
        from sceneprint.maintenance.shelf import SNAPSHOT

        waiting = self._engine.list_jobs(JobState.QUEUED, limit=1, kind=SNAPSHOT).items
        return waiting[0] if waiting else self._engine.tasks.begin(SNAPSHOT, None, {})

    def list_snapshots(self) -> list[SnapshotFile]:
        """Snapshots that are kept."""
        return list(self._shelf.list())

    def fetch_snapshot(self, snapshot_id: str, file: BinaryIO) -> None:
        """Write the bytes of one to a file."""
        with self._shelf.open(snapshot_id) as archive:
            shutil.copyfileobj(archive, file, 1 << 20)

    def delete_snapshot(self, snapshot_id: str) -> None:
        """Remove one."""
        self._shelf.delete(snapshot_id)


class Snapshots:
    """The calls."""

    _backend: SnapshotsBackend

    def take_snapshot(self, *, wait_s: float | None = None) -> Job:
        """Have a snapshot taken of all maps: one state of database and uploads, in one archive.

        Parameters
        ----------
        wait_s : seconds to wait until it is taken; default: none

        Returns
        -------
        job : `result` is a SnapshotFile when it has succeeded

        Raises
        ------
        Forbidden : the key is no administrator's.
        """
        job = self._backend.begin_snapshot()
        if wait_s is None:
            return job
        from sceneprint.client.waiting import wait_for

        return wait_for(cast("Backend", self._backend), [job.job_id], wait_s, None)[0]

    def snapshots(self) -> list[SnapshotFile]:
        """Snapshots that the service keeps, the newest first."""
        return self._backend.list_snapshots()

    def download_snapshot(self, snapshot_id: str, path: str | Path) -> SnapshotFile:
        """Fetch a snapshot, for `sceneprint restore`; its checksum is compared.

        Parameters
        ----------
        snapshot_id : of `snapshots`
        path : of the archive to write; nothing is overwritten

        Raises
        ------
        UnknownSnapshot : there is none, or no longer.
        SnapshotError : the path is taken.
        DamagedSnapshot : what came is not what was taken.
        OSError : it cannot be written.
        """
        path = Path(path)
        # asked first: an unknown one leaves nothing behind
        known = {one.snapshot_id: one for one in self._backend.list_snapshots()}
        if path.exists():
            raise SnapshotError(f"{path} is there, and nothing is overwritten. Name another.")
        part = path.with_name(f".{path.name}.{secrets.token_hex(6)}.part")
        try:
            with open(part, "xb", opener=_private) as file:
                self._backend.fetch_snapshot(snapshot_id, file)
            with part.open("rb") as file:
                digest = hashlib.file_digest(file, "sha256").hexdigest()
            if snapshot_id not in known or digest != known[snapshot_id].sha256:
                raise DamagedSnapshot(
                    f"Snapshot {snapshot_id} did not come as it was taken. Download it again, or "
                    "take another."
                )
            part.rename(path)
        finally:
            part.unlink(missing_ok=True)
        return known[snapshot_id]

    def delete_snapshot(self, snapshot_id: str) -> None:
        """Remove a snapshot; UnknownSnapshot where there is none."""
        self._backend.delete_snapshot(snapshot_id)


def _private(path: str, flags: int) -> int:
    """An archive has all pictures, and the hashes of keys."""
    return os.open(path, flags, 0o600)
