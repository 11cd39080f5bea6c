"""Tests of the baselines: descriptors, and the command."""

import json

import numpy as np
import pytest

from sceneprint.cli import main
from sceneprint.models import save_model
from sceneprint_lab.evaluation.baselines import (
    vlad,
)


def test_vlad_by_hand():
    words = np.array([[0.0, 0.0], [10.0, 0.0], [0.0, 10.0]])
    local = np.array([[3.0, 0.0], [0.0, 4.0], [10.0, 2.0]], np.float32)
    # the first word is left (3, 4): 0.6, 0.8; the second (0, 2): 0, 1; the third nothing
    expected = np.array([0.6, 0.8, 0.0, 1.0, 0.0, 0.0]) / np.sqrt(2)
    np.testing.assert_allclose(vlad(local, words), expected, atol=1e-7)
    assert not vlad(words.astype(np.float32), words).any()


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    """Twelve views along a path through a synthetic room."""
    out = tmp_path_factory.mktemp("baselines") / "rooms"
    arguments = ["synth", out, "--rooms", 1, "--views", 12, "--seed", 9, "--path", "--jobs", 1]
    assert main([str(a) for a in arguments]) == 0
    return out / "room-000"


@pytest.fixture(scope="module")
def model_file(small_model, tmp_path_factory):
    path = tmp_path_factory.mktemp("model") / "small.safetensors"
    save_model(small_model, path)
    return path


def evaluated(folder, *arguments):
    path = folder / "figures.json"
    assert main(["evaluate", *map(str, arguments), "--jobs", "1", "--json", str(path)]) == 0
    return json.loads(path.read_text(), parse_constant=pytest.fail)


@pytest.mark.thorough
def test_baselines_are_rows_of_the_same_table(room, model_file, tmp_path, capsys):
    asked = (room, "--db", "0:12:2", "--queries", "1:12:4", "--model", model_file)
    found = evaluated(tmp_path, *asked, "--baselines", "rings", "thumbnail_l1")
    assert list(found["baselines"]) == ["thumbnail_l1", "rings"]
    row = found["baselines"]["thumbnail_l1"]
    # neighbours on a path look alike: the thumbnail finds one, and it is registered as ours is
    assert row["recall"] == {"queries": 3, "at_1": 1.0, "at_5": 1.0, "at_10": 1.0}
    assert row["within_10cm_10deg"] == 1.0
    assert set(found["R"]) - {"right_scene"} <= set(row)
    assert row["ratio"] > 0
    assert (
        "does not support frames such as room-000/seq-01/frame-000001"
        in (found["baselines"]["rings"]["reason"])
    )
    out = capsys.readouterr().out
    assert "3 queries with a frame that is their place (overlap by half), recall" in out
    assert "not used: it does not support frames" in out
    again = evaluated(tmp_path, *asked, "--baselines", "thumbnail_l1")
    for key in ("milliseconds", "ratio"):
        again["baselines"]["thumbnail_l1"].pop(key)
        row.pop(key)
    assert again["baselines"]["thumbnail_l1"] == row
