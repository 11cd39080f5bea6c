"""Tests of valid and invalid requests, and of the conversion of poses."""

import json
import math

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from sceneprint.engine.ingest.frame_decoder import pose_matrix
from sceneprint.engine.serializers import transform
from sceneprint.errors import InvalidPose
from sceneprint_client.api import FrameMeta, GivenPose, NewMap, Query

CAMERA = {"width": 4, "height": 3, "fx": 2, "fy": 2, "cx": 2, "cy": 1}
EYE = np.eye(4).tolist()
ORIGIN = {"x": 0, "y": 0, "z": 0}
LEVEL = {"x": 0, "y": 0, "z": 0, "w": 1}


def meta(**more):
    return {"intrinsics": CAMERA} | more


REFUSED = [
    (Query, {"K": 5}, "K"),
    (Query, {"k": 0}, "k"),
    (Query, {"k": 51}, "k"),
    (Query, {"seed": 2**32}, "seed"),
    (Query, {"stages": ["validate"]}, "stages"),
    (Query, {"stages": ["retrieve", "retrieve"]}, "stages"),
    (Query, {"stages": ["retrieve", "rank"]}, "stages.1"),
    (NewMap, {"name": "Hall"}, "name"),
    (NewMap, {"name": "../hall"}, "name"),
    (NewMap, {"name": "hall", "model": "large"}, "model"),
    (NewMap, {"name": "hall", "frames": 3}, "frames"),
    (FrameMeta, {"viewpoint": {"x": 0, "y": 0}}, "viewpoint.GivenVector.z"),
    (FrameMeta, {"units_per_metre": 0}, "units_per_metre"),
    (FrameMeta, meta(colour="red"), "colour"),
    (FrameMeta, meta(intrinsics=CAMERA | {"fx": math.nan}), "intrinsics.fx"),
    (FrameMeta, meta(intrinsics=CAMERA | {"width": 0}), "intrinsics.width"),
    (FrameMeta, meta(intrinsics=CAMERA | {"distortion": [math.nan]}), "intrinsics.distortion.0"),
    (FrameMeta, meta(intrinsics=CAMERA | {"distortion": [0] * 9}), "intrinsics.distortion"),
    (FrameMeta, meta(depth_scale=0), "depth_scale"),
    (FrameMeta, meta(robot="r\0"), "robot"),
    (FrameMeta, meta(session="s" * 129), "session"),
    (FrameMeta, meta(tags=["a"] * 33), "tags"),
    (FrameMeta, meta(tags=["a", ""]), "tags.1"),
    (FrameMeta, meta(captured_at="2026-01-01T00:00:00"), "captured_at"),
    (FrameMeta, meta(captured_at="9999-12-31T23:59:59-12:00"), "captured_at"),
    (FrameMeta, meta(pose={"matrix": EYE}), ""),  # in which frame?
    (GivenPose, {}, ""),
    (GivenPose, {"translation": ORIGIN}, ""),
    (GivenPose, {"translation": ORIGIN, "rotation": LEVEL, "matrix": EYE}, ""),
    (GivenPose, {"matrix": EYE[:3]}, "matrix"),
    (GivenPose, {"matrix": [[math.nan, 0, 0, 0], *EYE[1:]]}, "matrix.0.0"),
    (GivenPose, {"translation": ORIGIN | {"x": math.inf}, "rotation": LEVEL}, "translation.x"),
    (GivenPose, {"translation": ORIGIN, "rotation": ORIGIN}, "rotation.w"),
]


@pytest.mark.parametrize(("kind", "given", "place"), REFUSED)
def test_what_would_mean_nothing_is_refused_at_its_place(kind, given, place):
    with pytest.raises(ValidationError) as caught:
        kind.model_validate(given)
    assert place in [".".join(map(str, e["loc"])) for e in caught.value.errors()]
    with pytest.raises(ValidationError):
        kind.model_validate_json(json.dumps(given))


@pytest.mark.parametrize("seed", range(2))
def test_both_ways_of_a_pose_are_one(seed):
    rotation, t = Rotation.random(random_state=seed), [1.5, -2.25, 1e3]
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation.as_matrix(), t
    x, y, z, w = (rotation.as_quat() * 1.005).tolist()  # as rounded somewhere
    parts = {
        "translation": {"x": t[0], "y": t[1], "z": t[2]},
        "rotation": {"x": x, "y": y, "z": z, "w": w},
    }
    by_parts = pose_matrix(GivenPose.model_validate(parts))
    by_matrix = pose_matrix(GivenPose(matrix=T.tolist()))
    np.testing.assert_allclose(by_parts, T, rtol=0, atol=1e-14)
    np.testing.assert_allclose(by_matrix, T, rtol=0, atol=1e-14)
    told = transform(by_parts, "map", "camera")
    assert (told.parent_frame, told.child_frame) == ("map", "camera")
    assert told.matrix == by_parts.tolist()
    assert list(told.translation.model_dump().values()) == t
    quaternion = np.array([told.rotation.x, told.rotation.y, told.rotation.z, told.rotation.w])
    theirs = rotation.as_quat()
    np.testing.assert_allclose(quaternion, theirs * np.sign(theirs[3]), rtol=0, atol=1e-14)


@pytest.mark.parametrize("length", [0.0, 0.5, 0.98, 1.02, 2.0, 1e200])
def test_a_quaternion_that_is_not_of_unit_length_is_no_rotation(length):
    q = {"x": 0.0, "y": 0.6 * length, "z": 0.0, "w": 0.8 * length}
    with np.errstate(over="ignore"), pytest.raises(InvalidPose, match=r"quaternion .* has length"):
        pose_matrix(GivenPose.model_validate({"translation": ORIGIN, "rotation": q}))


def test_what_is_no_rigid_transform_is_no_pose():
    for bad in (np.diag([1.0, 1, -1, 1]), np.diag([2.0, 2, 2, 1]), np.zeros((4, 4))):
        with pytest.raises(InvalidPose):
            pose_matrix(GivenPose(matrix=bad.tolist()))
