"""Transforms and poses between matrices and JSON."""

from __future__ import annotations

import numpy as np

from sceneprint.datasets import rigid_transform
from sceneprint.errors import InvalidPose, naming
from sceneprint.geometry.quaternions import quaternion_of, rotation_of
from sceneprint.schemas import Quaternion, Transform, Vector
from sceneprint.schemas.frames import GivenTransform
from sceneprint.types import Floats

#: How far from 1 the length of a given quaternion may be.
_TOLERANCE = 1e-2


def transform(T: Floats, parent_frame: str, child_frame: str) -> Transform:
    """T_parent_child (4, 4) as JSON tells it."""
    x, y, z, w = quaternion_of(T[:3, :3]).tolist()
    return Transform(
        parent_frame=parent_frame,
        child_frame=child_frame,
        translation=Vector(x=T[0, 3], y=T[1, 3], z=T[2, 3]),
        rotation=Quaternion(x=x, y=y, z=z, w=w),
        matrix=T.tolist(),
    )


def pose_matrix(pose: GivenTransform, what: str = "") -> Floats:
    """T_parent_sensor (4, 4) of a pose or another transform given either way.

    Parameters
    ----------
    pose : see GivenTransform
    what : to begin an error with, where it is no pose

    Raises
    ------
    InvalidPose : not a rigid transform, or a quaternion that is not of unit length.
    """
    with naming(what):
        return _matrix(pose)


def _matrix(pose: GivenTransform) -> Floats:
    if pose.matrix is not None:
        return rigid_transform(np.array(pose.matrix))
    t, r = pose.translation, pose.rotation
    if t is None or r is None:  # the schema asks for both where there is no matrix
        raise InvalidPose("The pose is not complete. Give translation and rotation, or matrix.")
    q = np.array([r.x, r.y, r.z, r.w])
    length = float(np.linalg.norm(q))
    if not abs(length - 1.0) <= _TOLERANCE:
        raise InvalidPose(
            f"The quaternion of the pose has length {length:.3g}, not 1. Give x, y, z, w of a "
            "unit quaternion."
        )
    T = np.eye(4)
    T[:3, :3] = rotation_of(q / length)
    T[:3, 3] = (t.x, t.y, t.z)
    return rigid_transform(T)
