"""Tests of the split into database and query frames, and of their overlap."""

from pathlib import Path

import numpy as np
import pytest

from sceneprint.errors import DatasetError
from sceneprint.formats.dataset import Camera, write_depth_png, write_intrinsics, write_pose
from sceneprint.types import Cloud, DepthFrame, Intrinsics
from sceneprint_lab.evaluation.protocol import (
    PathRanges,
    Range,
    choose,
    overlap,
    overlaps,
    parse_part,
    parse_ranges,
    view_of,
)

CAMERA = Intrinsics(80, 60, 70.0, 70.0, 39.5, 29.5)


def wall(shift=0.0, distance=2.0):
    pose = np.eye(4)
    pose[0, 3] = shift
    return DepthFrame(np.full((60, 80), distance, np.float32), CAMERA, pose=pose)


def test_by_hand():
    # the grid has 4 columns at 10, 30, 50, 70; 2 m away, 40 px are 40 / 70 * 2 m: two columns
    half = 40 / 70 * 2
    others = [wall(), wall(half), wall(100.0), wall(0.0, 3.0)]
    actual = overlaps([view_of(wall())], [view_of(other) for other in others])
    np.testing.assert_allclose(actual.mean, [[1.0, 0.5, 0.0, 0.0]], atol=1e-12)
    np.testing.assert_allclose(actual.least, [[1.0, 0.5, 0.0, 0.0]], atol=1e-12)


def test_the_two_tolerances():
    # 10.5 cm apart at 2 m: within 5 cm + 3 % (11 cm), not within 10 cm
    assert overlap(view_of(wall()), view_of(wall(0.0, 2.105))) == (1.0, 0.0)
    assert overlap(view_of(wall()), view_of(wall(0.0, 2.095))) == (1.0, 1.0)


def test_the_mean_and_the_smaller_direction():
    half = wall()
    half.depth[:, 40:] = 0  # sees two of the four columns, and all it sees is seen by the other
    assert overlap(view_of(wall()), view_of(half)) == (0.75, 0.5)
    empty = wall()
    empty.depth[:] = 0
    assert overlap(view_of(wall()), view_of(empty)) == (0.0, 0.0)


def points_wall(left, right, ahead=2.0, *, at=0.0, has_viewpoint=True):
    """A wall of points 1 cm apart across x, 5 cm up, seen from `at` on the x axis."""
    x, y = np.meshgrid(np.arange(left, right - 1e-9, 0.01), np.arange(-0.5, 0.5, 0.05))
    points = np.column_stack([x.ravel() - at, y.ravel(), np.full(x.size, ahead)])
    pose = np.eye(4)
    pose[0, 3] = at
    return Cloud(points.astype(np.float32), has_viewpoint, pose=pose)


def test_half_of_a_wall():
    mean, least = overlap(view_of(points_wall(0, 1)), view_of(points_wall(0.5, 1.5, at=0.3)))
    # half, and what lies within 5 cm + 3 % (or 10 cm + 3 %) of 2 m beyond the edge
    assert mean == pytest.approx(0.5 + 0.11, abs=0.02)
    assert least == pytest.approx(0.5 + 0.16, abs=0.02)


def test_the_two_tolerances_grow_with_range():
    near, far = points_wall(0, 1), points_wall(0, 1, 20.0)
    assert overlap(view_of(near), view_of(points_wall(0, 1, 2.13))) == (0.0, 1.0)  # 11 to 16 cm
    assert overlap(view_of(near), view_of(points_wall(0, 1, 2.3))) == (0.0, 0.0)
    assert overlap(view_of(far), view_of(points_wall(0, 1, 20.6))) == (1.0, 1.0)  # 65 cm at 20 m


def test_without_a_viewpoint_they_do_not():
    far = view_of(points_wall(0, 1, 20.0, has_viewpoint=False))
    assert overlap(far, view_of(points_wall(0, 1, 20.2, has_viewpoint=False))) == (0.0, 0.0)
    assert overlap(far, view_of(points_wall(0, 1, 20.08, has_viewpoint=False))) == (0.0, 1.0)


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
    actual = choose(
        [PathRanges(path)],
        database=parse_ranges("0:6"),
        queries=parse_ranges("6:8"),
        database_step=2,
    )
    assert names(actual, "database") == ["kitchen/seq-01/0", "kitchen/seq-01/2", "kitchen/seq-02/0"]
    assert names(actual, "query") == ["kitchen/seq-02/2", "kitchen/seq-02/3"]
    assert not actual.split
    # a step of its own is not stepped over again
    actual = choose([parse_part(f"{path}@db=0:6:3,queries=7:")], database_step=2)
    assert names(actual, "database") == ["kitchen/seq-01/0", "kitchen/seq-01/3"]


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
