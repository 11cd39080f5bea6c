"""Manual results of Eq. (1) and Eq. (2); each check takes the module under test."""

import math

import numpy as np

from sceneprint.geometry.signature.mixture import Mixture
from sceneprint.types import Patches


def two_patches(l_mu, n_mu, l_alpha, n_alpha):
    return Patches(
        np.array([l_mu, l_alpha]),
        np.array([n_mu, n_alpha]),
        np.ones(2),
        np.ones(2, np.int32),
        np.ones(2),
    )


def from_invariants(d, theta_mu, theta_alpha, phi):
    """Return two patches with u = x, v = y, w = z and the given invariants."""
    n_mu = [math.cos(theta_mu), math.sin(theta_mu), 0.0]
    s = math.sin(theta_alpha)
    n_alpha = [math.cos(theta_alpha), s * math.cos(phi), s * math.sin(phi)]
    return two_patches(np.zeros(3), np.array(n_mu), np.array([d, 0.0, 0.0]), np.array(n_alpha))


def check_eq1(module):
    """Check two pairs in which no term of Eq. (1) is zero and every sign occurs both ways."""
    p = module.PropertyParameters(
        radius=10.0, angular_tolerance=math.radians(10), colinearity=0.999
    )
    pair = np.array([[0, 1]])

    # 1: r = (2, 0, 0), so u is x; with n_mu = (.6, .8, 0), v is y and w is z, u x v
    #    n_alpha = (2, 3, -6) / 7 is its own coordinates in <u, v, w>
    #    so n_alpha . n_mu is (1.2 + 2.4) / 7 and r . n_mu is 1.2
    #    n_alpha x n_mu is (3*0 + 6*.8, ...) / 7 = (4.8, ...) / 7, and r . that is 9.6 / 7
    first = two_patches(
        np.array([1.0, -1.0, 4.0]), np.array([0.6, 0.8, 0.0]),
        np.array([3.0, -1.0, 4.0]), np.array([2.0, 3.0, -6.0]) / 7,
    )  # fmt: skip
    np.testing.assert_allclose(
        module.pair_properties(first, pair, p),
        [[
            math.acos(3.6 / 7), math.acos(0.6), math.acos(2 / 7), 1.2, 2 / 7, 3 / 7, -6 / 7,
            9.6 / 7, 2.0, 2.0, 2.0, 2.0, -2.0,
        ]],
        rtol=0, atol=1e-12,
    )  # fmt: skip

    # 2: r = (0, 0, -3), so u = -z; n_mu = (0, .6, .8): n_mu . u = -.8, v = y, w = u x v = x
    #    n_alpha = (6, -3, 2) / 7: in <u, v, w> (-2, -3, 6) / 7
    #    so n_alpha . n_mu is (-1.8 + 1.6) / 7 and r . n_mu is -2.4
    #    n_alpha x n_mu is (-3*.8 - 2*.6, 2*0 - 6*.8, 6*.6) / 7 = (-3.6, -4.8, 3.6) / 7,
    #    and r . that is -10.8 / 7
    second = two_patches(
        np.array([1.0, 1.0, 1.0]), np.array([0.0, 0.6, 0.8]),
        np.array([1.0, 1.0, -2.0]), np.array([6.0, -3.0, 2.0]) / 7,
    )  # fmt: skip
    np.testing.assert_allclose(
        module.pair_properties(second, pair, p),
        [[
            math.acos(-0.2 / 7), math.acos(-0.8), math.acos(-2 / 7), -2.4, -2 / 7, -3 / 7, 6 / 7,
            -10.8 / 7, 3.0, -3.0, -3.0, -3.0, 3.0,
        ]],
        rtol=0, atol=1e-12,
    )  # fmt: skip


def check_r1(module):
    """Check reading R1: the robust sign is 0 within 10 degrees of perpendicular, and not beyond.

    With d = 2 and the angles 90 - 9.9 or 90 - 10.1 degrees to u, v or w, the four signs are
    0 or 2; mirrored, 0 or -2.
    """
    p = module.PropertyParameters(
        radius=10.0, angular_tolerance=math.radians(10), colinearity=0.999
    )
    for off, value in ((9.9, 0.0), (10.1, 2.0), (-9.9, 0.0), (-10.1, -2.0)):
        # Both normals are off perpendicular to u by the same angle; n_alpha is between v and w.
        near = math.radians(90 - off)
        f = module.properties(np.array([[2.0, near, near, math.radians(45)]]), p)
        assert f[0, 9:].tolist() == [value, value, 2.0, 2.0]
        # n_alpha is perpendicular to u, off w by the angle towards v; then the roles are swapped.
        f = module.properties(np.array([[2.0, near, math.radians(90), near]]), p)
        assert f[0, 9:].tolist() == [value, 0.0, value, 2.0]
        f = module.properties(np.array([[2.0, near, math.radians(90), math.radians(off)]]), p)
        assert f[0, 9:].tolist() == [value, 0.0, 2.0, value]


def check_eq2(module):
    """Check two pairs, two components and two dimensions with given posteriors.

    f = (1, 2), (3, -1) with pi = (.2, .8), (.6, .4); p = (.36, .64), whose roots are .6, .8;
    nu_1 = (.5, 1.5), Lambda_1 = (4, .25); nu_2 = (-1, .5), Lambda_2 = (.25, 4).
    """
    f, pi = np.array([[1.0, 2.0], [3.0, -1.0]]), np.array([[0.2, 0.8], [0.6, 0.4]])
    mixture = Mixture(
        np.array([0.36, 0.64]),
        np.array([[0.5, 1.5], [-1.0, 0.5]]),
        np.array([[4.0, 0.25], [0.25, 4.0]]),
    )
    statistics = module.LevelStatistics(pi.sum(axis=0), pi.T @ f, pi.T @ f**2, n_pairs=7, total=2.0)
    root2 = math.sqrt(2)
    expected = [
        # m0 of g = 1 is (.8 - 2 * .36) / (2 * .6)
        1 / 15,
        # m1 of g = 1 is [.2 (.5, .5) + .6 (2.5, -2.5)] / (2, .5) / 1.2 = (1.6, -1.4) / (2.4, .6)
        2 / 3, -7 / 3,
        # m2 of g = 1: .2 (1/16 - 1) + .6 (25/16 - 1) = .15; .6 (25 - 1) = 14.4; / 1.2 root2
        0.125 / root2, 12 / root2,
        # m0 of g = 2 is (1.2 - 2 * .64) / (2 * .8)
        -0.05,
        # m1 of g = 2 is [.8 (2, 1.5) + .4 (4, -1.5)] / (.5, 2) / 1.6 = (3.2, .6) / (.8, 3.2)
        4.0, 0.1875,
        # m2 of g = 2: .8 (16 - 1) + .4 (64 - 1) = 37.2; 1.2 (.5625 - 1) = -.525; / 1.6 root2
        23.25 / root2, -0.328125 / root2,
    ]  # fmt: skip
    np.testing.assert_allclose(
        module.fisher_vector(statistics, mixture), expected, rtol=0, atol=1e-12
    )
