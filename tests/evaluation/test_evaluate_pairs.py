"""Tests of `sceneprint evaluate-pairs` on a small synthetic building."""

import json
import sys

import pytest

from sceneprint.cli import main
from sceneprint.models import save_model
from sceneprint_lab.evaluation.pair_run import BINS
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
