"""The golden cases of Eq. (1) and Eq. (2) catch a wrong line: one mutation at a time."""

from __future__ import annotations

import inspect
from types import ModuleType

import pytest

from sceneprint.geometry.signature import fisher_vector, pair_features

EQ1 = [
    ("-a_w * m_v", "a_w * m_v"),
    ("a_u * m_v - a_v * m_u", "a_u * m_v + a_v * m_u"),
    ("np.stack([-a_w * m_v, a_w * m_u,", "np.stack([-a_w * m_v, a_w * m_v,"),
    ("np.cos(theta_mu), np.sin(theta_mu)", "np.sin(theta_mu), np.cos(theta_mu)"),
    ("a_u = np.cos(theta_alpha)", "a_u = np.sin(theta_alpha)"),
    (
        "a_v, a_w = np.sin(theta_alpha) * np.cos(phi), np.sin(theta_alpha) * np.sin(phi)",
        "a_w, a_v = np.sin(theta_alpha) * np.cos(phi), np.sin(theta_alpha) * np.sin(phi)",
    ),
    ("a_u * m_u + a_v * m_v)", "a_u * m_u)"),
    ("theta_mu, theta_alpha, d * m_u", "theta_alpha, theta_mu, d * m_u"),
    ("theta_mu, theta_alpha, d * m_u", "theta_mu, theta_alpha, m_u"),
    ("a_u, a_v, a_w,\n", "a_u, a_w, a_v,\n"),
    ("d * cross[0]", "d * cross[1]"),
    ("d * cross[0], d,", "cross[0], d,"),
    ("d * cross[0], d,", "d * cross[0], d**2,"),
    ("d * sgn(m_u)", "sgn(m_u)"),
    ("d * sgn(a_u)", "d * sgn(m_u)"),
    ("d * sgn(a_v)", "d * sgn(a_u)"),
    ("d * sgn(a_w)", "d * sgn(-a_w)"),
    ("np.where(np.abs(cosine) <= tolerance, 0.0, np.sign(cosine))", "np.sign(cosine)"),
    ("math.sin(p.angular_tolerance)", "math.cos(p.angular_tolerance)"),
    ("math.sin(p.angular_tolerance)", "math.sin(p.angular_tolerance / 2)"),
    ("patches.means[alpha] - patches.means[mu]", "patches.means[mu] - patches.means[alpha]"),
    ("patches.normals[mu], patches.normals[alpha]", "patches.normals[alpha], patches.normals[mu]"),
    ("n_mu - _dot(n_mu, u)[:, None] * u", "n_mu"),
    ("np.cross(u, v)", "np.cross(v, u)"),
    ("np.arctan2(a_w, a_v)", "np.arctan2(a_v, a_w)"),
    ("np.hypot(a_v, a_w)", "a_v"),
]  # fmt: skip

EQ2 = [
    ("np.sqrt(p)[:, None]", "p[:, None]"),
    ("s.first - nu * zeroth", "s.first"),
    ("2 * nu * s.first", "nu * s.first"),
    ("+ nu**2 * zeroth", "- nu**2 * zeroth"),
    ("+ nu**2 * zeroth", "+ nu * zeroth"),
    ("+ nu**2 * zeroth", ""),
    ("zeroth - s.total * p[:, None]", "zeroth - p[:, None]"),
    ("zeroth - s.total * p[:, None]", "zeroth"),
    ("/ (s.total * root)  # Eq. (2a)", "/ root"),
    ("/ (np.sqrt(variance)", "/ (variance"),
    ("/ (np.sqrt(variance) * s.total * root)", "/ (np.sqrt(variance) * root)"),
    ("spread / variance - zeroth", "spread / variance"),
    ("spread / variance - zeroth", "spread / np.sqrt(variance) - zeroth"),
    ("s.total * np.sqrt(2) * root", "s.total * root"),
    ("s.total * np.sqrt(2) * root", "s.total * 2 * root"),
    ("s.total * np.sqrt(2) * root", "s.total * np.sqrt(2)"),
    ("zeroth - s.total * p[:, None]", "zeroth - s.n_pairs * p[:, None]"),
    ("[m0, m1, m2], axis=1).ravel()", "[m0, m2, m1], axis=1).ravel()"),
    ("[m0, m1, m2], axis=1).ravel()", "[m0, m1, m2], axis=1).T.ravel()"),
]


def mutated(module: ModuleType, line: str, wrong: str) -> ModuleType:
    """A fresh copy of a module with one expression replaced."""
    source = inspect.getsource(module)
    assert source.count(line) == 1, f"{line!r} is {source.count(line)} times in {module.__name__}"
    copy = ModuleType(module.__name__)  # dataclasses look their module up by this name
    copy.__file__ = module.__file__
    # numba asks for the file of a kernel when it is declared; none is compiled here
    code = compile(source.replace(line, wrong), str(module.__file__), "exec")
    exec(code, copy.__dict__)
    return copy


@pytest.mark.thorough
@pytest.mark.parametrize(("line", "wrong"), EQ1)
def test_goldens_catch_a_wrong_eq1(goldens: ModuleType, line: str, wrong: str) -> None:
    module = mutated(pair_features, line, wrong)

    def check() -> None:
        goldens.check_eq1(module)
        goldens.check_r1(module)

    with pytest.raises(AssertionError):
        check()


@pytest.mark.thorough
@pytest.mark.parametrize(("line", "wrong"), EQ2)
def test_goldens_catch_a_wrong_eq2(goldens: ModuleType, line: str, wrong: str) -> None:
    module = mutated(fisher_vector, line, wrong)
    with pytest.raises(AssertionError):
        goldens.check_eq2(module)


def test_unchanged_copies_pass(goldens: ModuleType) -> None:
    # so that the cases above fail for their mutation, not for being copies
    copy = mutated(pair_features, "np.cross(u, v)", "np.cross(u, v)")
    goldens.check_eq1(copy)
    goldens.check_r1(copy)
    copy = mutated(fisher_vector, "s.first - nu * zeroth", "s.first - nu * zeroth")
    goldens.check_eq2(copy)
    # the copies are live: their functions are not the originals
    assert copy.fisher_vector is not fisher_vector.fisher_vector
    assert pair_features.PROPERTY_DIMENSION == 13
