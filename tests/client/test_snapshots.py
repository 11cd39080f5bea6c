"""Snapshots taken over the service: listed, downloaded, restored to the same answers."""

from __future__ import annotations

import hashlib
from pathlib import Path

import httpx
import pytest

from benchmarks.waiting import PATIENCE_S
from sceneprint.errors import SnapshotError, UnknownSnapshot
from sceneprint.formats.dataset import FrameReference
from sceneprint.maintenance.fsck.check import fsck
from sceneprint.maintenance.snapshot.creation import SnapshotCatalog
from sceneprint.maintenance.snapshot.restoration import restore_snapshot
from sceneprint.settings import Settings
from sceneprint_client import Client
from sceneprint_client.api import JobState


@pytest.mark.sqlite_only("it is restored to a folder; for PostgreSQL see test_fleets")
def test_a_snapshot_taken_over_the_service_restores_to_the_same_answers(
    remote: Client, service_url: str, map_name: str, references: tuple[FrameReference, ...],
    tmp_path: Path,
) -> None:  # fmt: skip
    remote.create_map(map_name, model="depth")
    for reference in references[:4]:
        remote.upload(map_name, reference, wait_s=PATIENCE_S)
    before = {one.snapshot_id for one in remote.snapshots()}
    job = remote.take_snapshot(wait_s=PATIENCE_S)
    assert (job.state, job.kind, job.map) == (JobState.SUCCEEDED, "snapshot", None), job.error
    [taken] = [one for one in remote.snapshots() if one.snapshot_id not in before]
    assert job.result == taken.model_dump(mode="json")
    assert taken.frames >= 4
    assert taken.damaged == 0
    archive = tmp_path / "copy.tar"
    assert remote.download_snapshot(taken.snapshot_id, archive) == taken
    assert hashlib.sha256(archive.read_bytes()).hexdigest() == taken.sha256
    assert archive.stat().st_size == taken.bytes
    assert archive.stat().st_mode & 0o777 == 0o600
    with pytest.raises(SnapshotError, match="nothing is overwritten"):
        remote.download_snapshot(taken.snapshot_id, archive)
    url = f"{service_url}/v1/snapshots/{taken.snapshot_id}"
    end = httpx.get(url, headers={"Range": "bytes=-1024"})  # a download that goes on
    assert (end.status_code, end.content) == (206, archive.read_bytes()[-1024:])
    assert end.headers["Content-Type"] == "application/x-tar"
    asked = remote.query(map_name, references[4], k=2)
    restore_snapshot(archive, tmp_path / "restored")
    with Client.embedded(tmp_path / "restored") as restored:
        again = restored.query(map_name, references[4], k=2)
        assert again.matches == asked.matches
        assert (again.status, again.location) == (asked.status, asked.location)
    remote.delete_snapshot(taken.snapshot_id)
    assert httpx.get(url).json()["type"] == "/problems/unknown-snapshot"
    for gone in (taken.snapshot_id, "20260101T000000Z-00000000", "nothing"):
        with pytest.raises(UnknownSnapshot):
            remote.download_snapshot(gone, tmp_path / "gone.tar")
        with pytest.raises(UnknownSnapshot):
            remote.delete_snapshot(gone)
    assert not list(tmp_path.glob("*gone*"))


def test_only_the_newest_are_kept_and_fsck_has_nothing_to_say(
    tmp_path: Path, references: tuple[FrameReference, ...]
) -> None:
    data = tmp_path / "data"
    with Client.embedded(data) as client:
        client.create_map("hall", model="depth")
        client.upload("hall", references[0], wait_s=PATIENCE_S)
        job = client.take_snapshot()
        assert client.take_snapshot().job_id == job.job_id  # the one that waits is enough
        [job] = client.wait([job.job_id])
        assert job.state == JobState.SUCCEEDED
        [first] = client.snapshots()
        assert (first.maps, first.frames, first.blobs) == (1, 1, 2)
        shelf = SnapshotCatalog(Settings(data_dir=data, database_url=None, snapshots_kept=2))
        stale = data / "snapshots" / "20200101T000000Z-0123abcd.tar"
        stale.write_bytes(b"")
        names = [f"2999010{n}T000000Z-0000000{n}" for n in range(1, 4)]
        for name in names:
            shelf.take(name)
        assert [one.snapshot_id for one in client.snapshots()] == names[:0:-1]
        left = sorted(path.name for path in (data / "snapshots").iterdir())
        assert stale.name in left  # somebody may be writing it
        wanted = [f"{name}.{end}" for name in names[1:] for end in ("json", "tar")]
        assert sorted({*left} - {stale.name}) == wanted
        again = shelf.take(names[2])  # a worker that died after it: nothing is done twice
        assert again == shelf.find(names[2])
        assert client.download_snapshot(names[2], tmp_path / "a.tar") == again
        found = list(fsck(Settings(data_dir=data, database_url=None)))
        assert [one.finding for one in found if one.left] == []
        # an archive whose record is missing is none, and is taken again
        (data / "snapshots" / f"{names[2]}.json").unlink()
        with pytest.raises(UnknownSnapshot):
            shelf.find(names[2])
        assert shelf.take(names[2]).frames == 1


def test_where_none_can_be_taken_the_job_says_why(tmp_path: Path) -> None:
    with Client.embedded(tmp_path) as client:
        (tmp_path / "snapshots").write_text("in the way")
        job = client.take_snapshot(wait_s=PATIENCE_S)
        assert (job.state, job.attempts) == (JobState.FAILED, 1)
        assert "no snapshot can be written" in str(job.error)
