"""Tests of `sceneprint evaluate-pairs` on a small synthetic building."""

import json
import sys

import numpy as np
import pytest

from sceneprint.cli import main
from sceneprint.formats.export import write_ply
from sceneprint.fusion import open3d
from sceneprint.geometry.rigid import pose_difference
from sceneprint.models import save_model
from sceneprint_lab.evaluation.pair_run import BINS, METHODS, points_of, register
from sceneprint_lab.evaluation.protocol import every_frame


@pytest.fixture(scope="module")
def asked(building, small_model, tmp_path_factory):
    model = tmp_path_factory.mktemp("model") / "small.safetensors"
    save_model(small_model, model)
    rooms = [str(building / room) for room in ("room-000", "room-001")]
    few = ["--pairs", "3", "--negatives", "8", "--apart", "2", "--frames", "8"]
    return ["evaluate-pairs", *rooms, "--model", str(model), *few]


def figures(folder, *arguments):
    path = folder / "figures.json"
    assert main([*arguments, "--json", str(path)]) == 0
    return json.loads(path.read_text(), parse_constant=pytest.fail)


@pytest.fixture(scope="module")
def alone(asked, tmp_path_factory):
    folder = tmp_path_factory.mktemp("alone")
    return figures(folder, *asked, "--jobs", "1"), folder


def test_pairs_of_rooms_are_registered_and_others_refused(alone):
    found, _ = alone
    assert found["counts"]["frames"] == {"room-000": 8, "room-001": 8}
    assert found["bins"]["70-100"]["pairs"] > 0
    assert found["bins"]["70-100"]["success"]["right"] == 1.0
    assert found["bins"]["70-100"]["bound"]["right"] == 1.0
    assert found["negatives"]["cross_scene"]["pairs"] == 8
    assert found["negatives"]["cross_scene"]["accepted"] == 0
    assert found["negatives"]["cross_scene"]["upper"] == pytest.approx(1 - 0.05 ** (1 / 8))
    assert set(found["bins"]) == set(BINS)
    assert {"precision", "recall", "accepted"} <= set(found["bins"]["10-30"]["validation"])
    assert found["roc"]["overlap"]["area"] > 0.9
    assert found["settings"]["right"] == [0.1, 10.0]


@pytest.mark.thorough
def test_the_number_of_processes_changes_nothing(alone, asked, tmp_path):
    several = figures(tmp_path, *asked, "--jobs", "2")
    assert several | {"milliseconds": None} == alone[0] | {"milliseconds": None}


@pytest.mark.thorough
def test_clouds_are_registered_as_well(building, asked, tmp_path):
    room = tmp_path / "scans"
    room.mkdir()
    for i, one in enumerate(every_frame([building / "room-001"])[:4]):
        frame = one.reference.read_depth()
        points = points_of(frame, 0.1, 9.0)[::9]
        normals = np.tile([0.0, 0.0, 1.0], (len(points), 1))
        data = write_ply(points, normals, np.zeros((len(points), 3), np.uint8))
        (room / f"{i}.ply").write_bytes(data)
        assert frame.pose is not None
        np.savetxt(room / f"{i}.pose.txt", frame.pose)
    few = ["--pairs", "2", "--apart", "1", "--jobs", "1", "--right", "1e-5", "1"]
    model = ["--model", asked[asked.index("--model") + 1]]
    found = figures(tmp_path, "evaluate-pairs", str(room), *model, *few)
    tried = [one for one in found["bins"].values() if one["pairs"]]
    assert tried
    for one in tried:
        assert one["success"]["within_5cm_5deg"] == one["bound"]["within_5cm_5deg"] == 1.0
        assert one["success"]["right"] == 0.0  # a hundredth of a millimetre


@pytest.mark.usefixtures("with_open3d")
@pytest.mark.thorough
def test_baselines_find_a_cloud_again():
    """Three walls and a box, turned and moved."""
    rng = np.random.default_rng(0)
    sheet = rng.uniform(0, 1, (6, 700, 3)) * [2.0, 1.5, 1.0]
    for i in range(3):
        sheet[i, :, i] = 0.0
        sheet[3 + i] = sheet[i] * 0.3 + [0.9, 0.4, 0.2]
        sheet[3 + i, :, i] = 0.5
    points = sheet.reshape(-1, 3)
    truth = np.eye(4)
    truth[:2, :2] = [[0.8, -0.6], [0.6, 0.8]]
    truth[:3, 3] = 0.5, -1.0, 0.2
    moved = points @ truth[:3, :3].T + truth[:3, 3]
    for scale in (1.0, 5.0):
        apart = truth.copy()
        apart[:3, 3] *= scale
        found = register(scale * points, scale * moved, open3d("A test"), scale=scale)
        assert tuple(found) == METHODS
        for one in found.values():
            metres, radians = pose_difference(one.refined, apart)
            assert metres < 0.01 * scale
            assert radians < 0.01
            assert {"normals", "features", "ICP"} < set(one.stages)
    assert register(points[:5], moved, open3d("A test")) == {}


def test_baselines_without_open3d_are_refused(asked, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "open3d", None)
    assert main([*asked, "--baselines"]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "apt-get install libgl1" in line


def test_what_cannot_be_done_is_one_line(building, asked, capsys, tmp_path):
    room, model = str(building / "room-000"), asked[asked.index("--model") + 1]
    single = tmp_path / "single"
    single.mkdir()
    (single / "intrinsics.json").write_bytes((building / "room-000/intrinsics.json").read_bytes())
    first = every_frame([building / "room-000"])[0].reference
    (single / first.path.name).write_bytes(first.path.read_bytes())
    for arguments, said in (
        ([str(tmp_path / "nowhere")], "does not exist"),
        ([room, room], "Specify each path once"),
        ([room, str(building)], "Specify each path once"),
        ([str(single)], "a pair requires two"),
        ([room, "--apart", "99"], "smaller --apart"),
        ([room, "--json", str(building)], "directory"),
    ):
        assert main(["evaluate-pairs", *arguments, "--model", model, "--jobs", "1"]) == 2
        lines = capsys.readouterr().err.strip().splitlines()
        assert lines[-1].startswith("sceneprint evaluate-pairs: ")
        assert said.lower() in lines[-1].lower()
    for option, value in (("--pairs", "0"), ("--frames", "1"), ("--right", "0"), ("--apart", "x")):
        with pytest.raises(SystemExit) as stopped:
            main(["evaluate-pairs", room, option, value, *(["3"] if option == "--right" else [])])
        assert stopped.value.code == 2
        assert option in capsys.readouterr().err
