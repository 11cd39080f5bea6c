"""Sec. III-A, "Geometric property set extraction": patch pairs to 13-D properties.

    Patches (P), pairs (M, 2)  --invariants-->  (M, 4)  --properties-->  f' (M, 13)

Symbols follow the paper: mu is the reference patch, alpha its neighbour, r the vector from
mu to alpha, <u, v, w> the Gram-Schmidt basis of (r, n_mu) with w = u x v.

A pair of oriented points has four degrees of freedom under rigid motion: the length of r,
the angles of both normals to it, and the dihedral angle between the normals about it. All
thirteen properties are functions of these four, which is what makes the table of
`pair_table.py` possible.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from sceneprint.errors import TrainingError
from sceneprint.types import Floats, Patches

PROPERTY_DIMENSION = 13  #: length of f', Eq. (1)


@dataclass(frozen=True)
class PropertyParameters:
    """The numbers of Eq. (1)."""

    radius: float = 3.0  #: reach of a patch's neighbourhood, metres
    angular_tolerance: float = math.radians(10.0)  #: e_theta of the robust sign, rad
    colinearity: float = 0.9995  #: |n_mu . u| beyond which (r, n_mu) span no basis


def neighbour_pairs(patches: Patches, p: PropertyParameters) -> NDArray[np.int64]:
    """All ordered pairs of patches that lie within reach and span a basis: N_mu of Sec. III-A.

    Parameters
    ----------
    patches : P of them
    p : see PropertyParameters

    Returns
    -------
    pairs : (M, 2) indices (mu, alpha), M <= P (P - 1), sorted
    """
    r = patches.means[None, :, :] - patches.means[:, None, :]
    d = np.linalg.norm(r, axis=2)
    apart = (d > 0) & (d < p.radius)
    along = np.abs(np.einsum("mad,md->ma", r, patches.normals))
    return np.argwhere(apart & (along <= p.colinearity * d))


def invariants(patches: Patches, pairs: NDArray[np.int64]) -> Floats:
    """The four numbers of each ordered pair that no rigid motion changes.

    Parameters
    ----------
    patches : means in metres, normals of unit length
    pairs : (M, 2) indices (mu, alpha) whose r and n_mu are not parallel

    Returns
    -------
    (M, 4) : ||r|| in metres; the angles of n_mu and of n_alpha to u in [0, pi]; the dihedral
        angle from n_mu to n_alpha about u in [-pi, pi]; rad
    """
    mu, alpha = pairs.T
    r = patches.means[alpha] - patches.means[mu]
    d = np.linalg.norm(r, axis=1)
    n_mu, n_alpha = patches.normals[mu], patches.normals[alpha]
    u = r / d[:, None]  # Gram-Schmidt, Fig. 2
    v = n_mu - _dot(n_mu, u)[:, None] * u
    v /= np.linalg.norm(v, axis=1, keepdims=True)
    w = np.cross(u, v)
    a_v, a_w = _dot(n_alpha, v), _dot(n_alpha, w)
    # arctan2 keeps full precision where arccos of a cosine near 1 has lost half the digits
    theta_mu = np.arctan2(_dot(n_mu, v), _dot(n_mu, u))
    theta_alpha = np.arctan2(np.hypot(a_v, a_w), _dot(n_alpha, u))
    return np.column_stack([d, theta_mu, theta_alpha, np.arctan2(a_w, a_v)])


def properties(invariant: Floats, p: PropertyParameters) -> Floats:
    """The 13-D vector f' of relative properties: Eq. (1), Sec. III-A.

    Parameters
    ----------
    invariant : (M, 4) as `invariants` returns them
    p : see PropertyParameters

    Returns
    -------
    f : (M, 13) in the order of Eq. (1): 0-2 angles in rad, [0, pi]; 4-6 cosines; 3 and
        7-12 metres

    Notes
    -----
    Reading R1 (docs/paper.md): the printed interval of sgn_e is empty; the sign is taken
    as 0 within e_theta of perpendicular, |cos| <= sin(e_theta).
    """
    d, theta_mu, theta_alpha, phi = invariant.T
    m_u, m_v = np.cos(theta_mu), np.sin(theta_mu)  # n_mu = m_u u + m_v v
    a_u = np.cos(theta_alpha)  # n_alpha = a_u u + a_v v + a_w w
    a_v, a_w = np.sin(theta_alpha) * np.cos(phi), np.sin(theta_alpha) * np.sin(phi)
    # n_alpha x n_mu in <u, v, w>; its length is the sine of the angle between the normals
    cross = np.stack([-a_w * m_v, a_w * m_u, a_u * m_v - a_v * m_u])
    between = np.arctan2(np.sqrt((cross**2).sum(axis=0)), a_u * m_u + a_v * m_v)
    tolerance = math.sin(p.angular_tolerance)

    def sgn(cosine: Floats) -> Floats:
        return np.where(np.abs(cosine) <= tolerance, 0.0, np.sign(cosine))

    return np.column_stack(  # Eq. (1)
        [
            between, theta_mu, theta_alpha, d * m_u, a_u, a_v, a_w,
            d * cross[0], d, d * sgn(m_u), d * sgn(a_u), d * sgn(a_v), d * sgn(a_w),
        ]
    )  # fmt: skip


def pair_properties(patches: Patches, pairs: NDArray[np.int64], p: PropertyParameters) -> Floats:
    """Properties of ordered patch pairs: Eq. (1) applied to pairs as they stand.

    Parameters
    ----------
    patches : P of them
    pairs : (M, 2) as `neighbour_pairs` returns them
    p : see PropertyParameters

    Returns
    -------
    f : (M, 13)
    """
    return properties(invariants(patches, pairs), p)


def _dot(a: Floats, b: Floats) -> Floats:
    product: Floats = np.einsum("md,md->m", a, b)
    return product


# Sec. III-A, "Feature space projection": 13-D properties to 12-D features.
#
# f' (M, 13)  --project-->  f (M, 12)

FEATURE_DIMENSION = 12  #: d_F, length of f


@dataclass(frozen=True, eq=False)
class Projection:
    """The learnt subspace: f = matrix (f' - mean).

    Parameters
    ----------
    mean : (13,) float64
    matrix : (12, 13) float64
    """

    mean: Floats
    matrix: Floats


def project(properties: Floats, projection: Projection) -> Floats:
    """Features of the learnt subspace.

    Parameters
    ----------
    properties : (M, 13)
    projection : see Projection

    Returns
    -------
    features : (M, 12), of unit variance and uncorrelated over the training pairs
    """
    # not `@`: BLAS sums in an order that depends on its threads, and tables are compared by byte
    features: Floats = np.einsum("md,fd->mf", properties - projection.mean, projection.matrix)
    return features


def fit_projection(
    properties: Floats, method: Literal["pca", "ica"] = "pca", seed: int = 0
) -> Projection:
    """Learn the subspace from the properties of training pairs.

    Parameters
    ----------
    properties : (M, 13)
    method : "pca" whitens the standardised properties; "ica" goes on to make the
        components independent (FastICA, log cosh)
    seed : of FastICA's starting matrix

    Returns
    -------
    projection : rows are signed so that their largest weight is positive, since neither
        method fixes signs

    Raises
    ------
    TrainingError : a property does not vary, or FastICA does not converge.

    Notes
    -----
    Reading R7 (docs/paper.md): the paper says nonlinear ICA and cites EFICA, a linear one.
    """
    mean, scale = properties.mean(axis=0), properties.std(axis=0)
    if len(properties) <= PROPERTY_DIMENSION or not (scale > 1e-9).all():
        raise TrainingError(
            f"The {len(properties)} training pairs leave a property without variation, so no "
            "subspace can be learnt. Train on more frames of furnished rooms."
        )
    standardised = (properties - mean) / scale
    if method == "pca":
        from sklearn.decomposition import PCA

        pca = PCA(n_components=FEATURE_DIMENSION, whiten=True, svd_solver="covariance_eigh")
        pca.fit(standardised)
        if pca.explained_variance_[-1] < 1e-9:
            raise TrainingError(
                "The properties of the training pairs depend on each other, so that twelve "
                "directions cannot be told apart. Train on more frames of furnished rooms."
            )
        components = pca.components_ / np.sqrt(pca.explained_variance_)[:, None]
    else:
        from sklearn.decomposition import FastICA
        from sklearn.exceptions import ConvergenceWarning

        ica = FastICA(FEATURE_DIMENSION, whiten="unit-variance", random_state=seed, max_iter=1000)
        with warnings.catch_warnings():
            warnings.simplefilter("error", ConvergenceWarning)
            try:
                ica.fit(standardised)
            except ConvergenceWarning as error:
                raise TrainingError(
                    "FastICA did not converge in 1000 iterations. Train on more frames, or use "
                    "the pca projection."
                ) from error
        components = ica.components_
    matrix = components / scale
    largest = np.abs(components).argmax(axis=1)
    return Projection(
        mean, matrix * np.sign(components[np.arange(FEATURE_DIMENSION), largest])[:, None]
    )
