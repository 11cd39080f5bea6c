"""Tests of quaternions against SciPy, including degenerate cases."""

import itertools

import numpy as np
from scipy.spatial.transform import Rotation

from sceneprint_client.poses import quaternion_of, rotation_of

AXES = [np.array(a, float) for a in itertools.product((-1, 0, 1), repeat=3) if any(a)]


def rotations():
    """Random ones, and turns by and near 0, 90, 120 and 180 degrees about every simple axis."""
    result = list(Rotation.random(300, random_state=1).as_matrix())
    for axis in AXES:
        for degrees in (0, 1e-9, 1e-6, 90, 120, 179.999, 180 - 1e-9, 180, 180 + 1e-9, 270):
            turn = np.radians(degrees) * axis / np.linalg.norm(axis)
            result.append(Rotation.from_rotvec(turn).as_matrix())
    return result


def test_both_ways_agree_with_scipy():
    for R in rotations():
        theirs = Rotation.from_matrix(R).as_quat()
        ours = quaternion_of(R)
        assert ours[3] >= 0
        # the sign is free where w vanishes
        assert min(np.abs(ours - theirs).max(), np.abs(ours + theirs).max()) < 1e-12
        np.testing.assert_allclose(
            rotation_of(theirs), Rotation.from_quat(theirs).as_matrix(), rtol=0, atol=1e-13
        )
