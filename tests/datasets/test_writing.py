"""Tests that written data can be read, and that files are complete or absent."""

import os

import numpy as np
import pytest
from PIL import Image

from sceneprint.formats.dataset import (
    decode_png,
    read_trajectory,
    trajectory_row,
    trajectory_text,
    write_depth_png,
    write_pose,
)
from sceneprint_client.poses import rotation_of


def test_depth_by_hand(tmp_path):
    depth = np.array(
        [[0, 1, 0.0004, 0.0006], [65.534, 65.5346, 66, 1e30], [np.nan, np.inf, -1, 2.5]], np.float32
    )
    write_depth_png(tmp_path / "a.png", depth, 1000.0)
    expected = [[0, 1000, 0, 1], [65534, 0, 0, 0], [0, 0, 0, 2500]]
    assert decode_png((tmp_path / "a.png").read_bytes()).tolist() == expected
    with Image.open(tmp_path / "a.png") as image:  # and by others
        assert np.asarray(image).tolist() == expected
    write_depth_png(tmp_path / "a.png", depth, 5000.0)
    assert decode_png((tmp_path / "a.png").read_bytes())[2, 3] == 12500


def test_a_killed_writer_leaves_the_old_file(tmp_path, monkeypatch):
    write_pose(tmp_path / "a.txt", np.eye(4))
    before = (tmp_path / "a.txt").read_bytes()

    def killed(*args):
        raise KeyboardInterrupt

    moved = np.eye(4)
    moved[0, 3] = 1.0
    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", killed)
        with pytest.raises(KeyboardInterrupt):
            write_pose(tmp_path / "a.txt", moved)
        with pytest.raises(KeyboardInterrupt):
            write_depth_png(tmp_path / "b.png", np.ones((2, 2), np.float32), 1000.0)
    assert (tmp_path / "a.txt").read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == ["a.txt"]
    write_pose(tmp_path / "a.txt", moved)
    assert (tmp_path / "a.txt").read_text().split()[3] == "1"


def test_a_trajectory_is_read_again_without_loss(tmp_path):
    rng = np.random.default_rng(8)
    poses = []
    for i in range(20):
        T = np.eye(4)
        T[:3, :3] = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        T[:3, 0] *= np.sign(np.linalg.det(T[:3, :3]))
        T[:3, 3] = rng.normal(size=3) * 10.0 ** rng.integers(-6, 6)
        poses.append((1763285400.123456 + i / 30, T))
    text = trajectory_text([trajectory_row(*pose) for pose in poses], ["room 1\nq 2 3", "Küche"])
    assert text.startswith("# room 1\\nq 2 3\n# K\\xfcche\n1763285400.123456 ")
    (tmp_path / "a.tum").write_text(text)
    read = read_trajectory(tmp_path / "a.tum")
    assert read.stamps.tolist() == [stamp for stamp, _ in poses]
    assert read.positions.tolist() == [T[:3, 3].tolist() for _, T in poses]
    for q, (_, T) in zip(read.quaternions, poses, strict=True):
        np.testing.assert_allclose(rotation_of(q), T[:3, :3], atol=1e-14)
