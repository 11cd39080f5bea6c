"""Sec. III-B, the generative model: a Gaussian mixture with diagonal covariances.

features (M, 12)  --posteriors-->  pi (M, G)
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from sceneprint.errors import TrainingError
from sceneprint.types import Floats


@dataclass(frozen=True, eq=False)
class Mixture:
    """Theta = {p_g, nu_g, Lambda_g}.

    Parameters
    ----------
    weights : (G,) float64, p_g; positive, of sum 1
    means : (G, 12) float64, nu_g
    variances : (G, 12) float64, the diagonals of Lambda_g; positive
    """

    weights: Floats
    means: Floats
    variances: Floats

    def __len__(self) -> int:
        return len(self.weights)


@dataclass(frozen=True)
class MixtureParameters:
    """The numbers of the fit."""

    n_components: int = 1250  #: G
    iterations: int = 8  #: of expectation maximisation
    variance_floor: float = 0.02  #: added to every variance; the features' own are 1
    prior_variance: float = 0.02  #: towards which components with few samples are drawn
    prior_count: float = 5.0  #: as strongly as so many samples would
    minimum_weight: float = 1e-6  #: below which no p_g falls


def log_densities(features: Floats, mixture: Mixture) -> Floats:
    """log p_g + log N(f; nu_g, Lambda_g), the joint log density of feature and component.

    Parameters
    ----------
    features : (M, 12)
    mixture : G components

    Returns
    -------
    (M, G) float64
    """
    precision = 1.0 / mixture.variances
    constant = np.log(mixture.weights) - 0.5 * (
        np.log(2 * np.pi * mixture.variances) + mixture.means**2 * precision
    ).sum(axis=1)
    linear = features @ (mixture.means * precision).T
    result: Floats = constant + linear - 0.5 * (features**2) @ precision.T
    return result


def posteriors(features: Floats, mixture: Mixture) -> Floats:
    """pi_ij,g of Sec. III-B: the share of each component in each feature.

    Parameters
    ----------
    features : (M, 12)
    mixture : G components

    Returns
    -------
    pi : (M, G) float64, rows of sum 1

    Notes
    -----
    Reading R2 (docs/paper.md): the print omits p_g and |Lambda_g|; this is the posterior.
    """
    joint = log_densities(features, mixture)
    joint -= joint.max(axis=1, keepdims=True)
    np.exp(joint, out=joint)
    joint /= joint.sum(axis=1, keepdims=True)
    return joint


def fit_mixture(features: Floats, p: MixtureParameters, seed: int) -> Iterator[Mixture]:
    """Learn a mixture by expectation maximisation from a K-Means++ start (Sec. III-F).

    Yields the start and the mixture after every iteration, so that the caller can show
    progress; the last one is the result.

    Parameters
    ----------
    features : (M, 12)
    seed : of the K-Means++ start

    Raises
    ------
    TrainingError : fewer than ten features for each component.
    """
    if len(features) < 10 * p.n_components:
        raise TrainingError(
            f"{len(features)} training pairs are too few for {p.n_components} components. "
            "Train on more frames, or choose a smaller preset."
        )
    mixture = _k_means_start(features, p, seed)
    yield mixture
    for _ in range(p.iterations):
        mixture = em_step(features, mixture, p)
        yield mixture


def em_step(features: Floats, mixture: Mixture, p: MixtureParameters) -> Mixture:
    """One iteration of expectation maximisation.

    Features are taken in blocks, so that memory is bounded by a block times G; posteriors
    of all features at once would be gigabytes.

    Parameters
    ----------
    features : (M, 12)
    mixture : G components
    """
    zeroth, first, second = moments(features, mixture)
    count = np.maximum(zeroth, 1e-9)[:, None]
    means = first / count
    variances = np.maximum(second / count - means**2, 0.0) + p.variance_floor
    return _with_priors(zeroth, means, variances, len(features), p)


def moments(
    features: Floats, mixture: Mixture, weights: Floats | None = None, block: int = 4096
) -> tuple[Floats, Floats, Floats]:
    """Weighted sums over features of pi, pi f and pi f^2, block by block.

    Parameters
    ----------
    features : (M, 12)
    mixture : G components
    weights : (M,), or None where all are 1
    block : features at a time

    Returns
    -------
    zeroth (G,), first (G, 12), second (G, 12)
    """
    g, dimension = mixture.means.shape
    zeroth, first, second = np.zeros(g), np.zeros((g, dimension)), np.zeros((g, dimension))
    for at in range(0, len(features), block):
        f = features[at : at + block]
        pi = posteriors(f, mixture)
        if weights is not None:
            pi *= weights[at : at + block, None]
        zeroth += pi.sum(axis=0)
        first += pi.T @ f
        second += pi.T @ f**2
    return zeroth, first, second


def _k_means_start(features: Floats, p: MixtureParameters, seed: int) -> Mixture:
    from sklearn.cluster import KMeans

    k_means = KMeans(p.n_components, init="k-means++", n_init=1, max_iter=4, random_state=seed)
    labels = k_means.fit_predict(features)
    count = np.bincount(labels, minlength=p.n_components).astype(float)
    safe = np.maximum(count, 1.0)[:, None]
    means, squares = np.zeros((2, p.n_components, features.shape[1]))
    np.add.at(means, labels, features)
    np.add.at(squares, labels, features**2)
    means, squares = means / safe, squares / safe
    variances = np.maximum(squares - means**2, 0.0) + p.variance_floor
    return _with_priors(count, means, variances, len(features), p)


def _with_priors(
    count: Floats, means: Floats, variances: Floats, n: int, p: MixtureParameters
) -> Mixture:
    drawn = (count[:, None] * variances + p.prior_count * p.prior_variance) / (
        count[:, None] + p.prior_count
    )
    weights = np.maximum(count / n, p.minimum_weight)
    return Mixture(weights / weights.sum(), means, drawn)
