"""Fisher vectors of features, and stored signatures (Sec. III-B).

    PairCounts, PairTable   --statistics_of_counts-->   LevelStatistics
    features (M, 12)        --statistics_of_features--> LevelStatistics   (exact, the oracle)
    LevelStatistics  --fisher_vector-->  phi (25 G)
    phi of H levels  --signature-->  psi (25 G H)  --quantise-->  uint8
    psi (n, D)  --fit_whitening-->  Whitening      psi  --whiten-->  (d,) uint8

For the stored signature, psi is centred, projected onto the axes of its largest variances, whitened
and quantised. A Fisher vector has a few strong axes, common to all rooms, and many weak axes that
distinguish rooms; whitening increases the influence of the weak axes. docs/model.md contains the
measurements, and docs/paper.md the differences from the paper.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sceneprint.geometry.kernel import disjoint_kernel, kernel, prefetch
from sceneprint.geometry.signature.mixture import Mixture, moments
from sceneprint.geometry.signature.pair_features import (
    FEATURE_DIMENSION,
    LEADING,
    PairCounts,
    PairTable,
)
from sceneprint.types import Bytes, Floats, Floats32

#: Offset of a quantised component: 0 is stored in the middle of the byte.
ZERO = 128


@dataclass(frozen=True, eq=False)
class LevelStatistics:
    """The sums of Eq. (2) over all pairs of a level.

    Parameters
    ----------
    zeroth : (G,) sums of weight times posterior
    first, second : (G, 12) sums of weight times posterior times feature, or squared feature
    n_pairs : number of ordered pairs
    total : sum of the weights of all pairs; `n_pairs` if all weights are 1
    """

    zeroth: Floats
    first: Floats
    second: Floats
    n_pairs: int
    total: float


#: Number of table rows to prefetch in advance, to hide the memory latency.
_AHEAD = 16


@disjoint_kernel
def _accumulate(
    counts: Floats32, table: Floats32, components: NDArray[np.int16], sums: Floats
) -> None:
    """Add up `sums` (G, 32): 12 first, 12 second, 1 zeroth; the rest fills a cache line.

    `components` is the packed table viewed as int16. The rows of the bins that contain
    pairs, a quarter of all, are scattered over a table that exceeds all caches, so they are
    prefetched.
    """
    used, n = np.empty(len(counts), np.int32), 0
    for b in range(len(counts)):
        used[n] = b
        n += 1 if counts[b] != 0 else 0
    moments = np.empty(2 * FEATURE_DIMENSION)
    for m in range(n):
        prefetch(table, used[min(m + _AHEAD, n - 1)])
        bin_of: Any = np.uint64(used[m])
        for d in range(FEATURE_DIMENSION):
            moments[d] = table[bin_of, d]
            moments[FEATURE_DIMENSION + d] = moments[d] * moments[d]
        for k in range(LEADING):
            share = float(table[bin_of, FEATURE_DIMENSION + k])
            if share == 0.0:
                break
            weight = counts[bin_of] * share
            g: Any = np.uint64(components[bin_of, 2 * (FEATURE_DIMENSION + LEADING) + k])
            for d in range(2 * FEATURE_DIMENSION):
                sums[g, d] += weight * moments[d]
            sums[g, 2 * FEATURE_DIMENSION] += weight


def statistics_of_counts(
    counts: PairCounts, table: PairTable, n_components: int
) -> LevelStatistics:
    """Compute the statistics of a level from its pair counts; `n_components` is G."""
    d, sums = FEATURE_DIMENSION, np.zeros((n_components, 32))
    _accumulate(counts.weights, table.packed, table.packed.view(np.int16), sums)
    return LevelStatistics(
        sums[:, 2 * d], sums[:, :d], sums[:, d : 2 * d], counts.n_pairs, counts.total
    )


def statistics_of_features(features: Floats, weights: Floats, mixture: Mixture) -> LevelStatistics:
    """Compute the statistics of pairs from all posteriors, as an oracle for the table in tests.

    Parameters
    ----------
    features : (M, 12)
    weights : (M,) weights of the pairs
    mixture : G components
    """
    zeroth, first, second = moments(features, mixture, weights)
    return LevelStatistics(zeroth, first, second, len(features), float(weights.sum()))


def fisher_vector(s: LevelStatistics, mixture: Mixture) -> Floats:
    """Compute the Fisher vector phi of a level: Eq. (2), Sec. III-B.

    Parameters
    ----------
    s : statistics of at least one pair
    mixture : G components

    Returns
    -------
    phi : (25 G,) m0, m1 (12), m2 (12) of each component, before the square root and normalization

    Notes
    -----
    Readings R2-R4, R9 (docs/paper.md): true posteriors; the weighted mean over all pairs;
    d^2 / var - 1 in each dimension; 1/sqrt(p_g) and 1/sqrt(2 p_g) are the closed-form factors of
    the inverse Fisher information.
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


def normalise(phi: Floats) -> Floats:
    """Return the signed square root of phi (n,), normalised to unit l2 norm (after Eq. 2).

    A level without pairs results in zeros.
    """
    rooted = np.sign(phi) * np.sqrt(np.abs(phi))
    norm = float(np.sqrt(np.abs(phi).sum()))  # not by BLAS, whose sums depend on the threads
    result: Floats = rooted / norm if norm > 0 else rooted
    return result


def signature(levels: Sequence[Floats]) -> Floats:
    """Return psi (25 G H,): the normalised Fisher vectors (25 G,) of all levels, finest first."""
    return np.concatenate([normalise(phi) for phi in levels])


def quantise(psi: Floats, scale: float) -> Bytes:
    """Quantise each component of psi (n,) to a byte: round(psi / scale) + 128, clipped.

    `scale` is the model's step. L1 distances of quantised signatures times `scale` equal the
    distances of the signatures up to rounding.
    """
    result: Bytes = np.clip(np.rint(psi / scale) + ZERO, 0, 255).astype(np.uint8)
    return result


Ints8 = NDArray[np.int8]
Ints16 = NDArray[np.int16]
Ints32 = NDArray[np.int32]

#: Integer that represents 1 in psi. By the Cauchy-Schwarz inequality, the product with a row of the
#: basis fits into 32 bits for up to 16 levels of 25,000 components.
UNITS = 1 << 14
#: Root mean square of the stored components; few of them reach the limit of 127.
GAIN = 26.0


@dataclass(frozen=True)
class WhiteningParameters:
    """Parameters of the stored signature."""

    dimension: int = 448  #: d, number of bytes of a stored signature
    exponent: float = 1.0  #: exponent of the standard deviation in the divisor of an axis


@dataclass(frozen=True, eq=False)
class Whitening:
    """An affine map from psi to the stored signature, fitted once per model.

    The basis and psi are integers, so products are exact and independent of the summation order.

    Parameters
    ----------
    levels : (h,) ascending indices of the levels in psi; 0 is the finest level
    basis : (d, D) int8, axes of psi, by descending variance
    scales : (d,) float64, factors that whiten the products of the axes with psi
    offsets : (d,) float64, products of the axes with the mean psi
    unrelated_distance : d0, median squared distance between signatures of unrelated frames
    """

    levels: tuple[int, ...]
    basis: Ints8
    scales: Floats
    offsets: Floats
    unrelated_distance: float

    @property
    def dimension(self) -> int:
        """Return d, the number of bytes of a stored signature."""
        return len(self.basis)

    @property
    def gain(self) -> float:
        """Return the factor from the components of a unit vector to the stored components."""
        return GAIN * math.sqrt(self.dimension)


def psi_units(psi: Floats) -> Ints16:
    """Convert psi (..., D), with components in [-1, 1], to integers in steps of 1 / UNITS."""
    units: Ints16 = np.rint(np.asarray(psi) * UNITS).astype(np.int16)
    return units


@kernel
def _products(basis: Ints8, psi: Ints16, result: Ints32) -> None:
    """Write basis (d, D) @ psi (D,) to `result` (d,), exact in 32 bits."""
    for i in range(len(basis)):
        total = np.int32(0)
        for j in range(len(psi)):
            total += np.int32(basis[i, j]) * np.int32(psi[j])
        result[i] = total


def whiten(psi: Floats, whitening: Whitening) -> Bytes:
    """Compute the stored signature from psi.

    Parameters
    ----------
    psi : (D,) Fisher vectors of the levels in `whitening.levels`

    Returns
    -------
    (d,) uint8 : components of a unit vector, multiplied by the gain, rounded, clipped, plus 128

    Raises
    ------
    ValueError : If psi and the axes differ in length
    """
    if psi.shape != whitening.basis.shape[1:]:
        raise ValueError(
            f"psi has shape {psi.shape}, but the basis has shape {whitening.basis.shape}. "
            "Pass the levels of the whitening only."
        )
    products = np.empty(whitening.dimension, np.int32)
    _products(whitening.basis, psi_units(psi), products)
    z = whitening.scales * (products - whitening.offsets)
    length = float(np.sqrt((z * z).sum()))
    unit = z / length if length > 0 else z  # the length is 0 if psi equals the mean
    stored: Bytes = (np.clip(np.rint(whitening.gain * unit), -127, 127) + ZERO).astype(np.uint8)
    return stored


def fit_whitening(psi: Ints16, levels: tuple[int, ...], p: WhiteningParameters) -> Whitening:
    """Fit the principal axes of psi and their variances to training frames.

    The fit uses the Gram matrix of the frames: it is smaller than the covariance of the components.

    Parameters
    ----------
    psi : (n, D) results of `psi_units` for training frames
    levels : levels in psi

    Returns
    -------
    whitening : whitening with the placeholder 1 for `unrelated_distance`, which the caller must
        measure

    Raises
    ------
    ValueError : If the frames are fewer than the axes, or span fewer dimensions than the axes
    """
    n, d = len(psi), p.dimension
    if not 1 <= d < n:
        raise ValueError(f"{n} frames cannot determine {d} axes. Train on more frames.")
    mean = psi.mean(axis=0, dtype=np.float64)
    centred = psi - mean
    variances, vectors = np.linalg.eigh(centred @ centred.T / n)  # in ascending order
    variances, vectors = variances[::-1][:d], vectors.T[::-1][:d]
    if variances[-1] <= 1e-9 * variances[0]:
        raise ValueError(f"{n} frames span fewer than {d} axes. Train on more frames.")
    axes = (vectors @ centred) / np.sqrt(n * variances)[:, None]
    signs = np.sign(axes[np.arange(d), np.abs(axes).argmax(axis=1)])  # eigh leaves signs undefined
    axes *= signs[:, None]
    units = np.abs(axes).max(axis=1) / 127
    basis: Ints8 = np.rint(axes / units[:, None]).astype(np.int8)
    # single precision discards the last bits, which depend on the processor
    scales = (units * variances ** (-p.exponent / 2)).astype(np.float32).astype(np.float64)
    return Whitening(levels, basis, scales, basis @ mean, 1.0)
