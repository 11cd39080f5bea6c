"""Tests of `sceneprint fsck`: output, exit codes, and use beside a service."""

import json

import pytest

from sceneprint.cli import main


@pytest.fixture
def fsck(house, capsys, monkeypatch):
    monkeypatch.setenv("SCENEPRINT_CACHE_DIR", str(house.settings.cache_dir))

    def run(*options, expect):
        capsys.readouterr()
        code = main(["fsck", "--data", str(house.data), *map(str, options)])
        output = capsys.readouterr()
        assert code == expect, output
        return output.err if expect == 2 else output.out

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
    result = json.loads(record.read_text())
    assert result["checked"]["frames"] == 15
    assert [(f["kind"], f["frame_id"], f["done"]) for f in result["findings"]] == [
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
    (house.data / "blobs").rename(house.data / "away")
    assert "The folder does not exist" in fsck("--repair", expect=2)
