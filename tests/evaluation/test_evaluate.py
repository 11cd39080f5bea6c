"""Tests of `sceneprint evaluate` on a small synthetic building."""

import json
import math
import shutil

import pytest
from PIL import Image

import sceneprint as sp
from sceneprint.cli import main
from sceneprint.geometry.rigid import pose_difference
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


def copied(room, to):
    """A room of which frames may be spoilt."""
    shutil.copytree(room, to)
    return to


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


@pytest.mark.thorough
def test_the_number_of_processes_changes_nothing(figures, ranges, model_file, tmp_path):
    alone, _ = figures
    several = evaluated(tmp_path, *ranges, "--model", model_file, "--jobs", 2)
    assert several["milliseconds"].keys() == alone["milliseconds"].keys()
    assert several | {"milliseconds": None} == alone | {"milliseconds": None}


def test_the_answers_are_those_of_the_library(building, small_model, model_file, tmp_path):
    """What a service gives for the same frames, with the seed it is given, and no other."""
    room, seed = building / "room-000", 3
    found = evaluated(
        tmp_path, room, "--db", "0:12:2", "--queries", "1:9:4", "--model", model_file,
        "--seed", seed, "--jobs", 1,
    )  # fmt: skip
    signer = sp.open_signer(small_model)
    (sequence,) = sp.find_sequences(room)
    seen = [sp.prepare(reference.read(), signer) for reference in sequence.frames]
    names = [f"room-000/{reference.name}" for reference in sequence.frames]
    database = range(0, 12, 2)
    signatures = [seen[i][0] for i in database]
    stored = [sp.write_geometry(geometry) for _, geometry in seen]
    assert [one["name"] for one in found["per_query"]] == [names[i] for i in (1, 5)]
    for i, one in zip((1, 5), found["per_query"], strict=True):
        ranking = sp.retrieve(seen[i][0], signatures, signer.model)
        chosen = sp.diversify(ranking, signatures)
        matches = sp.associate(
            sp.read_geometry(stored[i]),
            ranking,
            chosen.indices.tolist(),
            lambda index: sp.read_geometry(stored[database[index]]),
            k=99,
            seed=seed,
        )
        assert one["ranking"] == [names[database[j]] for j in ranking.indices[:10]]
        assert one["selection"] == [names[database[ranking.indices[j]]] for j in chosen.indices]
        assert {match.validation.seed for match in matches} == {seed}
        # the average turns on the last bits of sums, whose order differs with where arrays lie
        expected = answer_by_library(room, i, stored, ranking, chosen, seed)
        assert one["answer"] == {
            name: value if isinstance(value, str) else pytest.approx(value, rel=1e-9)
            for name, value in expected.items()
        }
        assert one["matches"] == [
            {
                "match": names[database[match.index]],
                "distance": match.distance,
                "status": match.validation.status,
                "strength": match.validation.strength,
                "T_match_query": None if (T := match.validation.T_match_query) is None
                else T.tolist(),
            }
            for match in matches
        ]  # fmt: skip


def answer_by_library(room, i, stored, ranking, chosen, seed):
    """The whole answer to frame `i`, of every second frame: stopped at five accepted matches."""
    (sequence,) = sp.find_sequences(room)
    poses = [reference.read().pose for reference in sequence.frames]
    query, *_ = geometries = [sp.read_geometry(one) for one in (stored[i], *stored[0:12:2])]
    matches = sp.associate(
        query, ranking, chosen.indices.tolist(), lambda row: geometries[row + 1], seed=seed
    )
    views_of = sp.views_of_rows(matches, poses[0:12:2], lambda row: geometries[row + 1])
    there = sp.localize([sp.QueryFrame(query, matches)], poses[0:12:2], None, views_of)
    metres, radians = pose_difference(there.average.T, poses[i])
    return {
        "status": "found",
        "strength": there.strength,
        "translation_m": metres,
        "rotation_deg": math.degrees(radians),
    }


def test_a_scene_that_is_absent(ranges, model_file, tmp_path, capsys):
    options = ("--absent", "--levels", 1, "--metric", "l2", "--jobs", 1)
    found = evaluated(tmp_path, *ranges, "--model", model_file, *options)
    assert found["absent"]["queries"] == 3
    assert found["absent"]["accepted_strong"] == 0.0
    assert found["R"]["within_10cm_10deg"] is None
    assert "3 queries whose scene is not in the database" in capsys.readouterr().out


def test_frames_that_cannot_be_used_are_named(building, model_file, tmp_path, capsys):
    copy = copied(building / "room-000", tmp_path / "room")
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


def test_distractors_need_no_poses(building, model_file, tmp_path):
    plain = tmp_path / "elsewhere"
    plain.mkdir()
    room = building / "room-001"
    (plain / "intrinsics.json").write_bytes((room / "intrinsics.json").read_bytes())
    for i in range(2):
        depth = (room / "seq-01" / f"frame-{i:06d}.depth.png").read_bytes()
        (plain / f"{i}.png").write_bytes(depth)
    asked = (building / "room-000", "--queries", "0:1", "--distractors", plain)
    found = evaluated(tmp_path, *asked, "--model", model_file, "--jobs", 1)
    assert found["counts"] == {"queries": 1, "database": 2, "left_out": 0}
    assert found["absent"]["queries"] == 1


def test_only_frames_that_overlap_little(building, model_file, tmp_path):
    asked = (building / "room-000", "--db", "0:12:3", "--queries", "1:9:3", "--max-overlap", 0.7)
    found = evaluated(tmp_path, *asked, "--model", model_file, "--jobs", 1)
    assert found["oracle"]["mean_overlap"] is None or found["oracle"]["mean_overlap"] < 0.9
    assert found["settings"]["max_overlap"] == 0.7


@pytest.fixture(scope="module")
def seven_scenes(building, tmp_path_factory):
    """Two scenes laid out as in the official download: splits, a picture, no intrinsics.json."""
    folder = tmp_path_factory.mktemp("7scenes")
    for room, scene in (("room-000", "chess"), ("room-001", "redkitchen")):
        for number, frames in ((1, range(0, 12, 3)), (2, range(1, 12, 6))):
            own = folder / scene / f"seq-{number:02d}"
            own.mkdir(parents=True)
            for i in frames:
                for end in ("depth.png", "pose.txt"):
                    name = f"frame-{i:06d}.{end}"
                    shutil.copyfile(building / room / "seq-01" / name, own / name)
        (folder / scene / "TrainSplit.txt").write_text("sequence1\r\n")
        (folder / scene / "TestSplit.txt").write_text("sequence2\r\n")
        Image.new("RGB", (4, 4)).save(folder / scene / f"{scene}.png")
    return folder


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--db", "0:4"], "Omit --db"),
        (["elsewhere"], "Omit PATH"),
        (["--queries", "0:4"], "Omit --queries"),
        (["--gap-m", "3"], "Omit --gap-m"),
        (["--distractors", "elsewhere"], "Omit --distractors"),
    ],
)
def test_seven_scenes_have_splits_of_their_own(more, message, seven_scenes, capsys):
    assert main(["evaluate", *more, "--7scenes", str(seven_scenes)]) == 2
    assert message in capsys.readouterr().err


def test_seven_scenes_that_are_not_there(tmp_path, capsys):
    assert main(["evaluate", "--7scenes", str(tmp_path)]) == 2
    assert "There is no folder chess, fire, heads" in capsys.readouterr().err
    (tmp_path / "chess").mkdir()
    (tmp_path / "chess" / "seq-01.zip").touch()  # not unpacked yet
    assert main(["evaluate", "--7scenes", str(tmp_path)]) == 2
    assert "chess" in capsys.readouterr().err.splitlines()[-1]
    assert main(["evaluate"]) == 2
    assert "Specify a PATH, or --7scenes DIR" in capsys.readouterr().err


def test_what_cannot_be_written_is_said_before_the_work(
    building, model_file, tmp_path, capsys, monkeypatch
):
    def work(*_):
        raise AssertionError("hours of it")

    monkeypatch.setattr("sceneprint_lab.evaluation.run.evaluate", work)
    (tmp_path / "file").touch()
    asked = [str(building / "room-000"), "--db", "0:4", "--queries", "5:6"]
    asked += ["--model", str(model_file), "--jobs", "1"]
    for option, path in (
        ("--json", tmp_path),
        ("--json", tmp_path / "file" / "figures.json"),
    ):
        assert main(["evaluate", *asked, option, str(path)]) == 2
        (line,) = capsys.readouterr().err.strip().splitlines()
        assert str(tmp_path) in line
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_wrong_options_leave_no_folder(building, model_file, tmp_path):
    asked = [building / "room-000", "--db", "0:4", "--queries", "5:6", "--model", model_file]
    asked += ["--levels", "99", "--json", tmp_path / "a" / "b.json"]
    assert main(["evaluate", *map(str, asked)]) == 2
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["{room}"], "Add --db and --queries"),
        (["{room}", "--db", "0:4"], "--db requires --queries"),
        (["{room}", "--db", "0-4", "--queries", "5:6"], "is not a range of frames"),
        (["{room}", "--db", "0:4", "--queries", "5:99"], "outside the 12 frames"),
        (["{room}", "--db", "0:4", "--queries", "3:6"], "selected twice"),
        (["{room}@db=0:4,queries=5:6", "--db", "0:4", "--queries", "5:6"], "Omit --db and"),
        (["{room}", "--db", "0:4", "--queries", "5:6", "--levels", "9"], "Choose from 1 to"),
        (["{room}", "--db", "0:4", "--queries", "5:6", "--max-overlap", "2"], "--max-overlap"),
        (["{room}", "--db", "0:4", "--queries", "5:6", "--metric", "l3"], "--metric"),
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
