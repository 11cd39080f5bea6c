"""Tests of `sceneprint evaluate` and `evaluate-pairs` on synthetic rooms and a recording."""

import json
import shutil
import sys

import numpy as np
import pytest

from sceneprint.cli import main
from sceneprint_lab.evaluation.baselines import vlad
from sceneprint_lab.evaluation.pair_run import BINS

ROW = {"within_5cm_5deg", "within_10cm_10deg", "median_translation_m", "median_rotation_deg"}
RETRIEVAL = {"top1_overlap_50", "top5_overlap_50", "top1_overlap_30", "mean_overlap"}


@pytest.fixture(scope="module")
def ranges(building):
    room = building / "room-000"
    return [f"{room}@db=0:12:3,queries=1:9:3", "--distractors", str(building / "room-001")]


@pytest.fixture(scope="module")
def figures(ranges, model_file, figures_of, tmp_path_factory):
    folder = tmp_path_factory.mktemp("figures")
    return figures_of(folder, "evaluate", *ranges, "--model", model_file)


def test_the_json_has_every_key(figures):
    for row in ("R", "VR", "DR", "VDR", "pose_average"):
        more = RETRIEVAL | {"right_scene"} if row in ("R", "DR") else set()
        assert set(figures[row]) == ROW | more
    assert {"precision", "recall", "accepted"} <= set(figures["validation"])
    assert RETRIEVAL == set(figures["oracle"]) == set(figures["random"])
    assert set(figures["diversity"]["translation"]) == {"R", "DR", "VR", "VDR"}
    assert figures["counts"] == {"queries": 3, "database": 4 + 12, "left_out": 0}
    assert sum(figures["lost"].values()) == 3
    answers = figures["answers"]
    assert answers["queries"] == 3
    shares = ("found_right", "found_wrong", "ambiguous", "not_found")
    assert sum(answers[key] for key in shares) == pytest.approx(1.0)
    assert figures["milliseconds"]["answer"] > 0
    assert figures["milliseconds"]["prepare"] > 0
    assert figures["settings"]["seed"] == 0
    assert figures["R"]["within_10cm_10deg"] == figures["DR"]["within_10cm_10deg"]
    assert figures["oracle"]["mean_overlap"] > 0.5  # frames of a path, centimetres apart


def test_neighbouring_frames_of_a_room_are_found(figures):
    assert figures["VDR"]["within_10cm_10deg"] == 1.0
    assert figures["validation"]["accepted_strong_of_other_scenes"] == 0


def test_a_scene_that_is_absent(ranges, model_file, figures_of, tmp_path, capsys):
    options = ("--absent", "--levels", 1, "--metric", "l2")
    values = figures_of(tmp_path, "evaluate", *ranges, "--model", model_file, *options)
    assert values["absent"]["queries"] == 3
    assert values["absent"]["accepted_strong"] == 0.0
    assert values["R"]["within_10cm_10deg"] is None
    assert "3 queries whose scene is not in the database" in capsys.readouterr().out


def test_frames_that_cannot_be_used_are_named(building, model_file, figures_of, tmp_path, capsys):
    copy = shutil.copytree(building / "room-000", tmp_path / "room")
    (copy / "seq-01" / "frame-000001.pose.txt").unlink()
    (copy / "seq-01" / "frame-000002.depth.png").write_bytes(b"no picture")
    arguments = (copy, "--db", "0:8:2", "--queries", "1:12:4", "--model", model_file)
    values = figures_of(tmp_path, "evaluate", *arguments)
    assert values["counts"] == {"queries": 2, "database": 3, "left_out": 2}
    reasons = {frame["name"]: frame["reason"] for frame in values["left_out"]}
    assert "its pose is unknown" in reasons["room/seq-01/frame-000001"]
    assert "frame-000002" in reasons["room/seq-01/frame-000002"]
    assert "left out" in capsys.readouterr().out


@pytest.mark.thorough
def test_redkitchen_among_other_scenes(data_root, tmp_path):
    """Every 15th frame of the forward database, and other scenes in it as well."""
    kitchen, desk = data_root / "7scenes/redkitchen", data_root / "tum/fr1_rpy"
    path = tmp_path / "figures.json"
    arguments = [
        "evaluate",
        f"{kitchen}@db=0:600:15,queries=650:1000:25",
        f"{desk}@db=0:217:12,queries=235::25",
        "--jobs",
        "1",
        "--json",
        str(path),
    ]
    assert main(arguments) == 0
    actual = json.loads(path.read_text())
    assert actual["counts"] == {"queries": 20, "database": 59, "left_out": 0}
    assert actual["R"]["right_scene"] >= 0.95
    assert actual["VDR"]["within_10cm_10deg"] >= 0.95
    assert actual["pose_average"]["within_10cm_10deg"] >= 0.95
    bound = actual["bound"]["VDR"]["within_5cm_5deg"]
    assert actual["VDR"]["within_5cm_5deg"] >= bound - 0.05
    assert actual["validation"]["precision"] >= 0.97
    assert actual["validation"]["accepted_strong_of_other_scenes"] == 0
    translation = actual["diversity"]["translation"]
    assert translation["VDR"]["std_m"] > translation["VR"]["std_m"]
    assert translation["DR"]["std_m"] > translation["R"]["std_m"]
    assert actual["diversity"]["coverage"]["ratio_of_means"] > 1.05


@pytest.fixture
def arguments(building, model_file):
    rooms = [str(building / room) for room in ("room-000", "room-001")]
    few = ["--pairs", "3", "--negatives", "8", "--apart", "2", "--frames", "8"]
    return [*rooms, "--model", str(model_file), *few]


def test_pairs_of_rooms_are_registered_and_others_refused(arguments, figures_of, tmp_path):
    actual = figures_of(tmp_path, "evaluate-pairs", *arguments)
    assert actual["counts"]["frames"] == {"room-000": 8, "room-001": 8}
    assert actual["bins"]["70-100"]["pairs"] > 0
    assert actual["bins"]["70-100"]["success"]["right"] == 1.0
    assert actual["bins"]["70-100"]["bound"]["right"] == 1.0
    assert actual["negatives"]["cross_scene"]["pairs"] == 8
    assert actual["negatives"]["cross_scene"]["accepted"] == 0
    assert actual["negatives"]["cross_scene"]["upper"] == pytest.approx(1 - 0.05 ** (1 / 8))
    assert set(actual["bins"]) == set(BINS)
    assert {"precision", "recall", "accepted"} <= set(actual["bins"]["10-30"]["validation"])
    assert actual["roc"]["overlap"]["area"] > 0.9
    assert actual["settings"]["right"] == [0.1, 10.0]


def test_baselines_without_open3d_are_refused(arguments, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "open3d", None)
    assert main(["evaluate-pairs", *arguments, "--baselines"]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "apt-get install libgl1" in line


def test_vlad_by_hand():
    words = np.array([[0.0, 0.0], [10.0, 0.0], [0.0, 10.0]])
    local = np.array([[3.0, 0.0], [0.0, 4.0], [10.0, 2.0]], np.float32)
    # the first word is left (3, 4): 0.6, 0.8; the second (0, 2): 0, 1; the third nothing
    expected = np.array([0.6, 0.8, 0.0, 1.0, 0.0, 0.0]) / np.sqrt(2)
    np.testing.assert_allclose(vlad(local, words), expected, atol=1e-7)
    assert not vlad(words.astype(np.float32), words).any()
