"""Sec. III-A, "Feature space projection": 13-D properties to 12-D features.

f' (M, 13)  --project-->  f (M, 12)
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Literal

import numpy as np

from sceneprint.errors import TrainingError
from sceneprint.geometry.properties import DIMENSION as PROPERTY_DIMENSION
from sceneprint.types import Floats

DIMENSION = 12  #: d_F, length of f


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

        pca = PCA(n_components=DIMENSION, whiten=True, svd_solver="covariance_eigh")
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

        ica = FastICA(DIMENSION, whiten="unit-variance", random_state=seed, max_iter=1000)
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
    return Projection(mean, matrix * np.sign(components[np.arange(DIMENSION), largest])[:, None])
