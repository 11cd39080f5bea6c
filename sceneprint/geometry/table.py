"""The 4-D pair table: what a pair of patches contributes to Eq. (2), looked up.

Model  --part-->  PairTable (B bins: feature, leading posteriors)

A pair has only the four invariants of `properties.py`. Projection and posteriors are
evaluated once for each bin of a grid over these four, instead of once for each pair.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneprint.geometry.bins import TableLayout, bin_centres
from sceneprint.geometry.kernel import kernel
from sceneprint.geometry.mixture import Mixture
from sceneprint.geometry.projection import DIMENSION, Projection, project
from sceneprint.geometry.properties import PropertyParameters, properties
from sceneprint.types import Floats32

LEADING = 8  #: posteriors kept per bin
LEAST = 1e-3  #: and of these, those that are no smaller; what is kept sums to 1
#: Floats of one bin: feature, posteriors, and the components as pairs of int16.
WIDTH = DIMENSION + LEADING + LEADING // 2


@dataclass(frozen=True, eq=False)
class PairTable:
    """What every bin contributes, 96 bytes in one place each: two cache lines a look-up.

    Parameters
    ----------
    packed : (B, 24) float32, C-contiguous; its columns are the properties below
    """

    packed: Floats32

    @property
    def features(self) -> Floats32:
        """(B, 12) float32, f of the bin's centre."""
        return self.packed[:, :DIMENSION]

    @property
    def posteriors(self) -> Floats32:
        """(B, 8) float32, falling, of sum 1; 0 from the first below 1e-3 on."""
        return self.packed[:, DIMENSION : DIMENSION + LEADING]

    @property
    def components(self) -> NDArray[np.int16]:
        """(B, 8) int16, the mixture components whose posteriors these are."""
        return self.packed.view(np.int16)[:, 2 * (DIMENSION + LEADING) :]


def pack(features: Floats32, posteriors: Floats32, components: NDArray[np.int16]) -> PairTable:
    """A table from its three parts.

    Parameters
    ----------
    features : (B, 12)
    posteriors, components : (B, 8)
    """
    packed = np.empty((len(features), WIDTH), np.float32)
    table = PairTable(packed)
    table.features[:], table.posteriors[:], table.components[:] = features, posteriors, components
    return table


@kernel
def _leading(
    features: Floats32, constants: Floats32, means: Floats32, precisions: Floats32,
    components: NDArray[np.int16], posteriors: Floats32,
) -> None:  # fmt: skip
    """Keep the largest posteriors of each feature. means, precisions: (12, G)."""
    n, dimension = features.shape
    n_components, n_leading = len(constants), components.shape[1]
    logits = np.empty(n_components, np.float32)
    half = np.float32(0.5)
    for i in range(n):
        logits[:] = constants
        for d in range(dimension):
            x, mu, precision = features[i, d], means[d], precisions[d]
            for g in range(n_components):
                difference = x - mu[g]
                logits[g] -= half * precision[g] * difference * difference
        found = 0
        for g in range(n_components):
            value = logits[g]
            if found == n_leading and value <= logits[components[i, found - 1]]:
                continue
            at = found if found < n_leading else n_leading - 1
            while at > 0 and logits[components[i, at - 1]] < value:
                components[i, at] = components[i, at - 1]
                at -= 1
            components[i, at] = g
            found = min(found + 1, n_leading)
        highest, total = logits[components[i, 0]], np.float32(0.0)
        for k in range(found):
            posteriors[i, k] = np.exp(logits[components[i, k]] - highest)
            total += posteriors[i, k]
        kept = np.float32(0.0)
        for k in range(found):
            posteriors[i, k] /= total
            if posteriors[i, k] < np.float32(LEAST):
                posteriors[i, k] = np.float32(0.0)
            kept += posteriors[i, k]
        for k in range(found):
            posteriors[i, k] /= kept


def part(
    first: int, last: int,
    layout: TableLayout, p: PropertyParameters, projection: Projection, mixture: Mixture,
) -> PairTable:  # fmt: skip
    """Bins `first` to `last` - 1 of the table.

    Parameters
    ----------
    first, last : bins
    layout, p, projection, mixture : of the model
    """
    invariant = bin_centres(layout, first, last, p)
    features = project(properties(invariant, p), projection).astype(np.float32)
    constants = np.log(mixture.weights) - 0.5 * np.log(mixture.variances).sum(axis=1)
    components = np.zeros((last - first, LEADING), np.int16)
    posteriors = np.zeros((last - first, LEADING), np.float32)
    _leading(
        features, constants.astype(np.float32),
        np.ascontiguousarray(mixture.means.T, np.float32),
        np.ascontiguousarray(1.0 / mixture.variances.T, np.float32),
        components, posteriors,
    )  # fmt: skip
    return pack(features, posteriors, components)
