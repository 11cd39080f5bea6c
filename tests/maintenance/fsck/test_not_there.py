"""What is not there is not made, and what is there is not taken for lost: disks come unmounted."""

from __future__ import annotations

import os
import shutil
import time
from pathlib import Path
from typing import Any

import pytest

from sceneprint.cli import main
from sceneprint.engine import Engine
from sceneprint.errors import UnusableStore
from sceneprint_client.api import JobState


def blobs(house: Any) -> set[str]:
    return {path.name for path in (house.data / "blobs").rglob("*") if path.is_file()}


def age(house: Any) -> None:
    """As if all had been there for long."""
    for path in (house.data / "blobs").rglob("*"):
        os.utime(path, (time.time() - 7200,) * 2)


def refused(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    assert main([str(one) for one in arguments]) == 2
    out, err = capsys.readouterr()
    assert (out, len(err.splitlines())) == ("", 1)
    return err


@pytest.mark.sqlite_only("looks at the database as a file of the data folder")
def test_a_repair_makes_no_database_and_so_removes_no_upload(
    house: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    for path in house.data.glob("sceneprint.db*"):
        path.unlink()
    age(house)
    before = blobs(house)
    assert "there is no database" in refused(
        capsys, "fsck", "--data", house.data, "--repair"
    )  # fmt: skip
    assert blobs(house) == before
    assert not list(house.data.glob("sceneprint.db*"))


@pytest.mark.sqlite_only("looks at the database as a file of the data folder")
def test_blobs_beside_a_database_that_knows_no_frame_are_left_alone(house: Any) -> None:
    for path in house.data.glob("sceneprint.db*"):
        path.unlink()
    with pytest.raises(UnusableStore):
        house.look(repair=True)
    kept = house.data / "kept"
    (house.data / "blobs").rename(kept)
    Engine(house.settings).close()  # a new, empty store; then the disk is back
    shutil.rmtree(house.data / "blobs")
    kept.rename(house.data / "blobs")
    age(house)
    before = blobs(house)
    found = house.look(repair=True)
    assert {one.finding.severity for one in found if one.finding.kind == "unreferenced-blob"} \
        == {"note"}  # fmt: skip
    assert [one for one in found if one.done and one.finding.kind == "unreferenced-blob"] == []
    assert blobs(house) == before


def test_an_empty_folder_of_blobs_is_not_taken_for_the_loss_of_all(house: Any) -> None:
    away = house.place / "away"
    (house.data / "blobs").rename(away)
    (house.data / "blobs").mkdir()  # the mount point of a disk that is not mounted
    before = house.sql("SELECT state, reason FROM frames ORDER BY number")
    with pytest.raises(UnusableStore, match="not one upload is there"):
        house.look(repair=True)
    assert house.sql("SELECT state, reason FROM frames ORDER BY number") == before
    assert {one.finding.kind for one in house.look()} >= {"missing-upload"}  # looking goes on


def test_a_frame_that_failed_for_want_of_its_upload_is_signed_when_it_is_back(house: Any) -> None:
    ((number, digest),) = house.sql(
        "SELECT number, blob FROM frames WHERE state = 'received' LIMIT 1"
    )
    path = house.blob(digest)
    content = path.read_bytes()
    path.unlink()
    house.look(repair=True)
    assert house.sql("SELECT state FROM frames WHERE number = ?", number) == [("failed",)]
    path.write_bytes(content)
    house.look(repair=True)
    assert house.sql("SELECT state FROM frames WHERE number = ?", number) == [("received",)]
    assert JobState.SUCCEEDED in house.work()
    assert house.sql("SELECT state FROM frames WHERE number = ?", number) == [("indexed",)]


def test_a_frame_that_is_to_be_signed_again_is_not_found_meanwhile(
    house: Any, uploads: list[Any]
) -> None:
    ((number, frame_id),) = house.sql(
        "SELECT frames.number, frames.id FROM frames JOIN signatures "
        "ON frame_number = number WHERE state = 'indexed' ORDER BY number LIMIT 1"
    )
    assert any(name == frame_id for name, _ in house.answers(uploads[:1])[0])
    house.sql("UPDATE signatures SET checksum = checksum + 1 WHERE frame_number = ?", number)
    house.look(repair=True)
    assert not any(name == frame_id for name, _ in house.answers(uploads[:1])[0])
    house.work()
    assert any(name == frame_id for name, _ in house.answers(uploads[:1])[0])


def test_a_frame_that_was_kept_once_is_kept_when_it_is_repaired(house: Any) -> None:
    """It had been sent with a condition, and others like it have come since."""
    ((number,),) = house.sql(
        "SELECT number FROM frames WHERE state = 'indexed' ORDER BY number LIMIT 1"
    )
    house.sql("UPDATE frames SET novelty = 1.0 WHERE number = ?", number)
    house.sql("UPDATE signatures SET checksum = checksum + 1 WHERE frame_number = ?", number)
    house.look(repair=True)
    house.work()
    assert house.sql("SELECT state FROM frames WHERE number = ?", number) == [("indexed",)]


def test_a_revision_that_no_map_can_have_is_not_counted_on_from(house: Any) -> None:
    ((number, before),) = house.sql(
        "SELECT frames.number, maps.revision FROM frames JOIN maps ON map_number = maps.number "
        "WHERE state = 'indexed' ORDER BY frames.number LIMIT 1"
    )
    house.sql("UPDATE frames SET revision = ? WHERE number = ?", 2**63 - 1, number)
    house.look(repair=True)
    house.work()
    ((state, own, after),) = house.sql(
        "SELECT state, frames.revision, maps.revision FROM frames "
        "JOIN maps ON map_number = maps.number WHERE frames.number = ?", number,
    )  # fmt: skip
    assert state == "indexed"
    assert before < own <= after < before + 100


def test_a_snapshot_makes_up_for_no_disk(
    house: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.rmtree(house.data / "blobs")
    out = tmp_path / "out"
    refused(capsys, "snapshot", "--data", house.data, "--to", out)
    assert not out.exists()
    assert not (house.data / "blobs").exists()
    Engine(house.settings).close()  # nor does a service that starts
    assert not (house.data / "blobs").exists()


@pytest.mark.sqlite_only("looks at the database as a file of the data folder")
@pytest.mark.parametrize(
    "command",
    [["purge"], ["reencode", "hall", "--status"]],
)  # fmt: skip
def test_a_mistyped_folder_is_not_made(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], command: list[str]
) -> None:
    typo = tmp_path / "typo"
    assert "there is no database" in refused(capsys, *command, "--data", typo)
    assert not typo.exists()


def test_odd_arguments_are_refused_in_a_line(
    house: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    bad = os.fsdecode(b"caf\xe9")
    assert "is not valid UTF-8" in refused(capsys, "fsck", "--data", house.data, "--map", bad)
    assert main(["fsck", "--data", str(house.data), "--grace", "1" + "0" * 400]) in (0, 1)
