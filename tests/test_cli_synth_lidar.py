"""`sceneprint synth --sensor lidar`: what is written can be read back as it was made."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sceneprint.cli import main
from sceneprint.formats.dataset import find_sequences
from sceneprint.lab.synth import synthesise_survey
from sceneprint.types import Cloud


def test_sites_are_written_as_clouds_with_poses(tmp_path: Path) -> None:
    out = tmp_path / "sites"
    arguments = ["--rooms", "1", "--views", "2", "--seed", "5", "--jobs", "1"]
    assert main(["synth", str(out), "--sensor", "lidar", *arguments]) == 0
    made = synthesise_survey(5, 0, 2)
    (sequence,) = find_sequences(out)
    read = [reference.read() for reference in sequence.frames]
    assert [path.name for path in sorted((out / "site-000").glob("*.ply"))] == [
        "scan-000000.ply",
        "scan-000001.ply",
    ]
    for cloud, one in zip(read, made.clouds, strict=True):
        assert isinstance(cloud, Cloud)
        np.testing.assert_array_equal(cloud.points, one.points)
        assert cloud.pose is not None
        assert one.pose is not None
        np.testing.assert_allclose(cloud.pose, one.pose, atol=1e-6)
