"""Manual results of Eq. (1) and Eq. (2); each check takes the module under test."""

import math

import numpy as np

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
