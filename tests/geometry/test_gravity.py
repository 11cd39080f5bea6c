"""Tests of gravity: tilted poses are rejected, level ones stay, and a wrong `up` is reported."""

import math
from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sceneprint.geometry.registration.alignment import floor_error
from sceneprint.geometry.registration.overlap import OverlapParameters, plane_view
from sceneprint.geometry.registration.patch_descriptors import (
    MatchingParameters,
    SlopeGate,
    correspondences,
)
from sceneprint.geometry.rigid import (
    NO_UPS,
    GravityParameters,
    are_level,
    inverse,
    mean_direction,
    pose_difference,
    slopes,
    tilt_of,
    tilts,
)
from sceneprint.geometry.validation.acceptance import AmbiguityParameters, best_alternative
from sceneprint.geometry.validation.validation import validate, validate_without_up
from sceneprint.models import read_model
from sceneprint.pipeline import geometry_of
from sceneprint.signing import see
from sceneprint.types import DepthFrame
from sceneprint_lab.synth import KINECT, symmetric_box, take
from sceneprint_lab.synth.mesh import box
from tests.geometry.scenes import furnished

Z = np.array([0.0, 0.0, 1.0])  #: up in the world of synthetic rooms
P = GravityParameters()


def up_in(T):
    """Up in a sensor of pose T."""
    return T[:3, :3].T @ Z


def leaning(up, degrees, rng):
    """A direction that far off, any way."""
    aside = np.cross(up, rng.normal(size=3))
    aside /= np.linalg.norm(aside)
    return math.cos(math.radians(degrees)) * up + math.sin(math.radians(degrees)) * aside


@pytest.fixture(scope="module")
def model():
    return read_model("depth")


@pytest.fixture(scope="module")
def rooms(model):
    """Four views of each of two furnished rooms, a fifth of the path apart."""
    return [furnished(model, number) for number in (0, 2)]


@cache
def without_ups(query, match):
    """The validation where no up is known, computed once."""
    return validate(query, match, 1)


def test_tilts_by_hand():
    turns = np.tile(np.eye(4), (4, 1, 1))
    for i, (axis, degrees) in enumerate((("z", 70), ("x", 90), ("y", -20), ("x", 180))):
        turns[i, :3, :3] = Rotation.from_euler(axis, degrees, degrees=True).as_matrix()
    result = np.degrees(tilts(turns, (Z, Z)))
    np.testing.assert_allclose(result, [0, 90, 20, 180], atol=1e-9)
    assert are_level(turns, (Z, Z), math.radians(21)).tolist() == [True, False, True, False]
    for unknown in (NO_UPS, (Z, None), (None, Z)):
        assert are_level(turns, unknown, 0.0).all()
        assert tilt_of(turns[1], unknown) is None
    assert tilt_of(turns[1], (Z, Z)) == pytest.approx(math.pi / 2)
    assert tilt_of(None, (Z, Z)) is None


def test_correspondences_stand_at_one_angle_to_up():
    rng = np.random.default_rng(4)
    source, target = (rng.integers(0, 256, (n, 16), np.uint8) for n in (30, 40))
    normals = [Rotation.random(n, rng=rng).as_matrix()[:, 0] for n in (30, 40)]
    angles = [slopes(normal, Z) for normal in normals]
    np.testing.assert_allclose(angles[0], np.arccos(normals[0][:, 2]))
    p = MatchingParameters(30, 3)
    free = correspondences(source, target, np.random.default_rng(0), p)
    wide = SlopeGate(angles[0], angles[1], math.pi)
    assert (correspondences(source, target, np.random.default_rng(0), p, wide) == free).all()
    gate = SlopeGate(angles[0], angles[1], P.gate)
    pairs = correspondences(source, target, np.random.default_rng(0), p, gate)
    assert len(pairs) <= 90
    assert (np.abs(angles[0][pairs[:, 0]] - angles[1][pairs[:, 1]]) <= P.gate).all()
    for patch in range(30):  # the nearest of those that may correspond, by hand
        may = np.flatnonzero(np.abs(angles[0][patch] - angles[1]) <= P.gate)
        squares = ((source[patch].astype(int) - target[may].astype(int)) ** 2).sum(axis=1)
        nearest = may[np.argsort(squares, kind="stable")[:3]]
        assert pairs[pairs[:, 0] == patch, 1].tolist() == nearest.tolist()
    none = SlopeGate(np.zeros(30), np.full(40, 1.0), P.gate)
    assert correspondences(source, target, np.random.default_rng(0), p, none).shape == (0, 2)


def test_an_exact_up_and_one_with_noise_lose_nothing(rooms):
    rng = np.random.default_rng(5)
    accepted = 0
    for views in rooms:
        for (T_query, query), (T_match, match) in pairwise(views):
            before = without_ups(query, match)
            true = inverse(T_match) @ T_query
            accepted += before.status == "accepted"
            for noise in (0.0, 0.5):
                ups = tuple(leaning(up_in(T), noise, rng) for T in (T_query, T_match))
                result = validate(query, match, 1, ups=(ups[0], ups[1]))
                if before.status == "accepted":
                    assert result.status == "accepted"
                    metres, radians = pose_difference(result.T_match_query, true)
                    assert metres < 0.05
                    assert radians < math.radians(2)
                    assert result.tilt_rad == pytest.approx(0.0, abs=math.radians(1 + 2 * noise))
                assert result.contradicts_up is False
    assert accepted >= 6


def test_one_up_alone_changes_nothing_for_depth_images(rooms):
    (T, query), (_, match) = rooms[0][:2]
    before, after = without_ups(query, match), validate(query, match, 1, ups=(up_in(T), None))
    assert (before.status, before.overlap, before.reason) == (
        after.status, after.overlap, after.reason,
    )  # fmt: skip
    assert (after.T_match_query == before.T_match_query).all()
    assert after.tilt_rad is None


@pytest.mark.parametrize("degrees", [20, 90])
def test_a_wrong_up_gives_a_sentence_and_no_pose(rooms, degrees):
    rng, said = np.random.default_rng(6), 0
    for views in rooms if degrees == 20 else rooms[:1]:
        for (T_query, query), (T_match, match) in pairwise(views):
            ups = leaning(up_in(T_query), degrees, rng), up_in(T_match)
            result = validate(query, match, 1, ups=ups)
            assert result.status != "accepted"
            before = without_ups(query, match)
            checked = validate_without_up(query, match, 1, None, ups)
            if before.strength != "strong":
                assert checked is None
                continue
            assert (checked.status, checked.strength, checked.covariance) == (
                "rejected", None, None,
            )  # fmt: skip
            assert checked.contradicts_up
            assert checked.tilt_rad == pytest.approx(math.radians(degrees), abs=math.radians(2))
            assert f"only if tilted by {math.degrees(checked.tilt_rad):.0f} deg" in checked.reason
            said += 1
    assert said >= (5 if degrees == 20 else 2)


def test_without_up_what_is_level_counts_as_ever(rooms):
    (T_query, query), (T_match, match) = rooms[0][:2]
    before = without_ups(query, match)
    assert before.strength == "strong"
    checked = validate_without_up(query, match, 1, None, (up_in(T_query), up_in(T_match)))
    assert (checked.status, checked.strength) == ("accepted", "strong")
    assert (checked.T_match_query == before.T_match_query).all()
    blind = validate_without_up(query, match, 1, None, (up_in(T_query), None))
    assert (blind.status, blind.tilt_rad) == ("accepted", None)


def test_a_frame_sees_that_its_own_up_is_wrong(rooms):
    rng = np.random.default_rng(7)
    for views in rooms:
        T, seen = views[0]
        assert floor_error(seen, up_in(T), P) < math.radians(1.5)
        off = floor_error(seen, leaning(up_in(T), 20, rng), P)
        assert off == pytest.approx(math.radians(20), abs=math.radians(1.5))


def test_a_rival_that_tilts_is_dropped(model):
    # a chest as deep as it is high, that lies free: laid on its back it looks nearly the same
    deep, wide, high = 0.6, 0.9, 0.6
    scene = replace(symmetric_box(), mesh=box(deep, wide, high))
    T = np.eye(4)
    T[:3, 3] = (0.9, -0.9, 1.1)
    T[:3, 2] = np.array([0.0, 0.0, high / 2]) - T[:3, 3]
    T[:3, 0] = np.cross(-Z, T[:3, 2])
    T[:3, 1] = np.cross(T[:3, 2], T[:3, 0])
    T[:3, :3] /= np.linalg.norm(T[:3, :3], axis=0)
    frames = [
        DepthFrame(take(scene, T, KINECT, np.random.default_rng(seed)), KINECT) for seed in (0, 1)
    ]
    query, match = (geometry_of(see(frame, model.parameters), model) for frame in frames)
    ups = up_in(T), up_in(T)
    without, level = validate(query, match), validate(query, match, ups=ups)
    assert math.degrees(tilts(without.T_rival[None], ups)[0]) == pytest.approx(90, abs=2)
    assert tilts(level.T_rival[None], ups)[0] < P.rival_tilt
    assert (without.ambiguity, level.ambiguity) == (
        pytest.approx(0.82, abs=0.08), pytest.approx(0.53, abs=0.08),
    )  # fmt: skip
    assert level.ambiguity < without.ambiguity - 0.2
    view = [plane_view(frame, AmbiguityParameters().planes) for frame in (query, match)]
    none = np.empty((0, 4, 4))
    result = best_alternative(
        view[0], view[1], np.eye(4), 0.0, without.T_rival[None], none, AmbiguityParameters(),
        OverlapParameters(), ups, P.rival_tilt,
    )  # fmt: skip
    assert result.tilted >= without.ambiguity - 0.01  # told apart, so that a wrong `up` is noticed


def test_the_mean_of_directions_is_that_of_the_many():
    rng, within = np.random.default_rng(8), math.radians(10)
    near = np.array([leaning(Z, 2, rng) for _ in range(5)])
    far = np.array([leaning(Z, 60, rng) for _ in range(3)])
    result = mean_direction(np.concatenate([far, near]), within)
    assert np.linalg.norm(result) == pytest.approx(1)
    assert math.degrees(math.acos(result @ Z)) < 2
    assert mean_direction(np.array([Z, [1.0, 0, 0]]), within) is None  # one against one
    alone = mean_direction(Z[None], within)
    assert alone.tolist() == Z.tolist()
    assert mean_direction(np.empty((0, 3)), within) is None
