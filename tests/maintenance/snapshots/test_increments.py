"""Incremental snapshots: what they leave out, and what comes back of a chain of them."""

from __future__ import annotations

import tarfile
from pathlib import Path

import pytest
from pydantic import SecretStr

from sceneprint.engine import Engine
from sceneprint.errors import DamagedSnapshot, SnapshotError
from sceneprint.maintenance.snapshot.creation import take_snapshot
from sceneprint.maintenance.snapshot.increments import MOST_BASES
from sceneprint.maintenance.snapshot.postgres_restore import restore_to_fleet
from sceneprint.maintenance.snapshot.restoration import restore_snapshot, verify_snapshot
from sceneprint.settings import Settings
from sceneprint.store.blobs.folder import MARK

pytestmark = pytest.mark.sqlite_only("compares data folders")


def blobs_in(archive: Path) -> list[str]:
    with tarfile.open(archive) as tar:
        return [name for name in tar.getnames() if name.startswith("blobs/")]


@pytest.fixture
def chain(data: Path, uploads, settings, tmp_path: Path) -> list[Path]:
    """A full snapshot, one of two more frames and a deletion, one of another frame, and a full one
    of the same state.
    """
    full, second, third, whole = (tmp_path / f"{name}.tar" for name in ("a", "b", "c", "whole"))
    take_snapshot(settings(data), full)
    with Engine(settings(data)) as engine:
        for each in uploads[10:12]:
            engine.add_frame("hall", each.data, each.meta)
        engine.delete_frame("hall", engine.list_frames("hall").items[0].frame_id)
    take_snapshot(settings(data), second, since=[full])
    with Engine(settings(data)) as engine:
        engine.add_frame("hall", uploads[13].data, uploads[13].meta)
    take_snapshot(settings(data), third, since=[second, full])
    take_snapshot(settings(data), whole)
    return [full, second, third, whole]


def test_only_what_is_new_is_in_it(chain):
    full, second, third, whole = (blobs_in(one) for one in chain)
    assert (len(full), len(second), len(third)) == (9, 2, 1)
    assert not {*full} & {*second}
    # of the frame that was deleted, upload and artifact are in the first alone
    assert len(whole) == len(full) - 2 + 2 + 1
    assert {*whole} < {*full, *second, *third}
    told = verify_snapshot(chain[2], since=chain[:2]).manifest
    assert (told.version, told.blobs.count, len(told.since)) == (2, 1, 2)
    told = verify_snapshot(chain[0]).manifest
    assert (told.version, told.since) == (1, ())


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_a_chain_is_restored_as_a_full_snapshot(chain, tmp_path, content, order):
    since = [chain[at] for at in order]
    restore_snapshot(chain[3], tmp_path / "whole")
    restored, aside = restore_snapshot(chain[2], tmp_path / "made", since=since)
    assert (restored.damaged, aside) == ([], None)
    assert content(tmp_path / "made") == content(tmp_path / "whole")


def test_archives_that_are_missing_or_others_are_named(chain, tmp_path, data, settings):
    full, second, third, whole = chain
    for given in ([], [full], [second], [full, second, whole], [full, whole]):
        with pytest.raises(SnapshotError, match=r"has only what is new since .*--since: that of"):
            restore_snapshot(third, tmp_path / "made", since=given)
    with pytest.raises(SnapshotError, match=r"is a full snapshot\. Leave out --since"):
        restore_snapshot(full, tmp_path / "made", since=[whole])
    with pytest.raises(SnapshotError, match="names an archive twice"):
        verify_snapshot(second, since=[full, full])
    with pytest.raises(SnapshotError, match="there is no such file"):
        verify_snapshot(second, since=[tmp_path / "none.tar"])
    with pytest.raises(DamagedSnapshot, match="no snapshot of sceneprint"):
        verify_snapshot(second, since=[_tar(tmp_path / "other.tar")])
    with pytest.raises(SnapshotError, match=f"at most {MOST_BASES} can be"):
        take_snapshot(settings(data), tmp_path / "d.tar", since=[full] * (MOST_BASES + 1))
    assert not (tmp_path / "made").exists()
    assert not (tmp_path / "d.tar").exists()


def _tar(path: Path) -> Path:
    with tarfile.open(path, "w", format=tarfile.GNU_FORMAT) as tar:
        tar.addfile(tarfile.TarInfo("a"))
    return path


@pytest.mark.parametrize("what", ["a blob", "the end"])
def test_damage_in_an_earlier_archive_is_found(chain, tmp_path, what):
    kept = {*blobs_in(chain[3])}
    with tarfile.open(chain[0]) as tar:
        place = next(one for one in tar.getmembers() if one.name in kept).offset_data
    with chain[0].open("r+b") as file:
        if what == "a blob":
            file.seek(place)
            (byte,) = file.read(1)
            file.seek(place)
            file.write(bytes([byte ^ 1]))
        else:
            file.truncate(chain[0].stat().st_size - 512)
    with pytest.raises(DamagedSnapshot, match="damaged"):
        restore_snapshot(chain[1], tmp_path / "made", since=chain[:1])
    assert not (tmp_path / "made").exists()


def test_a_chain_is_restored_into_a_fleet(chain, tmp_path, postgres_url, content):
    fleet = Settings(
        data_dir=tmp_path / "fleet", database_url=SecretStr(postgres_url), index_dir=None
    )
    restore_to_fleet(chain[2], fleet, since=chain[:2])
    restore_snapshot(chain[3], tmp_path / "whole")
    wanted = content(tmp_path / "whole")
    found = {
        str(path.relative_to(fleet.data_dir)): path.read_bytes()
        for path in (fleet.data_dir / "blobs").rglob("*") if path.is_file()
    }  # fmt: skip
    assert found.keys() == wanted.keys() - {""} | {f"blobs/{MARK}"}
    with Engine(fleet) as engine:
        assert engine.get_map("hall").frames == {"indexed": 3, "received": 4, "deleted": 2}


def test_the_commands(chain, data, tmp_path, sceneprint, monkeypatch):
    full, second = chain[:2]
    made = tmp_path / "made.tar"
    said = sceneprint("snapshot", "--data", data, "--out", made, "--since", full, "--since", second)
    assert f"{made}" in said.stdout
    assert blobs_in(made) == blobs_in(chain[2])
    given = ("--since", second, "--since", full)
    said = sceneprint("restore", made, *given, "--verify-only", "--data", tmp_path / "none")
    assert "is complete" in said.stdout
    sceneprint("restore", made, *given, "--data", tmp_path / "home")
    assert (tmp_path / "home" / "sceneprint.db").is_file()
    said = sceneprint("restore", made, "--data", tmp_path / "other", expect=2)
    assert "--since" in said.stderr
    said = sceneprint("snapshot", "--url", "http://127.0.0.1:9", "--since", full, expect=2)
    assert "--since is for archives of this machine" in said.stderr
    monkeypatch.setenv("SCENEPRINT_SNAPSHOT_URL", "s3://bucket")
    said = sceneprint("snapshot", "--data", data, "--since", full, expect=2)
    assert "Name the archive with --out" in said.stderr
