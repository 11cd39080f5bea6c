"""A Gaussian mixture with diagonal covariances: the generative model of Sec. III-B."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from sceneprint.errors import TrainingError
from sceneprint.types import Floats


@dataclass(frozen=True, eq=False)
class Mixture:
    """The mixture Theta = {p_g, nu_g, Lambda_g}.

    Parameters
    ----------
    weights : (G,) float64, p_g; positive, with sum 1
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
    """Parameters of the fit."""

    n_components: int = 1250  #: G
    iterations: int = 8  #: number of iterations of expectation maximisation
    variance_floor: float = 0.02  #: value added to all variances; features have variance 1
    prior_variance: float = 0.02  #: prior of the components' variances
    prior_count: float = 5.0  #: weight of the prior, in samples
    minimum_weight: float = 1e-6  #: minimum p_g


def log_densities(features: Floats, mixture: Mixture) -> Floats:
    """Return log p_g + log N(f; nu_g, Lambda_g) of features (M, 12), (M, G) float64."""
    precision = 1.0 / mixture.variances
    constant = np.log(mixture.weights) - 0.5 * (
        np.log(2 * np.pi * mixture.variances) + mixture.means**2 * precision
    ).sum(axis=1)
    linear = features @ (mixture.means * precision).T
    result: Floats = constant + linear - 0.5 * (features**2) @ precision.T
    return result


def posteriors(features: Floats, mixture: Mixture) -> Floats:
    """Compute pi_ij,g of Sec. III-B, the posteriors of components for features (M, 12).

    Returns
    -------
    pi : (M, G) float64, rows with sum 1

    Notes
    -----
    Reading R2 (docs/paper.md): the printed formula omits p_g and |Lambda_g|; this is the posterior.
    """
    joint = log_densities(features, mixture)
    joint -= joint.max(axis=1, keepdims=True)
    np.exp(joint, out=joint)
    joint /= joint.sum(axis=1, keepdims=True)
    return joint


def fit_mixture(features: Floats, p: MixtureParameters, seed: int) -> Iterator[Mixture]:
    """Fit a mixture by expectation maximisation from a K-Means++ start (Sec. III-F).

    Yield the initial mixture and the mixture after each of `p.iterations` iterations, so that
    callers can show progress. The last mixture is the result.

    Parameters
    ----------
    features : (M, 12)
    seed : seed of the K-Means++ start

    Raises
    ------
    TrainingError : If there are fewer than ten features per component
    """
    if len(features) < 10 * p.n_components:
        raise TrainingError(
            f"{len(features)} training pairs are too few for {p.n_components} components. "
            "Train on more frames or select a smaller preset."
        )
    mixture = _k_means_start(features, p, seed)
    yield mixture
    for _ in range(p.iterations):
        mixture = em_step(features, mixture, p)
        yield mixture


def em_step(features: Floats, mixture: Mixture, p: MixtureParameters) -> Mixture:
    """Return the mixture after an iteration of expectation maximisation.

    Features (M, 12) are processed in blocks, because the posteriors of all features would fill
    gigabytes.
    """
    zeroth, first, second = moments(features, mixture)
    count = np.maximum(zeroth, 1e-9)[:, None]
    means = first / count
    variances = np.maximum(second / count - means**2, 0.0) + p.variance_floor
    return _with_priors(zeroth, means, variances, len(features), p)


def moments(
    features: Floats, mixture: Mixture, weights: Floats | None = None, block: int = 4096
) -> tuple[Floats, Floats, Floats]:
    """Return the weighted sums over features of pi (G,), pi f (G, 12) and pi f^2 (G, 12).

    Parameters
    ----------
    features : (M, 12)
    weights : (M,); None if all weights are 1
    block : number of features per block
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
    regular = (count[:, None] * variances + p.prior_count * p.prior_variance) / (
        count[:, None] + p.prior_count
    )
    weights = np.maximum(count / n, p.minimum_weight)
    return Mixture(weights / weights.sum(), means, regular)
