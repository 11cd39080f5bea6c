"""Tests of the recorded sequences: frame counts, consistent poses and speed."""

from pathlib import Path

import numpy as np

from sceneprint.formats.dataset import Layout, find_sequences
from sceneprint.types import DepthFrame


def agreement(a, b):
    """Share of the samples of a that land in b within 5 cm + 3 % of its depth."""
    c, v, u = a.intrinsics, *np.indices(a.depth.shape)[:, ::10, ::10]
    z = a.depth[v, u].astype(np.float64)
    points = np.stack([(u - c.cx) / c.fx * z, (v - c.cy) / c.fy * z, z, np.ones(z.shape)])
    x, y, zb, _ = np.tensordot(np.linalg.inv(b.pose) @ a.pose, points[:, z > 0], axes=1)
    column, row = np.rint(c.fx * x / zb + c.cx), np.rint(c.fy * y / zb + c.cy)
    inside = (zb > 0) & (column >= 0) & (column < c.width) & (row >= 0) & (row < c.height)
    seen = b.depth[row[inside].astype(int), column[inside].astype(int)]
    near = np.abs(seen - zb[inside]) < 0.05 + 0.03 * zb[inside]
    return float(near.sum() / max((seen > 0).sum(), 1))


def test_all_are_found_from_above(data_root):
    found = {s.name: s for s in find_sequences(data_root)}
    kitchen = found["7scenes/redkitchen/seq-01"]
    assert (kitchen.layout, kitchen.parent_frame) == (Layout.SEVEN_SCENES, "redkitchen")
    assert [len(found[f"{name}"].frames) for name in ("sun3d/studyroom2", "tum/fr1_rpy")] == [
        100, 361,
    ]  # fmt: skip
    assert found["tum/fr1_rpy"].layout is Layout.TUM
    assert found["sun3d/studyroom2"].parent_frame == "sun3d/studyroom2"


def test_listing_reads_no_frame_and_no_pose(data_root):
    (sequence,) = find_sequences(data_root / "7scenes/redkitchen/seq-01")
    assert len(sequence.frames) == 1000
    assert all(isinstance(frame.pose_source, Path) for frame in sequence.frames)


def test_poses_and_depth_agree(data_root):
    """Frames a moment apart see the same surfaces where depth, camera and pose are right."""
    for path, i, j in (
        ("7scenes/redkitchen", 100, 110),
        ("sun3d/studyroom2", 10, 30),
        ("tum/fr1_rpy", 100, 103),
    ):
        (sequence,) = find_sequences(data_root / path)
        a, b = sequence.frames[i].read(), sequence.frames[j].read()
        assert agreement(a, b) > 0.85, path
        assert agreement(b, a) > 0.85, path
        # a wrong direction of the transform would be noticed
        turned = [DepthFrame(f.depth, f.intrinsics, f.name, np.linalg.inv(f.pose)) for f in (a, b)]
        assert agreement(*turned) < 0.7, path


def test_depth_is_in_metres(data_root):
    for path, least, most in (("7scenes", 0.4, 6.0), ("sun3d", 0.4, 9.0), ("tum", 0.3, 8.0)):
        (sequence,) = find_sequences(data_root / path)
        frame = sequence.frames[50].read()
        valid = frame.depth[frame.depth > 0]
        assert valid.size > 0.4 * frame.depth.size
        assert np.percentile(valid, 1) > least
        assert np.percentile(valid, 99) < most


def test_nearly_every_frame_of_tum_has_a_pose(data_root):
    (sequence,) = find_sequences(data_root / "tum/fr1_rpy")
    assert sum(frame.pose is None for frame in sequence.frames) <= 5
    for frame in sequence.frames[100:110]:
        rotation = frame.pose[:3, :3]
        np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), atol=1e-14)
