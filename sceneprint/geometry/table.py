"""The 4-D pair table: what a pair of patches contributes to Eq. (2), looked up.

    Patches (P)  --count_pairs-->  counts (B,)
    Model        --fill-->         PairTable (B bins: feature, leading posteriors)

All ordered pairs are used: a sample of them would make the signature of one frame differ
from itself (docs/paper.md, R11). That is affordable because a pair has only the four
invariants of `properties.py`: pairs are counted in a grid over these four, and projection
and posteriors are evaluated once per bin instead of once per pair.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sceneprint.geometry.kernel import cached_at, kernel
from sceneprint.geometry.mixture import Mixture
from sceneprint.geometry.projection import Projection, project
from sceneprint.geometry.properties import PropertyParameters, properties
from sceneprint.types import Floats, Floats32, Ints32

LEADING = 8  #: posteriors kept per bin; the rest of a bin's mass is below 1e-3


@dataclass(frozen=True)
class TableLayout:
    """The grid over the four invariants of a pair.

    The angular bins are centred on 0, 90 and 180 degrees: buildings are full of right
    angles, and a right angle must not fall on the edge between two bins.
    """

    distance_bins: int = 36
    angle_bins: int = 25  #: of each normal's angle to r; odd, so that one is centred on 90
    dihedral_bins: int = 36  #: a multiple of 4, offset by half a bin
    distance_exponent: float = 1.3  #: distance edges are radius * (i / bins)^exponent

    @property
    def n_bins(self) -> int:
        """B, the number of bins."""
        return self.distance_bins * self.angle_bins**2 * self.dihedral_bins


@dataclass(frozen=True, eq=False)
class PairTable:
    """What every bin contributes.

    Parameters
    ----------
    features : (B, 12) float32, f of the bin's centre
    components : (B, 8) int16, mixture components by falling posterior
    posteriors : (B, 8) float32, of sum 1
    """

    features: Floats32
    components: NDArray[np.int16]
    posteriors: Floats32


def bin_centres(layout: TableLayout, first: int, last: int, p: PropertyParameters) -> Floats:
    """The four invariants at the centres of bins `first` to `last` - 1.

    Returns
    -------
    (last - first, 4) : as `properties.invariants`: metres, rad
    """
    shape = (layout.distance_bins, layout.angle_bins, layout.angle_bins, layout.dihedral_bins)
    i, j, k, m = np.unravel_index(np.arange(first, last), shape)
    d = p.radius * ((i + 0.5) / layout.distance_bins) ** layout.distance_exponent
    theta = np.pi * (np.stack([j, k]) + 0.5) / layout.angle_bins
    phi = 2 * np.pi * m / layout.dihedral_bins
    return np.column_stack([d, theta[0], theta[1], np.where(phi > np.pi, phi - 2 * np.pi, phi)])


def _diamond(x: Floats, y: Floats) -> Floats:
    """Monotone stand-in for the angle atan2(y, x), in [0, 4): a division, no arctangent."""
    t = y / (np.abs(x) + np.abs(y))
    diamond: Floats = np.where(x < 0, 2.0 - t, np.where(y < 0, 4.0 + t, t))
    return diamond


def bin_edges(layout: TableLayout, p: PropertyParameters) -> tuple[Floats, Floats, Floats]:
    """Upper edges of the bins, in the coordinates in which `count_pairs` looks them up.

    Returns
    -------
    distance : (distance_bins,) metres
    angle : (angle_bins,) minus the cosine of the angle, rising from -1 to 1
    dihedral : (dihedral_bins + 1,) diamond angle in [0, 4]; the last bin is the first's half
    """
    distance = p.radius * (np.arange(1, layout.distance_bins + 1) / layout.distance_bins) ** (
        layout.distance_exponent
    )
    angle = -np.cos(np.pi * np.arange(1, layout.angle_bins + 1) / layout.angle_bins)
    phi = 2 * np.pi * (np.arange(layout.dihedral_bins) + 0.5) / layout.dihedral_bins
    dihedral = np.append(_diamond(np.cos(phi), np.sin(phi)), 4.0)
    return distance, angle, dihedral


@kernel
def _find(value: float, edges: Floats, hint: Ints32, origin: float, per_unit: float) -> int:
    """Index of the first edge above `value`: a uniform grid of hints, then a short walk."""
    cell = int((value - origin) * per_unit)
    cell = min(max(cell, 0), len(hint) - 1)
    b = int(hint[cell])
    while b < len(edges) - 1 and value >= edges[b]:
        b += 1
    return b


@kernel
def _count(
    means: Floats, normals: Floats, radius: float, colinearity: float,
    distance: Floats, angle: Floats, dihedral: Floats,
    hints: Ints32, n_angles: int, n_dihedrals: int, counts: Ints32,
) -> int:  # fmt: skip
    """Count both orders of every pair; returns the number of ordered pairs."""
    n = len(means)
    total = 0
    n_hints = hints.shape[1]
    per_metre, per_cosine, per_turn = n_hints / radius, n_hints / 2.0, n_hints / 4.0
    for i in range(n):
        for j in range(i + 1, n):
            rx, ry, rz = (
                means[j, 0] - means[i, 0], means[j, 1] - means[i, 1], means[j, 2] - means[i, 2]
            )  # fmt: skip
            d = np.sqrt(rx * rx + ry * ry + rz * rz)
            if d <= 0.0 or d >= radius:
                continue
            ux, uy, uz = rx / d, ry / d, rz / d
            ix, iy, iz = normals[i, 0], normals[i, 1], normals[i, 2]
            jx, jy, jz = normals[j, 0], normals[j, 1], normals[j, 2]
            i_u = ix * ux + iy * uy + iz * uz
            j_u = jx * ux + jy * uy + jz * uz
            spans_i, spans_j = abs(i_u) <= colinearity, abs(j_u) <= colinearity
            if not (spans_i or spans_j):
                continue
            # dihedral angle about u, from n_i to n_j; the same from n_j to n_i about -u
            x = ix * jx + iy * jy + iz * jz - i_u * j_u
            y = ux * (iy * jz - iz * jy) + uy * (iz * jx - ix * jz) + uz * (ix * jy - iy * jx)
            span = abs(x) + abs(y)
            turn = 0.0
            if span > 1e-300:
                turn = y / span
                if x < 0.0:
                    turn = 2.0 - turn
                elif y < 0.0:
                    turn = 4.0 + turn
            b_d = _find(d, distance, hints[0], 0.0, per_metre)
            b_phi = _find(turn, dihedral, hints[2], 0.0, per_turn) % n_dihedrals
            if spans_i:  # (i, j): angles of n_i and n_j to u
                b_mu = _find(-i_u, angle, hints[1], -1.0, per_cosine)
                b_alpha = _find(-j_u, angle, hints[1], -1.0, per_cosine)
                counts[((b_d * n_angles + b_mu) * n_angles + b_alpha) * n_dihedrals + b_phi] += 1
                total += 1
            if spans_j:  # (j, i): u turns round, and the normals change places
                b_mu = _find(j_u, angle, hints[1], -1.0, per_cosine)
                b_alpha = _find(i_u, angle, hints[1], -1.0, per_cosine)
                counts[((b_d * n_angles + b_mu) * n_angles + b_alpha) * n_dihedrals + b_phi] += 1
                total += 1
    return total


def _hints(edges: Floats, origin: float, extent: float, n: int = 4096) -> Ints32:
    starts = origin + extent * np.arange(n) / n
    return np.minimum(np.searchsorted(edges, starts, side="right"), len(edges) - 1).astype(np.int32)


def count_pairs(
    means: Floats, normals: Floats, layout: TableLayout, p: PropertyParameters
) -> tuple[Ints32, int]:
    """Count all ordered pairs of patches by bin.

    Parameters
    ----------
    means, normals : (P, 3) float64, metres and unit length
    layout, p : of the model

    Returns
    -------
    counts : (B,) int32
    n_pairs : their sum
    """
    distance, angle, dihedral = bin_edges(layout, p)
    hints = np.stack(
        [_hints(distance, 0.0, p.radius), _hints(angle, -1.0, 2.0), _hints(dihedral, 0.0, 4.0)]
    )
    counts = np.zeros(layout.n_bins, np.int32)
    n_pairs = _count(
        means, normals, p.radius, p.colinearity, distance, angle, dihedral,
        hints, layout.angle_bins, layout.dihedral_bins, counts,
    )  # fmt: skip
    return counts, n_pairs


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
        for k in range(found):
            posteriors[i, k] /= total


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
    return PairTable(features, components, posteriors)


def compiled_at() -> tuple[str, str]:
    """Folder and name pattern of a file that is there once this code has been compiled."""
    return cached_at(_count)
