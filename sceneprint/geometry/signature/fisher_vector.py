"""Sec. III-B, "Encoding feature space statistics": features to the signature psi.

PairCounts, PairTable   --statistics_of_counts-->   Statistics
features (M, 12)        --statistics_of_features--> Statistics   (exact, the oracle)
Statistics  --fisher_vector-->  phi (25 G)
H of them   --signature-->      psi (25 G H)   --quantise-->  uint8
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneprint.geometry.kernel import kernel
from sceneprint.geometry.signature.mixture import Mixture, moments
from sceneprint.geometry.signature.pair_features import FEATURE_DIMENSION
from sceneprint.geometry.signature.pair_table import LEADING, PairCounts, PairTable
from sceneprint.types import Bytes, Floats, Floats32

#: Added to a quantised component: 0 is stored in the middle of the byte.
ZERO = 128


@dataclass(frozen=True, eq=False)
class LevelStatistics:
    """Sums over all pairs of one level, from which Eq. (2) follows.

    Parameters
    ----------
    zeroth : (G,) sum of weight times posterior
    first, second : (G, 12) the same, times feature and times squared feature
    n_pairs : number of ordered pairs
    total : sum of their weights; the number itself where all weigh 1
    """

    zeroth: Floats
    first: Floats
    second: Floats
    n_pairs: int
    total: float


@kernel
def _accumulate(
    counts: Floats32, table: Floats32, components: NDArray[np.int16], sums: Floats
) -> None:
    """sums (G, 32): first 12, second 12, zeroth in the 25th; the rest fills a cache line.

    table, components: the packed table, and the same memory as int16.
    """
    moments = np.empty(2 * FEATURE_DIMENSION)
    for b in range(len(counts)):
        if counts[b] == 0:
            continue
        for d in range(FEATURE_DIMENSION):
            moments[d] = table[b, d]
            moments[FEATURE_DIMENSION + d] = moments[d] * moments[d]
        for k in range(LEADING):
            share = float(table[b, FEATURE_DIMENSION + k])
            if share == 0.0:
                break
            weight = counts[b] * share
            g = components[b, 2 * (FEATURE_DIMENSION + LEADING) + k]
            for d in range(2 * FEATURE_DIMENSION):
                sums[g, d] += weight * moments[d]
            sums[g, 2 * FEATURE_DIMENSION] += weight


def statistics_of_counts(
    counts: PairCounts, table: PairTable, n_components: int
) -> LevelStatistics:
    """Statistics of pairs counted in the 4-D table.

    Parameters
    ----------
    counts : of one level
    table : of the model
    n_components : G
    """
    d, sums = FEATURE_DIMENSION, np.zeros((n_components, 32))
    _accumulate(counts.weights, table.packed, table.packed.view(np.int16), sums)
    return LevelStatistics(
        sums[:, 2 * d], sums[:, :d], sums[:, d : 2 * d], counts.n_pairs, counts.total
    )


def statistics_of_features(features: Floats, weights: Floats, mixture: Mixture) -> LevelStatistics:
    """Statistics of pairs one by one, with all posteriors: the oracle of the table.

    Parameters
    ----------
    features : (M, 12)
    weights : (M,) of the pairs
    mixture : G components
    """
    zeroth, first, second = moments(features, mixture, weights)
    return LevelStatistics(zeroth, first, second, len(features), float(weights.sum()))


def fisher_vector(s: LevelStatistics, mixture: Mixture) -> Floats:
    """The Fisher vector phi of one level: Eq. (2), Sec. III-B.

    Parameters
    ----------
    s : of at least one pair
    mixture : G components

    Returns
    -------
    phi : (25 G,) for each component m0, m1 (12), m2 (12); neither rooted nor normalised

    Notes
    -----
    Readings R2-R4, R9 (docs/paper.md): true posteriors; the weighted mean over all pairs;
    d^2 / var - 1 in each dimension; 1/sqrt(p_g) and 1/sqrt(2 p_g) are the closed form of the
    inverse Fisher information's factor.
    """
    p, nu, variance = mixture.weights, mixture.means, mixture.variances
    root = np.sqrt(p)[:, None]
    zeroth = s.zeroth[:, None]
    deviation = s.first - nu * zeroth
    spread = s.second - 2 * nu * s.first + nu**2 * zeroth
    m0 = (zeroth - s.total * p[:, None]) / (s.total * root)  # Eq. (2a)
    m1 = deviation / (np.sqrt(variance) * s.total * root)  # Eq. (2b)
    m2 = (spread / variance - zeroth) / (s.total * np.sqrt(2) * root)  # Eq. (2c)
    return np.concatenate([m0, m1, m2], axis=1).ravel()


def normalised(phi: Floats) -> Floats:
    """Component-wise signed square root, then unit l2 norm (after Eq. 2).

    Parameters
    ----------
    phi : (n,); zeros, of a level without pairs, stay zeros
    """
    rooted = np.sign(phi) * np.sqrt(np.abs(phi))
    norm = float(np.sqrt(np.abs(phi).sum()))  # of the roots; BLAS would sum by threads
    result: Floats = rooted / norm if norm > 0 else rooted
    return result


def signature(levels: Sequence[Floats]) -> Floats:
    """psi: the normalised Fisher vectors of all levels, finest first, end to end.

    Parameters
    ----------
    levels : H Fisher vectors (25 G,)

    Returns
    -------
    psi : (25 G H,)
    """
    return np.concatenate([normalised(phi) for phi in levels])


def quantise(psi: Floats, scale: float) -> Bytes:
    """One byte a component: round(psi / scale) + 128, clipped.

    L1 distances of quantised signatures times `scale` are those of the signatures, up to
    rounding: one scale serves all frames of a model.

    Parameters
    ----------
    psi : (n,)
    scale : the model's step
    """
    result: Bytes = np.clip(np.rint(psi / scale) + ZERO, 0, 255).astype(np.uint8)
    return result
