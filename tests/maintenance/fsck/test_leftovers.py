"""What nobody needs: found when it is old enough, and removed by nobody who must not."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

import pytest

from sceneprint.engine import Engine

DIGEST = "ab" * 32


def age(path: Path, seconds: float) -> None:
    then = time.time() - seconds
    os.utime(path, (then, then))


def kinds(outcomes: Any) -> list[tuple[str, str, bool]]:
    return sorted((one.finding.kind, Path(one.finding.what).name, one.left) for one in outcomes)


@pytest.mark.sqlite_only("compares every file of the data folder")
def test_old_leftovers_are_removed_and_young_ones_are_not(house: Any) -> None:
    """A young one may be an upload between its blob and its commit."""
    blobs, index = house.data / "blobs", next((house.data / "index").glob("hall*"))
    folder = blobs / "ab"
    folder.mkdir(exist_ok=True)
    names = {
        folder / DIGEST: "unreferenced-blob",
        folder / f".{'0' * 12}.part": "unfinished-file",
        index / f"{'cd' * 32}.keys": "unneeded-file",
        index / f".{'1' * 12}.part": "unneeded-file",
        house.place / "cache" / f".{'2' * 12}.part": "unfinished-file",
    }
    for path in names:
        path.write_bytes(b"left by somebody")
    before = house.files()
    assert house.look(repair=True) == []
    assert house.files() == before
    for path in names:
        age(path, 3700)
    expected = sorted((kind, path.name, True) for path, kind in names.items())
    assert kinds(house.look()) == expected
    assert house.files() == before
    assert house.look(grace_s=3800) == []
    assert kinds(house.look(repair=True)) == [(kind, name, False) for kind, name, _ in expected]
    assert [path for path in names if path.exists()] == []
    assert house.look(grace_s=0) == []


def test_foreign_files_are_noted_and_left(house: Any) -> None:
    blobs = house.data / "blobs"
    (blobs / "12").mkdir(exist_ok=True)
    foreign = [blobs / "README", blobs / "12" / "notes.txt", blobs / "12" / DIGEST]
    for path in foreign:
        path.write_text("mine")
        age(path, 1e6)
    found = house.look(repair=True)
    assert sorted(one.finding.what for one in found) == sorted(map(str, foreign))
    assert {(one.finding.kind, one.finding.severity, one.left) for one in found} == {
        ("foreign-file", "note", False)
    }
    assert all(path.exists() for path in foreign)


def test_the_index_of_a_map_that_is_no_more(house: Any) -> None:
    index = house.data / "index"
    (index / "gone-7-61cbf3f4-0123456789ab.1").mkdir()
    (index / "mine").mkdir()
    assert kinds(house.look()) == [("index-of-no-map", "gone-7-61cbf3f4-0123456789ab.1", True)]
    assert [one.left for one in house.look(repair=True)] == [False]
    assert sorted(path.name for path in index.iterdir() if path.is_dir())[-1] == "mine"
    assert house.look() == []


def test_nothing_is_removed_under_a_snapshot(house: Any) -> None:
    """It may refer to what nothing here refers to any more."""
    with Engine(house.settings) as engine:
        frame = engine.list_frames("hall").items[0].frame_id
        ((blob,),) = house.sql("SELECT blob FROM frames WHERE id = ?", frame)
        stray = house.blob(engine.store.blobs.put(b"nothing refers to this"))
        age(stray, 3700)
        data = bytearray(house.blob(blob).read_bytes())
        data[7] ^= 1
        house.blob(blob).write_bytes(data)
        with engine.store.blobs.kept():
            found = house.look(repair=True)
            assert [one.left for one in found] == [True, True]
            assert all("a snapshot is being taken" in one.error for one in found)
        assert stray.exists()
        assert house.blob(blob).exists()
        assert house.sql("SELECT reason FROM frames WHERE id = ?", frame) == [(None,)]
        assert [one.left for one in house.look(repair=True)] == [False, False]
    assert not stray.exists()
