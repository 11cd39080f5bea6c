"""The stored signature: psi centred, turned to its widest axes, whitened, and cut to a few bytes.

psi (n, D)  --fit_whitening-->  Whitening          psi  --whiten-->  (d,) uint8

A Fisher vector has few strong axes, which all rooms share, and many weak ones, which tell rooms
apart. Dividing each axis by its standard deviation lets the weak ones count. docs/model.md has
the measurements that chose the numbers, and docs/paper.md says where this departs from the paper.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneprint.geometry.kernel import kernel
from sceneprint.geometry.signature.fisher_vector import ZERO
from sceneprint.types import Bytes, Floats

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
    whitening : of the model

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
    p : see WhiteningParameters

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
