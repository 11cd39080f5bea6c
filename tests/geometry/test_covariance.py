"""Tests of covariances: transport, definition, free directions and magnitude."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sceneprint.geometry.registration.icp import (
    CovarianceParameters,
    Refinement,
    free_directions,
    fuse_votes,
    pair_covariance,
    pose_error,
    transform_covariance,
)
from sceneprint.geometry.rigid import average_poses, inverse
from tests.geometry.scenes import rigid


def with_error(T, error):
    """The transform that is off by (x, y, z, rx, ry, rz), from the definition."""
    result = T.copy()
    result[:3, :3] = Rotation.from_rotvec(error[3:]).as_matrix() @ T[:3, :3]
    result[:3, 3] += error[:3]
    return result


def some_covariance(rng, scale=1.0):
    root = rng.normal(size=(6, 6)) * scale
    return root @ root.T


def test_an_error_is_what_was_put_there():
    rng = np.random.default_rng(1)
    T = rigid(rng, 1)
    for size in (0.0, 1e-12, 1e-6, 1e-2, 1.0):
        error = size * rng.normal(size=6)
        np.testing.assert_allclose(
            pose_error(T, with_error(T, error)), error, rtol=1e-6, atol=1e-15
        )


def test_transport_against_monte_carlo():
    rng = np.random.default_rng(2)
    T, before, after = rigid(rng, 1), rigid(rng, 1), rigid(rng, 1)
    S = some_covariance(rng, 2e-3)
    errors = rng.multivariate_normal(np.zeros(6), S, 8_000)
    cases = (
        (lambda A: before @ A, transform_covariance(S, before[:3, :3], np.zeros(3))),
        (lambda A: A @ after, transform_covariance(S, np.eye(3), T[:3, :3] @ after[:3, 3])),
        (inverse, transform_covariance(S, T[:3, :3].T, inverse(T)[:3, 3])),
    )
    some = [with_error(T, error) for error in errors]
    for pose_of, expected in cases:
        there = pose_of(T)
        result = np.cov(np.array([pose_error(there, pose_of(one)) for one in some]).T)
        scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
        np.testing.assert_allclose(result / scale, expected / scale, atol=0.06)


def left_twist(T, true):
    """(turn, shift) with true = [exp(turn), shift] T, as refinement has it."""
    D = true @ np.linalg.inv(T)
    return np.concatenate([Rotation.from_matrix(D[:3, :3]).as_rotvec(), D[:3, 3]])


@pytest.mark.parametrize("lost", [None, 0, 1])
def test_a_pairs_covariance_from_the_definition(lost):
    rng = np.random.default_rng(4)
    T, p = rigid(rng, 1), CovarianceParameters()
    refined = [Refinement(T, some_covariance(rng) + np.eye(6), 500, s) for s in (3e-5, 1e-5)]
    information, noise = np.zeros((6, 6)), []
    step = 1e-6
    for i, (one, pose_of) in enumerate(zip(refined, (lambda A: A, np.linalg.inv), strict=True)):
        if i == lost:
            continue
        J = np.array(
            [
                (left_twist(pose_of(T), pose_of(with_error(T, e)))
                 - left_twist(pose_of(T), pose_of(with_error(T, -e)))) / (2 * step)
                for e in step * np.eye(6)
            ]
        ).T  # fmt: skip
        information += J.T @ one.information @ J
        noise.append(one.mean_square)
    expected = np.linalg.inv(information / len(noise)) * np.mean(noise) / p.independent
    there, back = (None if i == lost else one for i, one in enumerate(refined))
    result = pair_covariance(there, back, T)
    np.testing.assert_allclose(result, expected, rtol=1e-5, atol=1e-12)
    assert (result == result.T).all()
    # a radian may count as any number of metres: that only says what is free
    other = pair_covariance(there, back, T, replace(p, lever=3.0))
    np.testing.assert_allclose(other, expected, rtol=1e-5, atol=1e-12)


def test_no_refinement_no_covariance():
    assert pair_covariance(None, None, np.eye(4)) is None


def test_free_directions_by_hand():
    S = np.diag([1.0, 4.0, 899.0, 1.0, 1.0, 1.0]) * 1e-4
    assert free_directions(S) == ()  # not quite 30 times the least
    (one,) = free_directions(np.diag([1.0, 4.0, 901.0, 1.0, 1.0, 1.0]) * 1e-4)
    assert (one.translation.tolist(), one.rotation.tolist()) == ([0, 0, 1], [0, 0, 0])
    assert one.deviation == pytest.approx(0.01 * np.sqrt(901))
    first, second = free_directions(np.diag([1.0, 1.0, 2000.0, 1.0, 1.0, 3000.0]) * 1e-6)
    assert (first.rotation.tolist(), second.translation.tolist()) == ([0, 0, 1], [0, 0, 1])
    assert first.deviation == pytest.approx(np.sqrt(3e-3))


def test_what_a_radian_counts_says_what_is_free_and_not_how_far():
    S = np.diag([1.0, 1.0, 1.0, 1.0, 1.0, 300.0]) * 1e-6
    assert free_directions(S) == ()
    (one,) = free_directions(S, replace(CovarianceParameters(), lever=2.0))
    assert (one.translation.tolist(), one.rotation.tolist()) == ([0, 0, 0], [0, 0, 1])
    assert one.deviation == pytest.approx(np.sqrt(3e-4))


def test_a_place_from_its_votes():
    poses = np.repeat(np.eye(4)[None], 4, axis=0)
    poses[:, 0, 3] = (0.01, 0.02, 0.03, 5.0)  # the last is elsewhere
    covariances = np.array([np.diag([s] * 6) for s in (4e-4, 4e-4, 4e-4, 7.0)])
    average = average_poses(poses)
    assert average.members.tolist() == [0, 1, 2]
    fused, result = fuse_votes(average, poses, covariances, np.ones(4))
    np.testing.assert_allclose(fused.T, average.T, atol=1e-12)
    expected = np.diag([4e-4 * (1 / 2 + 1 / 6)] * 6)
    expected[0, 0] += 2 * 0.01**2 / (3 * 2)
    np.testing.assert_allclose(result, expected, atol=1e-12)
    alone = average_poses(poses[3:])
    fused, result = fuse_votes(alone, poses[3:], covariances[3:], np.ones(1))
    np.testing.assert_allclose(fused.T, poses[3], atol=1e-12)
    np.testing.assert_allclose(result, covariances[3], atol=1e-12)


def test_votes_are_weighted_by_their_information():
    poses = np.repeat(np.eye(4)[None], 2, axis=0)
    poses[1, :3, 3] = (0.03, 0.03, 0.0)
    covariances = np.array([np.diag([1e-4, 4e-4, 1e-4] * 2), np.diag([2e-4, 2e-4, 1e-4] * 2)])
    average = average_poses(poses)
    fused, result = fuse_votes(average, poses, covariances, np.ones(2))
    # x: 2 parts of the first, 1 of the second; y: 1 part of the first, 2 of the second
    np.testing.assert_allclose(fused.T[:3, 3], (0.01, 0.02, 0.0), atol=1e-12)
    # both are sqrt(5) cm away from it, in x and y
    assert fused.spread_m == pytest.approx(0.01 * math.sqrt(5))
    own, shared = (4 * 1e-4 + 2e-4) / 9, ((2 * 1e-2 + math.sqrt(2) * 1e-2) / 3) ** 2
    spread = 2 * ((2 / 3 * 0.01) ** 2 + (1 / 3 * 0.02) ** 2)
    assert result[0, 0] == pytest.approx((own + shared) / 2 + spread)
    inflated, _ = fuse_votes(average, poses, covariances, np.array([1.0, 2.0]))
    np.testing.assert_allclose(inflated.T[:2, 3], (0.03 / 5, 0.03 / 2), atol=1e-12)
