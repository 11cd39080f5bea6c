"""The 13-D properties of patch pairs, and counts of pairs by bin (Sec. III-A).

    Patches (P), pairs (M, 2)  --invariants-->  (M, 4)  --properties-->  f' (M, 13)
    f' (M, 13)  --project-->  f (M, 12)
    layout, projection, mixture  --compute_bins-->  PairTable (B bins)
    Patches (P)  --count_pairs-->  PairCounts (B bins)

Symbols follow the paper: mu is the reference patch, alpha its neighbour, r the vector from mu to
alpha, <u, v, w> the Gram-Schmidt basis of (r, n_mu) with w = u x v.

A pair of oriented points has four invariants under rigid motion: the length of r, the angles of
both normals to r, and the dihedral angle between the normals about r. All thirteen properties are
functions of these invariants. Therefore, pairs are counted in the bins of a grid over the
invariants, and a table contains features and posteriors per bin.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from sceneprint.errors import TrainingError
from sceneprint.geometry.kernel import code_folder, disjoint_kernel, kernel
from sceneprint.geometry.signature.mixture import Mixture
from sceneprint.types import Floats, Floats32, Ints32, Patches

PROPERTY_DIMENSION = 13  #: length of f', Eq. (1)


@dataclass(frozen=True)
class PropertyParameters:
    """Parameters of Eq. (1)."""

    radius: float = 3.0  #: radius of a patch's neighbourhood, metres
    angular_tolerance: float = math.radians(10.0)  #: e_theta of the robust sign, rad
    colinearity: float = 0.9995  #: |n_mu . u| above which (r, n_mu) span no basis


def neighbour_pairs(patches: Patches, p: PropertyParameters) -> NDArray[np.int64]:
    """Return all ordered pairs of patches within `radius` that span a basis: N_mu of Sec. III-A.

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
    """Compute the four rigid invariants of each ordered pair.

    Parameters
    ----------
    patches : patches with means in metres and unit normals
    pairs : (M, 2) indices (mu, alpha) of patches for which r and n_mu are not parallel

    Returns
    -------
    (M, 4) : ||r|| in metres; angles of n_mu and of n_alpha to u, in [0, pi]; dihedral angle from
        n_mu to n_alpha about u, in [-pi, pi]
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
    # arctan2 has full precision near 0, where arccos loses half of the digits
    theta_mu = np.arctan2(_dot(n_mu, v), _dot(n_mu, u))
    theta_alpha = np.arctan2(np.hypot(a_v, a_w), _dot(n_alpha, u))
    return np.column_stack([d, theta_mu, theta_alpha, np.arctan2(a_w, a_v)])


def properties(invariant: Floats, p: PropertyParameters) -> Floats:
    """Compute the 13-D vectors f' of relative properties: Eq. (1), Sec. III-A.

    Parameters
    ----------
    invariant : (M, 4) result of `invariants`

    Returns
    -------
    f : (M, 13) in the order of Eq. (1): 0-2 angles in rad, [0, pi]; 4-6 cosines; 3 and 7-12 metres

    Notes
    -----
    Reading R1 (docs/paper.md): the printed interval of sgn_e is empty; here the sign is 0 within
    e_theta of a right angle, |cos| <= sin(e_theta).
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
    """Compute the properties (M, 13) of ordered patch pairs (M, 2): Eq. (1)."""
    return properties(invariants(patches, pairs), p)


def _dot(a: Floats, b: Floats) -> Floats:
    product: Floats = np.einsum("md,md->m", a, b)
    return product


FEATURE_DIMENSION = 12  #: d_F, length of f


@dataclass(frozen=True, eq=False)
class Projection:
    """The fitted subspace: f = matrix (f' - mean).

    Parameters
    ----------
    mean : (13,) float64
    matrix : (12, 13) float64
    """

    mean: Floats
    matrix: Floats


def project(properties: Floats, projection: Projection) -> Floats:
    """Project properties (M, 13) to features (M, 12) in the fitted subspace (Sec. III-A).

    Features have unit variance and are uncorrelated over the training pairs.
    """
    # einsum: the order of sums in BLAS depends on threads, but tables must be equal
    features: Floats = np.einsum("md,fd->mf", properties - projection.mean, projection.matrix)
    return features


def fit_projection(
    properties: Floats, method: Literal["pca", "ica"] = "pca", seed: int = 0
) -> Projection:
    """Fit the subspace to the properties of training pairs.

    Parameters
    ----------
    properties : (M, 13)
    method : "pca" whitens the standardised properties; "ica" also makes the components independent
        (FastICA, log cosh)
    seed : seed of FastICA's initial matrix

    Returns
    -------
    projection : projection whose largest weight in each row is positive, because neither method
        defines signs

    Raises
    ------
    TrainingError : If a property does not vary, or FastICA does not converge

    Notes
    -----
    Reading R7 (docs/paper.md): the paper specifies nonlinear ICA, but cites the linear EFICA.
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
                "The properties of the training pairs span fewer than twelve dimensions, so no "
                "subspace can be learnt. Train on more frames of furnished rooms."
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


@dataclass(frozen=True)
class TableLayout:
    """The grid over the four invariants of a pair.

    Angular bins are centred on right angles (dihedral bins also on 0 and 180 degrees), because
    these angles are frequent in buildings and must not fall on an edge. With 27 bins, the tolerance
    of 10 degrees in Eq. (1) falls on an edge, so the robust sign does not jump within a bin. The
    next finer grid with this property has three times as many bins.
    """

    distance_bins: int = 20
    angle_bins: int = 27  #: number of bins of an angle to r; odd, to centre one on 90 degrees
    dihedral_bins: int = 20  #: number of dihedral bins, a multiple of 4; offset by half a bin
    distance_exponent: float = 1.3  #: distance edges are radius * (i / bins)^exponent

    @property
    def n_bins(self) -> int:
        """Return B, the number of bins."""
        return self.distance_bins * self.angle_bins**2 * self.dihedral_bins


def bin_centres(layout: TableLayout, first: int, last: int, p: PropertyParameters) -> Floats:
    """Return the invariants (n, 4) at the centres of bins `first` to `last` - 1."""
    shape = (layout.distance_bins, layout.angle_bins, layout.angle_bins, layout.dihedral_bins)
    i, j, k, m = np.unravel_index(np.arange(first, last), shape)
    d = p.radius * ((i + 0.5) / layout.distance_bins) ** layout.distance_exponent
    theta = np.pi * (np.stack([j, k]) + 0.5) / layout.angle_bins
    phi = 2 * np.pi * m / layout.dihedral_bins
    return np.column_stack([d, theta[0], theta[1], np.where(phi > np.pi, phi - 2 * np.pi, phi)])


def _diamond(x: Floats, y: Floats) -> Floats:
    """Return the diamond angle in [0, 4): it increases with atan2(y, x), but is faster."""
    t = y / (np.abs(x) + np.abs(y))
    diamond: Floats = np.where(x < 0, 2.0 - t, np.where(y < 0, 4.0 + t, t))
    return diamond


def bin_edges(layout: TableLayout, p: PropertyParameters) -> tuple[Floats, Floats, Floats]:
    """Return the upper edges of the bins, in the coordinates of `count_pairs`.

    Returns
    -------
    distance : (distance_bins,) metres
    angle : (angle_bins,) negative cosines, ascending from -1; the last edge is infinite
    dihedral : (dihedral_bins + 1,) diamond angles in [0, 4]; the last interval joins the first bin
    """
    distance = p.radius * (np.arange(1, layout.distance_bins + 1) / layout.distance_bins) ** (
        layout.distance_exponent
    )
    angle = -np.cos(np.pi * np.arange(1, layout.angle_bins + 1) / layout.angle_bins)
    angle[-1] = np.inf  # a rounded cosine may exceed 1
    phi = 2 * np.pi * (np.arange(layout.dihedral_bins) + 0.5) / layout.dihedral_bins
    dihedral = np.append(_diamond(np.cos(phi), np.sin(phi)), 4.0)
    return distance, angle, dihedral


def search_starts(edges: Floats, origin: float, extent: float, n: int = 4096) -> Ints32:
    """Return the first bin whose upper edge exceeds the start of each of `n` equal cells, (n,).

    Parameters
    ----------
    edges : (m,) upper edges of the bins
    origin, extent : start and length of the range that the cells divide
    n : number of cells; cells must be narrower than every bin

    Raises
    ------
    ValueError : If a bin is narrower than a cell
    """
    if n * np.diff(edges, prepend=origin).min() <= extent:
        raise ValueError("Bins are narrower than the cells of the search. Use fewer bins.")
    starts = origin + extent * np.arange(n) / n
    return np.minimum(np.searchsorted(edges, starts, side="right"), len(edges) - 1).astype(np.int32)


LEADING = 8  #: number of posteriors per bin, with sum 1
LEAST_POSTERIOR = 1e-3  #: smaller posteriors become 0
#: Number of floats per bin: feature, posteriors, and components as pairs of int16.
WIDTH = FEATURE_DIMENSION + LEADING + LEADING // 2


@dataclass(frozen=True, eq=False)
class PairTable:
    """The contribution of a pair in each bin to Eq. (2); 96 bytes per bin, within two cache lines.

    Parameters
    ----------
    packed : (B, 24) float32, C-contiguous; columns of features, posteriors and components
    """

    packed: Floats32

    @property
    def features(self) -> Floats32:
        """Return the features f at the centres of the bins, (B, 12) float32."""
        return self.packed[:, :FEATURE_DIMENSION]

    @property
    def posteriors(self) -> Floats32:
        """Return the largest posteriors, (B, 8) float32, in descending order, with sum 1."""
        return self.packed[:, FEATURE_DIMENSION : FEATURE_DIMENSION + LEADING]

    @property
    def components(self) -> NDArray[np.int16]:
        """Return the mixture components of the posteriors, (B, 8) int16."""
        return self.packed.view(np.int16)[:, 2 * (FEATURE_DIMENSION + LEADING) :]


def pack_table(
    features: Floats32, posteriors: Floats32, components: NDArray[np.int16]
) -> PairTable:
    """Pack features (B, 12), posteriors (B, 8) and components (B, 8) into a table."""
    packed = np.empty((len(features), WIDTH), np.float32)
    table = PairTable(packed)
    table.features[:], table.posteriors[:], table.components[:] = features, posteriors, components
    return table


@kernel
def _select_leading(
    features: Floats32, constants: Floats32, means: Floats32, precisions: Floats32,
    components: NDArray[np.int16], posteriors: Floats32,
) -> None:  # fmt: skip
    """Write each feature's largest posteriors and their components; `means` is (12, G)."""
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
        count = 0
        for g in range(n_components):
            value = logits[g]
            if count == n_leading and value <= logits[components[i, count - 1]]:
                continue
            at = count if count < n_leading else n_leading - 1
            while at > 0 and logits[components[i, at - 1]] < value:
                components[i, at] = components[i, at - 1]
                at -= 1
            components[i, at] = g
            count = min(count + 1, n_leading)
        highest, total = logits[components[i, 0]], np.float32(0.0)
        for k in range(count):
            posteriors[i, k] = np.exp(logits[components[i, k]] - highest)
            total += posteriors[i, k]
        new_total = np.float32(0.0)
        for k in range(count):
            posteriors[i, k] /= total
            if posteriors[i, k] < np.float32(LEAST_POSTERIOR):
                posteriors[i, k] = np.float32(0.0)
            new_total += posteriors[i, k]
        for k in range(count):
            posteriors[i, k] /= new_total


def compute_bins(
    first: int, last: int,
    layout: TableLayout, p: PropertyParameters, projection: Projection, mixture: Mixture,
) -> PairTable:  # fmt: skip
    """Compute bins `first` to `last` - 1 of the table."""
    invariant = bin_centres(layout, first, last, p)
    features = project(properties(invariant, p), projection).astype(np.float32)
    constants = np.log(mixture.weights) - 0.5 * np.log(mixture.variances).sum(axis=1)
    components = np.zeros((last - first, LEADING), np.int16)
    posteriors = np.zeros((last - first, LEADING), np.float32)
    _select_leading(
        features, constants.astype(np.float32),
        np.ascontiguousarray(mixture.means.T, np.float32),
        np.ascontiguousarray(1.0 / mixture.variances.T, np.float32),
        components, posteriors,
    )  # fmt: skip
    return pack_table(features, posteriors, components)


# The kernels count all ordered pairs: a sample of pairs would change signatures (docs/paper.md,
# R11). Their inner loops run over all later patches, so that the compiler can vectorize them.


@disjoint_kernel
def _invariants(
    points: Floats, normals: Floats, i: int, d: Floats, i_u: Floats, j_u: Floats, turn: Floats
) -> None:
    """Write the distance, n_i . u, n_j . u and dihedral angle of patch i with each later patch j.

    u points from i to j. The dihedral angle from n_i to n_j about u is a diamond angle.
    """
    x, y, z, nx, ny, nz = points[0], points[1], points[2], normals[0], normals[1], normals[2]
    ix, iy, iz, ax, ay, az = x[i], y[i], z[i], nx[i], ny[i], nz[i]
    for j in range(i + 1, len(d)):
        rx, ry, rz = x[j] - ix, y[j] - iy, z[j] - iz
        length = np.sqrt(rx * rx + ry * ry + rz * rz)
        inverse = 1.0 / (length + 1e-300)  # pairs with a distance of 0 are excluded later
        along_i = (rx * ax + ry * ay + rz * az) * inverse
        along_j = (rx * nx[j] + ry * ny[j] + rz * nz[j]) * inverse
        cx, cy, cz = ry * az - rz * ay, rz * ax - rx * az, rx * ay - ry * ax
        sine = (cx * nx[j] + cy * ny[j] + cz * nz[j]) * inverse
        cosine = ax * nx[j] + ay * ny[j] + az * nz[j] - along_i * along_j
        t = sine / (abs(cosine) + abs(sine) + 1e-300)
        right = 4.0 + t if sine < 0.0 else t
        turn[j] = 2.0 - t if cosine < 0.0 else right
        d[j], i_u[j], j_u[j] = length, along_i, along_j


@disjoint_kernel
def _bin(value: float, edges: Floats, hints: Ints32, origin: float, per_unit: float) -> int:
    """Return the index of the first edge above a value; see `search_starts` for `hints`."""
    cell = min(max((value - origin) * per_unit, 0.0), len(hints) - 1.0)
    b = hints[np.uint64(np.int32(cell))]
    index: int = b + 1 if value >= edges[np.uint64(b)] else b
    return index


@disjoint_kernel
def _pair_bins(
    d: Floats, i_u: Floats, j_u: Floats, turn: Floats, i: int, radius: float, colinearity: float,
    distance: Floats, angle: Floats, dihedral: Floats, of_distance: Ints32, of_angle: Ints32,
    of_dihedral: Ints32, n_angles: int, n_dihedrals: int, there: Ints32, back: Ints32,
) -> None:  # fmt: skip
    """Write the bins of the pairs (i, j) and (j, i); -1 for uncounted pairs."""
    per_metre, per_cosine = len(of_distance) / radius, len(of_angle) / 2.0
    per_turn = len(of_dihedral) / 4.0
    for j in range(i + 1, len(d)):
        row = _bin(d[j], distance, of_distance, 0.0, per_metre)
        mu = _bin(-i_u[j], angle, of_angle, -1.0, per_cosine)
        alpha = _bin(-j_u[j], angle, of_angle, -1.0, per_cosine)
        phi = _bin(turn[j], dihedral, of_dihedral, 0.0, per_turn)
        last = phi if phi < n_dihedrals else 0
        near = (d[j] < radius) & (d[j] > 0.0)
        # (i, j): angles of n_i and n_j to u
        bin_ij = ((row * n_angles + mu) * n_angles + alpha) * n_dihedrals + last
        there[j] = np.int32(bin_ij if near & (abs(i_u[j]) <= colinearity) else -1)
        # (j, i): u is reversed, the normals are swapped
        mu, alpha = n_angles - 1 - alpha, n_angles - 1 - mu
        bin_ji = ((row * n_angles + mu) * n_angles + alpha) * n_dihedrals + last
        back[j] = np.int32(bin_ji if near & (abs(j_u[j]) <= colinearity) else -1)


@disjoint_kernel
def _add(
    there: Ints32, back: Ints32, i: int, weights: Floats32, counts: Floats32, total: float
) -> tuple[int, float]:
    """Add pair weights to `counts`; return the number of pairs, and `total` plus their weights."""
    count, own = 0, weights[i]
    for j in range(i + 1, len(there)):
        weight = own * weights[j]
        if there[j] >= 0:
            counts[np.uint64(there[j])] += weight
            total += weight
            count += 1
        if back[j] >= 0:
            counts[np.uint64(back[j])] += weight
            total += weight
            count += 1
    return count, total


@kernel
def _count(
    points: Floats, normals: Floats, radius: float, colinearity: float,
    distance: Floats, angle: Floats, dihedral: Floats,
    hints: Ints32, n_angles: int, n_dihedrals: int, weights: Floats32, counts: Floats32,
) -> tuple[int, float]:  # fmt: skip
    """Add the weights of both orders of all pairs; return the number and total weight of pairs."""
    n = points.shape[1]
    d, i_u, j_u, turn = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    there, back = np.empty(n, np.int32), np.empty(n, np.int32)
    n_pairs, total = 0, 0.0
    for i in range(n):
        _invariants(points, normals, i, d, i_u, j_u, turn)
        _pair_bins(
            d, i_u, j_u, turn, i, radius, colinearity, distance, angle, dihedral,
            hints[0], hints[1], hints[2], n_angles, n_dihedrals, there, back,
        )  # fmt: skip
        count, total = _add(there, back, i, weights, counts, total)
        n_pairs += count
    return n_pairs, total


@dataclass(frozen=True, eq=False)
class PairCounts:
    """The ordered pairs of a level, counted by bin.

    Parameters
    ----------
    weights : (B,) float32, sum of the weights of the pairs in each bin
    n_pairs : total number of pairs
    total : sum of the weights of all pairs
    """

    weights: Floats32
    n_pairs: int
    total: float


@lru_cache(maxsize=8)
def _look_up(layout: TableLayout, p: PropertyParameters) -> tuple[Floats, Floats, Floats, Ints32]:
    """Return the edges from `bin_edges` and their search starts (3, n), read-only."""
    distance, angle, dihedral = bin_edges(layout, p)
    starts = np.stack(
        [
            search_starts(distance, 0.0, p.radius),
            search_starts(angle, -1.0, 2.0),
            search_starts(dihedral, 0.0, 4.0),
        ]
    )
    for shared in (distance, angle, dihedral, starts):
        shared.flags.writeable = False
    return distance, angle, dihedral, starts


def count_pairs(
    means: Floats, normals: Floats, weights: Floats, layout: TableLayout, p: PropertyParameters
) -> PairCounts:
    """Count all ordered pairs of patches by bin, weighted by the product of the patches' weights.

    Parameters
    ----------
    means, normals : (P, 3) float64, metres and unit vectors
    weights : (P,) weights of the patches
    """
    distance, angle, dihedral, starts = _look_up(layout, p)
    counts = np.zeros(layout.n_bins, np.float32)
    n_pairs, total = _count(
        np.ascontiguousarray(means.T), np.ascontiguousarray(normals.T),
        p.radius, p.colinearity, distance, angle, dihedral,
        starts, layout.angle_bins, layout.dihedral_bins, weights.astype(np.float32), counts,
    )  # fmt: skip
    return PairCounts(counts, n_pairs, total)


def machine_code_folder() -> tuple[str, bool]:
    """Return the folder of the pair kernel's machine code, and whether it has valid code."""
    return code_folder(_count)
