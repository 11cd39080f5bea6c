"""Tests of `sceneprint evaluate` on a small synthetic building."""

import json
import shutil

import pytest

from sceneprint.cli import main
from sceneprint.models import save_model

ROW = {"within_5cm_5deg", "within_10cm_10deg", "median_translation_m", "median_rotation_deg"}
RETRIEVAL = {"top1_overlap_50", "top5_overlap_50", "top1_overlap_30", "mean_overlap"}


@pytest.fixture(scope="module")
def model_file(small_model, tmp_path_factory):
    path = tmp_path_factory.mktemp("model") / "small.safetensors"
    save_model(small_model, path)
    return path


def evaluated(folder, *arguments):
    path = folder / "figures.json"
    assert main(["evaluate", *map(str, arguments), "--json", str(path)]) == 0
    return json.loads(path.read_text(), parse_constant=pytest.fail)


@pytest.fixture(scope="module")
def ranges(building):
    room = building / "room-000"
    return [f"{room}@db=0:12:3,queries=1:9:3", "--distractors", str(building / "room-001")]


@pytest.fixture(scope="module")
def figures(ranges, model_file, tmp_path_factory):
    folder = tmp_path_factory.mktemp("figures")
    return evaluated(folder, *ranges, "--model", model_file, "--jobs", 1), folder


def test_the_json_has_every_key(figures):
    found, _ = figures
    for row in ("R", "VR", "DR", "VDR", "pose_average"):
        more = RETRIEVAL | {"right_scene"} if row in ("R", "DR") else set()
        assert set(found[row]) == ROW | more
    assert {"precision", "recall", "accepted"} <= set(found["validation"])
    assert RETRIEVAL == set(found["oracle"]) == set(found["random"])
    assert set(found["diversity"]["translation"]) == {"R", "DR", "VR", "VDR"}
    assert found["counts"] == {"queries": 3, "database": 4 + 12, "left_out": 0}
    assert sum(found["lost"].values()) == 3
    told = found["answers"]
    assert told["queries"] == 3
    shares = ("found_right", "found_wrong", "ambiguous", "not_found")
    assert sum(told[key] for key in shares) == pytest.approx(1.0)
    assert found["milliseconds"]["answer"] > 0
    assert found["milliseconds"]["prepare"] > 0
    assert found["settings"]["seed"] == 0
    assert found["R"]["within_10cm_10deg"] == found["DR"]["within_10cm_10deg"]
    assert found["oracle"]["mean_overlap"] > 0.5  # frames of a path, centimetres apart


def test_neighbouring_frames_of_a_room_are_found(figures):
    found, _ = figures
    assert found["VDR"]["within_10cm_10deg"] == 1.0
    assert found["validation"]["accepted_strong_of_other_scenes"] == 0


def test_a_scene_that_is_absent(ranges, model_file, tmp_path, capsys):
    options = ("--absent", "--levels", 1, "--metric", "l2", "--jobs", 1)
    found = evaluated(tmp_path, *ranges, "--model", model_file, *options)
    assert found["absent"]["queries"] == 3
    assert found["absent"]["accepted_strong"] == 0.0
    assert found["R"]["within_10cm_10deg"] is None
    assert "3 queries whose scene is not in the database" in capsys.readouterr().out


def test_frames_that_cannot_be_used_are_named(building, model_file, tmp_path, capsys):
    copy = shutil.copytree(building / "room-000", tmp_path / "room")
    (copy / "seq-01" / "frame-000001.pose.txt").unlink()
    (copy / "seq-01" / "frame-000002.depth.png").write_bytes(b"no picture")
    found = evaluated(
        tmp_path, copy, "--db", "0:8:2", "--queries", "1:12:4", "--model", model_file, "--jobs", 1
    )
    assert found["counts"] == {"queries": 2, "database": 3, "left_out": 2}
    reasons = {one["name"]: one["reason"] for one in found["left_out"]}
    assert "its pose is unknown" in reasons["room/seq-01/frame-000001"]
    assert "frame-000002" in reasons["room/seq-01/frame-000002"]
    assert "left out" in capsys.readouterr().out


def test_wrong_options_leave_no_folder(building, model_file, tmp_path):
    asked = [building / "room-000", "--db", "0:4", "--queries", "5:6", "--model", model_file]
    asked += ["--levels", "99", "--json", tmp_path / "a" / "b.json"]
    assert main(["evaluate", *map(str, asked)]) == 2
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["{room}"], "Add --db and --queries"),
        (["{room}", "--db", "0:4", "--queries", "5:99"], "outside the 12 frames"),
        (["{room}", "--db", "0:4", "--queries", "3:6"], "selected twice"),
        (["{room}", "--db", "0:4", "--queries", "5:6", "--levels", "9"], "Choose from 1 to"),
        (["{room}", "--db", "0:4", "--queries", "5:6", "--db-step", "0"], "--db-step"),
        (["/nowhere", "--db", "0:4", "--queries", "5:6"], "does not exist"),
    ],
)
def test_wrong_options_are_one_line_and_exit_code_2(
    arguments, message, building, model_file, capsys
):
    filled = [a.format(room=building / "room-000") for a in arguments]
    try:
        code = main(["evaluate", *filled, "--model", str(model_file), "--jobs", "1"])
    except SystemExit as stop:  # argparse's own way
        code = int(str(stop.code))
    assert code == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert lines[-1].startswith("sceneprint evaluate: ")
    assert message in lines[-1]
