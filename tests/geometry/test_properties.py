"""Tests of Eq. (1) against manual results and the paper, and under rigid motion."""

import math

import numpy as np
import pytest

from sceneprint.geometry.signature.pair_features import (
    PropertyParameters,
    invariants,
    neighbour_pairs,
    pair_properties,
    properties,
)
from tests.geometry import scenes
from tests.geometry.scenes import patches_of

PARAMETERS = PropertyParameters(radius=3.0, angular_tolerance=math.radians(10), colinearity=0.9995)


def from_invariants(d, theta_mu, theta_alpha, phi):
    """Return two patches with u = x, v = y, w = z and the given invariants."""
    n_mu = [math.cos(theta_mu), math.sin(theta_mu), 0.0]
    s = math.sin(theta_alpha)
    n_alpha = [math.cos(theta_alpha), s * math.cos(phi), s * math.sin(phi)]
    return patches_of([[0, 0, 0], [d, 0, 0]], [n_mu, n_alpha])


def test_robust_sign():
    """Reading R1: the robust sign is 0 within 10 degrees of perpendicular, and not beyond.

    With d = 2 and the angles 90 - 9.9 or 90 - 10.1 degrees to u, v or w, the four signs are
    0 or 2; mirrored, 0 or -2.
    """
    p = PropertyParameters(radius=10.0, angular_tolerance=math.radians(10), colinearity=0.999)
    for off, value in ((9.9, 0.0), (10.1, 2.0), (-9.9, 0.0), (-10.1, -2.0)):
        # Both normals are off perpendicular to u by the same angle; n_alpha is between v and w.
        near = math.radians(90 - off)
        f = properties(np.array([[2.0, near, near, math.radians(45)]]), p)
        assert f[0, 9:].tolist() == [value, value, 2.0, 2.0]
        # n_alpha is perpendicular to u, off w by the angle towards v; then the roles are swapped.
        f = properties(np.array([[2.0, near, math.radians(90), near]]), p)
        assert f[0, 9:].tolist() == [value, 0.0, value, 2.0]
        f = properties(np.array([[2.0, near, math.radians(90), math.radians(off)]]), p)
        assert f[0, 9:].tolist() == [value, 0.0, 2.0, value]


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


def test_equals_the_letter_of_the_paper():
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


def test_invariants_give_back_what_they_were_made_of():
    for given_ in ((0.7, 0.4, 2.9, -3.0), (2.0, 1.5, 0.1, 0.2), (1.0, 3.0, 1.6, 2.5)):
        patches = from_invariants(*given_)
        result = invariants(patches, np.array([[0, 1]]))
        np.testing.assert_allclose(result, [given_], rtol=0, atol=1e-12)


def test_right_angles_are_exact():
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
        patches = patches_of(means, normals)
        return [[int(mu), int(alpha)] for mu, alpha in neighbour_pairs(patches, PARAMETERS)]

    all_up = [[0, 1], [1, 0], [1, 2], [1, 3], [2, 1], [3, 1]]
    assert pairs([up, up, up, up]) == all_up
    # a normal along r spans no basis with it as n_mu, but may be n_alpha
    assert pairs([up, along, up, up]) == [[0, 1], [2, 1], [3, 1]]
    # arccos(.9995) = 0.0316 rad: at 0.04 it does
    assert pairs([up, near, up, up]) == all_up
