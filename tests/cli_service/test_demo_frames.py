"""Tests of the selection of map and query frames for the demo."""

import json

import numpy as np
import pytest

from sceneprint.errors import DatasetError
from sceneprint.formats.dataset import write_depth_png
from sceneprint_lab.cli.demo import choose_frames


def sequence(folder, frames):
    folder.mkdir(parents=True)
    write_depth_png(folder / "frame-000000.depth.png", np.ones((2, 2), np.float32), 1000.0)
    content = (folder / "frame-000000.depth.png").read_bytes()
    for i in range(1, frames):
        (folder / f"frame-{i:06d}.depth.png").write_bytes(content)


@pytest.fixture
def scene(tmp_path):
    scene = tmp_path / "scene"
    scene.mkdir()
    camera = {"width": 2, "height": 2, "fx": 1, "fy": 1, "cx": 0, "cy": 0}
    (scene / "intrinsics.json").write_text(json.dumps(camera))
    return scene


def numbers(chosen):
    return [int(one.reference.name[-6:]) for one in chosen]


def test_without_split_files_the_first_60_percent_are_the_map_and_5_are_left_out(scene):
    sequence(scene / "seq-01", 100)
    choice = choose_frames(scene)
    assert numbers(choice.database) == list(range(60))
    assert numbers(choice.queries) == list(range(65, 100))
    assert {(one.parent, one.session) for one in choice.queries} == {("scene", "seq-01")}


def test_split_files_decide_where_they_are(scene):
    sequence(scene / "seq-01", 3)
    sequence(scene / "seq-02", 2)
    (scene / "TrainSplit.txt").write_text("sequence2\n")
    (scene / "TestSplit.txt").write_text("sequence1\n")
    choice = choose_frames(scene)
    assert {one.session for one in choice.database} == {"seq-02"}
    assert (len(choice.database), len(choice.queries)) == (2, 3)
    (scene / "TestSplit.txt").unlink()
    with pytest.raises(DatasetError, match=r"\(found: 2\) .* \(found: 0\)"):
        choose_frames(scene)
