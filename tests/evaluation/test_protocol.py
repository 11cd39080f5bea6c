"""Tests of the split into database and query frames."""

from pathlib import Path

import numpy as np
import pytest

from sceneprint.errors import DatasetError
from sceneprint.formats.dataset import Camera, write_depth_png, write_intrinsics, write_pose
from sceneprint.types import Intrinsics
from sceneprint_lab.evaluation.protocol import (
    PathRanges,
    Range,
    choose,
    parse_part,
    parse_ranges,
)


def scene(folder, sequences):
    """A 7-Scenes scene of sequences with so many tiny frames."""
    folder.mkdir(parents=True)
    write_intrinsics(folder, Camera(Intrinsics(8, 6, 7, 7, 3.5, 2.5)))
    for number, frames in sequences.items():
        own = folder / f"seq-{number:02d}"
        own.mkdir()
        for i in range(frames):
            depth = np.full((6, 8), 1.0 + i, np.float32)
            write_depth_png(own / f"frame-{i:06d}.depth.png", depth, 1000.0)
            write_pose(own / f"frame-{i:06d}.pose.txt", np.eye(4))
    return folder


def names(protocol, use):
    return [f.name.replace("frame-00000", "") for f in protocol.frames if f.use == use]


@pytest.mark.parametrize(
    ("text", "ranges"),
    [
        ("0:600", [Range(0, 600, None)]),
        ("650:1000:2", [Range(650, 1000, 2)]),
        ("650:", [Range(650, None, None)]),
        (":25", [Range(None, 25, None)]),
        ("0:25+50:75", [Range(0, 25, None), Range(50, 75, None)]),
        ("::3", [Range(None, None, 3)]),
    ],
)
def test_ranges(text, ranges):
    assert list(parse_ranges(text)) == ranges


@pytest.mark.parametrize("text", ["", "7", "a:b", "5:5", "0:9:0", "0:9:1:1", "-5:9"])
def test_what_is_no_range(text):
    with pytest.raises(DatasetError, match=r"START:STOP|STOP above START"):
        parse_ranges(text)


def test_parts():
    assert parse_part("a/b@c") == PathRanges(Path("a/b@c"))
    assert parse_part("a@b@db=0:9,queries=9:") == PathRanges(
        Path("a@b"), (Range(0, 9, None),), (Range(9, None, None),)
    )
    assert parse_part("x@queries=:3") == PathRanges(Path("x"), None, (Range(None, 3, None),))
    for text in ("x@db=0:9,db=0:9", "x@db=0:9,q=3:4", "x@db="):
        with pytest.raises(DatasetError):
            parse_part(text)


def test_ranges_count_over_the_sequences_of_a_path(tmp_path):
    path = scene(tmp_path / "kitchen", {1: 4, 2: 4})
    found = choose(
        [PathRanges(path)],
        database=parse_ranges("0:6"),
        queries=parse_ranges("6:8"),
        database_step=2,
    )
    assert names(found, "database") == ["kitchen/seq-01/0", "kitchen/seq-01/2", "kitchen/seq-02/0"]
    assert names(found, "query") == ["kitchen/seq-02/2", "kitchen/seq-02/3"]
    assert not found.split
    # a step of its own is not stepped over again
    found = choose([parse_part(f"{path}@db=0:6:3,queries=7:")], database_step=2)
    assert names(found, "database") == ["kitchen/seq-01/0", "kitchen/seq-01/3"]


def test_what_cannot_be_measured(tmp_path):
    path = scene(tmp_path / "kitchen", {1: 4})
    twin = scene(tmp_path / "other" / "kitchen", {1: 4})
    some, rest = parse_ranges("0:2"), parse_ranges("2:4")
    with pytest.raises(DatasetError, match=r"Add --db and --queries"):
        choose([PathRanges(path)])
    with pytest.raises(DatasetError, match=r"selected twice, as database and as query"):
        choose([PathRanges(path)], database=some, queries=parse_ranges("1:4"))
    with pytest.raises(DatasetError, match=r"outside the 4 frames"):
        choose([PathRanges(path)], database=some, queries=parse_ranges("2:5"))
    with pytest.raises(DatasetError, match=r"also has the name kitchen"):
        choose([PathRanges(path)], [twin], database=some, queries=rest)
    with pytest.raises(DatasetError, match=r"No frame is selected as query"):
        choose([PathRanges(path, database=some)])
    with pytest.raises(DatasetError, match=r"No frame is selected as database"):
        choose([PathRanges(path, queries=some)])
