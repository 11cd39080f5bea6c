"""Tests of the validation of clouds with and without a viewpoint, and of depth images."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sceneprint.formats.artifact import read_geometry, write_geometry
from sceneprint.geometry.rigid import inverse, pose_difference, transform_points
from sceneprint.geometry.validation.acceptance import (
    AcceptanceParameters,
    Evidence,
    belief,
    objection,
)
from sceneprint.geometry.validation.validation import ValidationParameters, validate
from sceneprint.models import read_model
from sceneprint.pipeline import geometry_of
from sceneprint.signing import see
from sceneprint.types import Cloud, DepthFrame, Floats, Floats32, Geometry, Sphere
from sceneprint_lab.synth import KINECT, take
from sceneprint_lab.synth.dataset import room_and_rng
from sceneprint_lab.synth.trajectories import pose as looking


@dataclass(frozen=True, eq=False)
class View:
    """A scan: T_room_sensor, its points, and its artifact as it is read back."""

    T: Floats
    points: Floats32
    scan: Geometry


@pytest.fixture(scope="module")
def model():
    return read_model("paper")


@pytest.fixture(scope="module")
def frame_of(model):
    def make(frame):
        return read_geometry(write_geometry(geometry_of(see(frame, model.parameters), model)))

    return make


def pose(x, y, yaw):
    """A sensor upright in a room, 1.2 m over its floor."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("z", yaw, degrees=True).as_matrix()
    T[:3, 3] = x, y, 1.2
    return T


def scanned(room, T, rng):
    """120 rings of 480 beams, from 45 degrees below to 45 above, good to a centimetre."""
    azimuth = np.linspace(-math.pi, math.pi, 480, endpoint=False)
    elevation = np.radians(np.linspace(-45, 45, 120))[:, None]
    flat = np.cos(elevation)
    rays = np.stack(
        [flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation) + 0 * azimuth], axis=-1
    ).reshape(-1, 3)
    there = (rays @ T[:3, :3].T).astype(np.float32)
    hits = room.caster.cast(np.broadcast_to(T[:3, 3], there.shape).astype(np.float32), there)
    met = hits.face >= 0
    ranges = hits.distance[met] + rng.normal(0, 0.01, int(met.sum()))
    return (rays[met] * ranges[:, None]).astype(np.float32)


@pytest.fixture(scope="module")
def rooms(frame_of):
    """Two furnished rooms, scanned twice each, half a metre and 100 degrees apart."""
    results = []
    for number in (2, 5):
        room, rng = room_and_rng(11, number)
        middle = room.outline.mean(axis=0)
        views = []
        for T in (pose(*middle, 20.0), pose(middle[0] + 0.4, middle[1] - 0.3, 120.0)):
            points = scanned(room, T, rng)
            views.append(View(T, points, frame_of(Cloud(points))))
        results.append((room, views))
    return results


@pytest.fixture(scope="module")
def fused(rooms, frame_of):
    """The same points in the room's coordinates, of nobody's view."""
    return [
        [
            frame_of(Cloud(transform_points(v.T, v.points).astype(np.float32), has_viewpoint=False))
            for v in views
        ]
        for _, views in rooms
    ]


def off(v, T):
    """Metres and degrees from a transform."""
    assert v.T_match_query is not None, v.reason
    metres, radians = pose_difference(v.T_match_query, T)
    return metres, math.degrees(radians)


def test_two_scans_of_a_room(rooms):
    for _, (query, match) in rooms:
        assert isinstance(query.scan.surface.camera, Sphere)
        v = validate(query.scan, match.scan)
        metres, degrees = off(v, inverse(match.T) @ query.T)
        assert metres < 0.01
        assert degrees < 0.2
        assert (v.status, v.strength) == ("accepted", "strong")
        assert v.overlap > 0.4
        assert v.violations is not None
        assert v.violations < 0.01
        assert v.around
        assert v.covariance is not None
        assert np.linalg.eigvalsh(v.covariance)[0] > 0


def test_other_rooms_and_mirror_images_are_rejected(rooms, frame_of):
    for query, match in product(rooms[0][1], rooms[1][1]):
        assert validate(query.scan, match.scan).status != "accepted"
    _, (query, match) = rooms[0]
    mirrored = frame_of(Cloud(query.points * np.array([1, -1, 1], np.float32)))
    for frame in (query, match):
        assert validate(mirrored, frame.scan).status != "accepted"


def test_a_depth_image_beside_the_cloud_of_the_same_view(rooms, frame_of):
    room, (first, _) = rooms[0]
    T = looking(np.array([first.T[0, 3], first.T[1, 3], 1.4, 0.4, -0.3, 0.0]))
    depth = take(room, T, KINECT, np.random.default_rng(1))
    y, x = np.nonzero((depth > 0.4) & (depth < 6))
    z = depth[y, x].astype(float)
    points = np.stack([(x - KINECT.cx) / KINECT.fx * z, (y - KINECT.cy) / KINECT.fy * z, z], axis=1)
    image, cloud = frame_of(DepthFrame(depth, KINECT)), frame_of(Cloud(points.astype(np.float32)))
    assert isinstance(cloud.surface.camera, Sphere)
    for v in (validate(image, cloud), validate(cloud, image), validate(cloud, cloud)):
        assert not v.around  # a cloud may see no more than a camera does
        metres, degrees = off(v, np.eye(4))
        assert metres < 0.02
        assert degrees < 0.5
        assert (v.status, v.strength) == ("accepted", "strong")
        assert v.overlap > 0.6


def test_where_there_is_no_viewpoint_a_match_is_weak(rooms, fused):
    for query, match in fused:
        assert query.surface.camera is None
        v = validate(query, match)
        metres, degrees = off(v, np.eye(4))
        assert metres < 0.02
        assert degrees < 0.3
        assert (v.status, v.strength) == ("accepted", "weak")
        assert v.violations is None
        assert "free space" in v.reason
    v = validate(*fused[0], mode="paper")
    assert (v.status, v.strength, v.violations) == ("accepted", "weak", None)
    for query, match in product(fused[0], fused[1]):
        v = validate(query, match)
        assert (v.status, v.violations) == ("rejected", None)
    # of one with a viewpoint and one without, free space is known in one direction
    for (_, views), clouds in zip(rooms, fused, strict=True):
        for v, T in (
            (validate(views[0].scan, clouds[1]), views[0].T),
            (validate(clouds[1], views[0].scan), inverse(views[0].T)),
        ):
            metres, degrees = off(v, T)
            assert metres < 0.02
            assert degrees < 0.3
            assert (v.status, v.strength) == ("accepted", "weak")
            assert "one frame" in v.reason
            assert not v.around
            assert v.violations is not None
            assert v.violations < 0.02
    one_sided = validate(rooms[0][1][0].scan, fused[0][1], mode="paper")
    assert (one_sided.status, one_sided.strength) == ("accepted", "weak")


def test_without_evidence_of_free_space_more_must_agree():
    p = AcceptanceParameters(
        evidence=0.2, plane_overlap=0.15, strong=0.3, weak=0.05, ambiguous=0.14,
        ambiguous_share=0.5, blind_evidence=0.4, blind_plane_overlap=0.3,
        blind_ambiguous_share=0.75,
    )  # fmt: skip
    seen = Evidence(0.01, 0.01, overlap=0.5, plane_overlap=0.4, violations=0.0, stiffness=1.0)
    blind = replace(seen, violations=None)
    assert objection(seen, p, "full") is objection(blind, p, "full") is None
    for name, enough, too_little in (("overlap", 0.41, 0.39), ("plane_overlap", 0.31, 0.29)):
        assert objection(replace(blind, **{name: enough}), p, "full") is None
        against = objection(replace(blind, **{name: too_little}), p, "full")
        assert against[0] == "rejected"
        assert objection(replace(seen, **{name: too_little}), p, "full") is None
    assert belief(seen, 0.0, p)[:2] == ("accepted", "strong")
    for ambiguity in (0.0, 0.1, 0.29):  # three quarters of what agrees are 0.3
        status, strength, reason = belief(blind, ambiguity, p)
        assert (status, strength) == ("accepted", "weak")
        assert "free space" in reason
    assert belief(blind, 0.31, p)[:2] == ("ambiguous", None)
    assert belief(seen, 0.15, p)[:2] == ("ambiguous", None)
    one_sided = replace(seen, one_sided=True)
    assert objection(one_sided, p, "full") is None
    assert belief(one_sided, 0.0, p)[:2] == ("accepted", "weak")
    assert belief(one_sided, 0.15, p)[:2] == ("ambiguous", None)
    assert ValidationParameters().acceptance == AcceptanceParameters()
