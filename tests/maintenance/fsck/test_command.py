"""Tests of `sceneprint fsck`: output, exit codes, and use beside a service."""

import json
import os
import shutil

import pytest

from sceneprint.cli import main
from tests.whole_engine import Engine


@pytest.fixture
def fsck(house, capsys, monkeypatch):
    """Runs the command in this process and checks its exit code."""
    monkeypatch.setenv("SCENEPRINT_CACHE_DIR", str(house.settings.cache_dir))

    def run(*options, expect):
        capsys.readouterr()
        code = main(["fsck", "--data", str(house.data), *map(str, options)])
        said = capsys.readouterr()
        assert code == expect, said
        return said.err if expect == 2 else said.out

    return run


def test_it_says_what_it_would_do_and_what_it_did(house, fsck, tmp_path):
    assert fsck(expect=0).splitlines() == [
        "checked 1 models, 15 frames, 13 signatures, 27 blobs, 27 files, 1 indexes",
        "no problems found",
    ]
    house.sql("INSERT INTO frame_tags VALUES (1, 'other')")
    (house.data / "blobs" / "notes.txt").write_text("mine")
    ((frame,),) = house.sql("SELECT id FROM frames WHERE number = 1")
    record = tmp_path / "found.json"
    before = house.files()
    lines = fsck("--json", record, expect=1).splitlines()
    assert house.files() == before
    assert lines[1] == (
        f"damage    stale-value  frame {frame} of map hall: the search columns for "
        "tags and position differ from the frame's values; would: copy them from the frame"
    )
    assert lines[0].startswith("note      foreign-file  ")
    assert lines[-1] == (
        "1 damaged, 0 left over; nothing was changed: `sceneprint fsck --repair` can repair 1"
    )
    told = json.loads(record.read_text())
    assert told["checked"]["frames"] == 15
    assert [(one["kind"], one["frame_id"], one["done"]) for one in told["findings"]] == [
        ("foreign-file", None, None),
        ("stale-value", frame, None),
    ]
    lines = fsck("--repair", expect=0).splitlines()
    assert lines[1].endswith("; done: copied from the frame")
    assert lines[-1].startswith("1 damaged, 0 left over: 1 repaired, 0 not. Run it again")
    assert fsck("--map", "hall", expect=0).splitlines()[-1] == "no problems found"


@pytest.mark.sqlite_only("PostgreSQL holds no such row")
def test_what_cannot_be_checked_or_repaired_has_its_own_code(house, fsck):
    assert fsck("--map", "cellar", expect=2).startswith("sceneprint fsck: There is no map 'cellar'")
    house.sql("UPDATE frames SET tags = '[' WHERE number = 3")
    assert "would: restore a backup" in fsck("--repair", expect=1)
    with pytest.raises(SystemExit):
        fsck("--repair", "--quick", expect=2)
    with pytest.raises(ValueError, match="quick"):
        house.look(quick=True, repair=True)
    assert "is not valid UTF-8" in fsck("--map", os.fsdecode(b"caf\xe9"), expect=2)
    fsck("--grace", "1" + "0" * 400, expect=1)
    (house.data / "blobs").rename(house.data / "away")
    said = fsck("--repair", expect=2)
    assert "The folder does not exist" in said
    assert said.count("\n") == 1


def test_what_is_not_there_is_not_made(house, tmp_path, capsys):
    typo, out = tmp_path / "typo", tmp_path / "out"
    shutil.rmtree(house.data / "blobs")
    for command in (
        ["fsck", "--purge", "--data", typo],
        ["reencode", "hall", "--status", "--data", typo],
        ["snapshot", "--data", house.data, "--to", out],
    )[0 if house.is_sqlite else 2 :]:
        assert main([str(one) for one in command]) == 2
        said = capsys.readouterr()
        assert (said.out, said.err.count("\n")) == ("", 1)
    Engine(house.settings).close()  # nor does a service that starts
    assert not any(path.exists() for path in (typo, out, house.data / "blobs"))
