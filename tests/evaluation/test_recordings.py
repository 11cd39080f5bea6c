"""Tests of the accuracy of a reduced, deterministic evaluation of recordings."""

import json

import pytest

from sceneprint.cli import main


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
    found = json.loads(path.read_text())
    assert found["counts"] == {"queries": 20, "database": 59, "left_out": 0}
    assert found["R"]["right_scene"] >= 0.95
    assert found["VDR"]["within_10cm_10deg"] >= 0.95
    assert found["pose_average"]["within_10cm_10deg"] >= 0.95
    bound = found["bound"]["VDR"]["within_5cm_5deg"]
    assert found["VDR"]["within_5cm_5deg"] >= bound - 0.05
    assert found["validation"]["precision"] >= 0.97
    assert found["validation"]["accepted_strong_of_other_scenes"] == 0
    translation = found["diversity"]["translation"]
    assert translation["VDR"]["std_m"] > translation["VR"]["std_m"]
    assert translation["DR"]["std_m"] > translation["R"]["std_m"]
    assert found["diversity"]["coverage"]["ratio_of_means"] > 1.05
