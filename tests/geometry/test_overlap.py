"""Tests of the overlap of two surfaces against manual results and the definition."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sceneprint import types
from sceneprint.geometry.registration import overlap as module
from sceneprint.geometry.registration.overlap import (
    OverlapParameters,
    overlap_counts,
    sample_points,
)
from sceneprint.geometry.surface import camera

P = OverlapParameters()


def oracle(source, target, T, p):
    """Inliers and violations, point after point."""
    k, inliers, violations = target.camera, 0, 0
    for row in source.astype(float):
        point, normal = T[:3, :3] @ row[:3] + T[:3, 3], T[:3, :3] @ row[3:]
        if point[2] <= 0.1:
            continue
        u = math.floor(point[0] / point[2] * k.fx + k.cx + 0.5)
        v = math.floor(point[1] / point[2] * k.fy + k.cy + 0.5)
        if not (0 <= u < k.width and 0 <= v < k.height and target.valid[v, u]):
            continue
        seen, facing = target.points[v, u].astype(float), target.normals[v, u].astype(float)
        grow = max(1.0, point[2] ** 2 / p.reference_depth**2)
        off = abs((point - seen) @ facing)
        if (
            off < p.surface_tolerance * grow
            and normal @ facing > p.normal_cosine
            and np.linalg.norm(point - seen) < p.point_tolerance * grow
        ):
            inliers += 1
            continue
        e = p.edge_px
        around = (slice(max(v - e, 0), v + e + 1), slice(max(u - e, 0), u + e + 1))
        nearest = target.points[around][..., 2][target.valid[around]].min()
        margin = p.free_space_margin * grow
        violations += bool(off > margin and point[2] < nearest - margin)
    return inliers, violations


def test_by_hand(validation_goldens):
    validation_goldens.check_cameras(types)
    validation_goldens.check_projecting(camera)
    validation_goldens.check_targets(module)
    validation_goldens.check_agreement(module)
    validation_goldens.check_agreement_of_clouds(module)
    validation_goldens.check_sampling(module)


def test_equals_the_oracle(scenes):
    rng = np.random.default_rng(0)
    corner, _ = scenes.corner()
    corner.points[10:20, 30:50] = corner.normals[10:20, 30:50] = 0.0
    corner.valid[10:20, 30:50] = False
    source = sample_points(corner, 3)
    inliers, violations = 0, 0
    for k in range(40):
        T = np.eye(4)
        T[:3, :3] = Rotation.from_rotvec(rng.normal(0, 0.004 * k, 3)).as_matrix()
        T[:3, 3] = rng.normal(0, 0.01 * k, 3)
        found = overlap_counts(source, corner, T, P)
        assert (found.inliers, found.violations) == oracle(source, corner, T, P)
        assert found.points == len(source)
        inliers, violations = inliers + found.inliers, violations + found.violations
    assert inliers > 0.15 * 40 * len(source)
    assert violations > 0.05 * 40 * len(source)


@pytest.mark.parametrize("stride", [1, 2, 3, 5, 60, 200])
def test_sampling_takes_the_middle_of_each_cell(scenes, stride):
    corner, _ = scenes.corner()
    rows = sample_points(corner, stride)
    assert rows.flags["C_CONTIGUOUS"]
    wanted = corner.points[stride // 2 :: stride, stride // 2 :: stride].reshape(-1, 3)
    np.testing.assert_array_equal(rows[:, :3], wanted)
    assert len(rows) == len(range(stride // 2, 60, stride)) * len(range(stride // 2, 80, stride))


def test_nothing_to_compare(scenes):
    corner, _ = scenes.corner()
    none = overlap_counts(np.empty((0, 6), np.float32), corner, np.eye(4), P)
    assert (none.points, none.inliers, none.violations) == (0, 0, 0)
    source = sample_points(corner, 5)
    corner.points[:] = 0.0
    unseen = overlap_counts(source, corner, np.eye(4), P)
    assert (unseen.points, unseen.inliers, unseen.violations) == (192, 0, 0)
