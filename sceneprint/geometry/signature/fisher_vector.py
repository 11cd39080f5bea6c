"""Sec. III-B, "Encoding feature space statistics": features to psi, and psi as stored.

PairCounts, PairTable   --statistics_of_counts-->   Statistics
features (M, 12)        --statistics_of_features--> Statistics   (exact, the oracle)
Statistics  --fisher_vector-->  phi (25 G)
H of them   --signature-->      psi (25 G H)   --quantise-->  uint8
psi (n, D)  --fit_whitening-->  Whitening          psi  --whiten-->  (d,) uint8

The stored signature is psi centred, turned to its widest axes, whitened, and cut to a few bytes. A
Fisher vector has few strong axes, which all rooms share, and many weak ones, which tell rooms
apart. Dividing each axis by its standard deviation lets the weak ones count. docs/model.md has
the measurements that chose the numbers, and docs/paper.md says where this departs from the paper.
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


#: Rows of the table between one that is asked for and that which is read: the memory's answer
#: takes as long as a few rows take to be added.
_AHEAD = 16


@disjoint_kernel
def _accumulate(
    counts: Floats32, table: Floats32, components: NDArray[np.int16], sums: Floats
) -> None:
    """sums (G, 32): first 12, second 12, zeroth in the 25th; the rest fills a cache line.

    table, components: the packed table, and the same memory as int16.

    A quarter of the bins hold pairs, and their rows lie all over the table, which no cache holds:
    so the bins are listed, and each row is asked for while those before it are added.
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
    """Statistics of pairs counted in the 4-D table.

    Parameters
    ----------
    counts : of one level
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


# The stored signature: psi whitened, and cut to a few bytes.

Ints8 = NDArray[np.int8]
Ints16 = NDArray[np.int16]
Ints32 = NDArray[np.int32]

#: Units of a component of psi, which lies in [-1, 1]. By Cauchy and Schwarz the product with a
#: row of the basis fits in 32 bits for up to 16 levels of 25,000 components.
UNITS = 1 << 14
#: Units of a stored component of root mean square size; 127, five times as many, few reach.
GAIN = 26.0


@dataclass(frozen=True)
class WhiteningParameters:
    """The numbers of the stored signature."""

    dimension: int = 448  #: d, bytes of a stored signature
    exponent: float = 1.0  #: of the standard deviation that an axis is divided by; 0: not at all


@dataclass(frozen=True, eq=False)
class Whitening:
    """An affine map from psi to the stored signature, learnt once for a model.

    Basis and psi are integers, so that their products are exact and a signature does not depend
    on the order in which a processor sums.

    Parameters
    ----------
    levels : (h,) of the hierarchy whose Fisher vectors psi consists of, rising, 0 the finest
    basis : (d, D) int8, axes of psi, the widest first
    scales : (d,) float64, of each axis: one unit of the product, whitened
    offsets : (d,) float64, of each axis: the product of the mean psi
    unrelated_distance : d0, the median squared distance of signatures of unrelated frames
    """

    levels: tuple[int, ...]
    basis: Ints8
    scales: Floats
    offsets: Floats
    unrelated_distance: float

    @property
    def dimension(self) -> int:
        """d, bytes of a stored signature."""
        return len(self.basis)

    @property
    def gain(self) -> float:
        """Units of a component of a unit vector."""
        return GAIN * math.sqrt(self.dimension)


def psi_units(psi: Floats) -> Ints16:
    """psi in whole units.

    Parameters
    ----------
    psi : (..., D), components in [-1, 1]
    """
    units: Ints16 = np.rint(np.asarray(psi) * UNITS).astype(np.int16)
    return units


@kernel
def _products(basis: Ints8, psi: Ints16, result: Ints32) -> None:
    """result (d,) = basis (d, D) @ psi (D,), exact in 32 bits."""
    for i in range(len(basis)):
        total = np.int32(0)
        for j in range(len(psi)):
            total += np.int32(basis[i, j]) * np.int32(psi[j])
        result[i] = total


def whiten(psi: Floats, whitening: Whitening) -> Bytes:
    """The stored signature of a frame.

    Parameters
    ----------
    psi : (D,) of the levels of the whitening

    Returns
    -------
    (d,) uint8 : components of a unit vector, times the gain, rounded and clipped, plus 128

    Raises
    ------
    ValueError : psi of another length.
    """
    if psi.shape != whitening.basis.shape[1:]:
        raise ValueError(f"psi {psi.shape}, where the basis is {whitening.basis.shape}")
    products = np.empty(whitening.dimension, np.int32)
    _products(whitening.basis, psi_units(psi), products)
    z = whitening.scales * (products - whitening.offsets)
    length = float(np.sqrt((z * z).sum()))
    unit = z / length if length > 0 else z  # psi is the mean: every direction is as good
    stored: Bytes = (np.clip(np.rint(whitening.gain * unit), -127, 127) + ZERO).astype(np.uint8)
    return stored


def fit_whitening(psi: Ints16, levels: tuple[int, ...], p: WhiteningParameters) -> Whitening:
    """Principal axes of psi and their spread, by the products of the frames among each other.

    There are fewer frames than components, so the small matrix of the frames has all the axes.

    Parameters
    ----------
    psi : (n, D) units of training frames; see `psi_units`
    levels : that psi consists of

    Returns
    -------
    whitening : whose unrelated distance is 1, until it is measured

    Raises
    ------
    ValueError : fewer frames than axes, or frames that span fewer.
    """
    n, d = len(psi), p.dimension
    if not 1 <= d < n:
        raise ValueError(f"{d} axes of {n} frames")
    mean = psi.mean(axis=0, dtype=np.float64)
    centred = psi - mean
    variances, vectors = np.linalg.eigh(centred @ centred.T / n)  # rising
    variances, vectors = variances[::-1][:d], vectors.T[::-1][:d]
    if variances[-1] <= 1e-9 * variances[0]:
        raise ValueError(f"{n} frames that span fewer than {d} axes")
    axes = (vectors @ centred) / np.sqrt(n * variances)[:, None]
    signs = np.sign(axes[np.arange(d), np.abs(axes).argmax(axis=1)])  # a fixed choice
    axes *= signs[:, None]
    units = np.abs(axes).max(axis=1) / 127
    basis: Ints8 = np.rint(axes / units[:, None]).astype(np.int8)
    # LAPACK differs between machines in the last bits of a double, which single precision drops
    scales = (units * variances ** (-p.exponent / 2)).astype(np.float32).astype(np.float64)
    return Whitening(levels, basis, scales, basis @ mean, 1.0)
