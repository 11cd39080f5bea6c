"""Tests of Eq. (1) against manual results and the paper, and under rigid motion."""

import math

import numpy as np
import pytest

from sceneprint.geometry.signature import pair_features as module
from sceneprint.geometry.signature.pair_features import (
    PropertyParameters,
    invariants,
    neighbour_pairs,
    pair_properties,
    properties,
)
from sceneprint.types import Patches

PARAMETERS = PropertyParameters(radius=3.0, angular_tolerance=math.radians(10), colinearity=0.9995)


def test_robust_sign(goldens):
    goldens.check_r1(module)


def angle(a, b):
    return math.acos(float(np.dot(a, b)))


def eq1(l_mu, n_mu, l_alpha, n_alpha):
    """Eq. (1) as printed, from the vectors, with reading R1."""
    r = l_alpha - l_mu
    length = math.sqrt(float(r @ r))
    u = r / length
    v = n_mu - (n_mu @ u) * u
    v = v / math.sqrt(float(v @ v))
    w = np.cross(u, v)

    def sgn(cosine):
        return 0.0 if abs(cosine) <= math.sin(math.radians(10)) else math.copysign(1.0, cosine)

    return [
        angle(n_alpha, n_mu), angle(u, n_mu), angle(u, n_alpha),
        float(r @ n_mu), float(n_alpha @ u), float(n_alpha @ v), float(n_alpha @ w),
        float(r @ np.cross(n_alpha, n_mu)), length,
        length * sgn(float(n_mu @ u)), length * sgn(float(n_alpha @ u)),
        length * sgn(float(n_alpha @ v)), length * sgn(float(n_alpha @ w)),
    ]  # fmt: skip


def test_equals_the_letter_of_the_paper(scenes):
    patches = scenes.random_patches(np.random.default_rng(0), 25)
    pairs = neighbour_pairs(patches, PARAMETERS)
    assert len(pairs) > 300
    expected = [
        eq1(patches.means[mu], patches.normals[mu], patches.means[alpha], patches.normals[alpha])
        for mu, alpha in pairs
    ]
    f = pair_properties(patches, pairs, PARAMETERS)
    assert f.shape == (len(pairs), 13)
    np.testing.assert_allclose(f, expected, rtol=0, atol=1e-9)


def test_invariants_give_back_what_they_were_made_of(goldens):
    for given_ in ((0.7, 0.4, 2.9, -3.0), (2.0, 1.5, 0.1, 0.2), (1.0, 3.0, 1.6, 2.5)):
        patches = goldens.from_invariants(*given_)
        found = invariants(patches, np.array([[0, 1]]))
        np.testing.assert_allclose(found, [given_], rtol=0, atol=1e-12)


def test_right_angles_are_exact(goldens):
    # parallel and perpendicular normals: where arccos of a rounded cosine would be off or NaN
    for theta_alpha, phi, between in (
        (math.pi / 2, 0.0, 0.0),
        (math.pi / 2, math.pi, math.pi),
        (math.pi / 2, math.pi / 2, math.pi / 2),
        (0.0, 0.0, math.pi / 2),
        (math.pi, 0.0, math.pi / 2),
    ):
        f = properties(np.array([[2.0, math.pi / 2, theta_alpha, phi]]), PARAMETERS)
        assert f[0, 0] == pytest.approx(between, abs=1e-12)
        assert f[0, 2] == pytest.approx(theta_alpha, abs=1e-12)
        assert f[0, 9] == 0.0


def test_neighbours_by_hand():
    # 0 and 1 a metre apart; 2 is 3.5 m from 0 and 2.5 m from 1; 3 is where 0 is
    means = np.array([[0, 0, 0], [1, 0, 0], [3.5, 0, 0], [0, 0, 0]], float)
    up, along, near = [0, 0, 1], [1, 0, 0], [math.cos(0.04), 0, math.sin(0.04)]

    def pairs(normals):
        ones = np.ones(4)
        patches = Patches(means, np.array(normals, float), ones, np.ones(4, np.int32), ones)
        return [[int(mu), int(alpha)] for mu, alpha in neighbour_pairs(patches, PARAMETERS)]

    all_up = [[0, 1], [1, 0], [1, 2], [1, 3], [2, 1], [3, 1]]
    assert pairs([up, up, up, up]) == all_up
    # a normal along r spans no basis with it as n_mu, but may be n_alpha
    assert pairs([up, along, up, up]) == [[0, 1], [2, 1], [3, 1]]
    # arccos(.9995) = 0.0316 rad: at 0.04 it does
    assert pairs([up, near, up, up]) == all_up
