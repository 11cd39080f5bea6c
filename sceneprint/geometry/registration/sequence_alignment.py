"""Patch correspondences by alignment of neighbour sequences, as in the paper (Sec. III-E).

    Patches  --neighbour_sequences-->  Sequences
    Patches, Patches  --sequence_correspondences-->  pairs (M, 2)

Reading R10 (docs/paper.md): only the idea of the paper's patch matching (GASP, 3DV 2014) is public.
The descriptor of a patch is the sequence of the patches around it, sorted by azimuth about its
normal; it does not depend on the viewpoint. These cyclic sequences are compared by their
Damerau-Levenshtein distance: the minimum cost of replacing, inserting, omitting and swapping
neighbours. "It suffices to validate at a coarse hierarchical level" (Sec. III-F): the neighbours
are coarse patches.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from sceneprint.geometry.kernel import kernel
from sceneprint.types import Floats, Ints32, Patches

#: Method of matching: by the histograms of `patch_descriptors.py`, or by sequences.
Matching = Literal["histograms", "sequence"]


@dataclass(frozen=True)
class SequenceParameters:
    """Parameters of sequences and of their alignment."""

    n_coarse: int = 60  #: number of coarse patches
    opposite_distance: float = 0.5  #: distance that opposite normals add between seeds, metres
    n_neighbours: int = 12  #: number of nearest neighbours of a patch
    minimum_distance: float = 0.1  #: minimum distance of a neighbour, metres
    radius: float = 1.6  #: maximum distance of a neighbour, metres
    length_scale: float = 0.35  #: difference in length that costs one half, metres
    angle_scale: float = 1.0  #: difference in angle that costs one half, radians
    gap_cost: float = 0.5  #: cost of an inserted or omitted neighbour; a replacement costs 1
    swap_cost: float = 0.1  #: cost of a swap, in addition to the costs of the differences
    n_sources: int = 100  #: number of sampled patches of the source
    n_nearest: int = 3  #: number of correspondences per patch


@dataclass(frozen=True, eq=False)
class Sequences:
    """The neighbours of each patch, sorted by azimuth about its normal.

    Parameters
    ----------
    symbols : (P, n_neighbours, 4): distance of each neighbour in the plane of the patch and height
        over the plane, metres; angles of its normal to the patch's normal and to the direction of
        the neighbour, radians
    lengths : (P,) int32, number of neighbours
    """

    symbols: Floats
    lengths: Ints32


def coarse_patches(patches: Patches, p: SequenceParameters) -> Patches:
    """Combine patches into up to `n_coarse` patches, the means of the patches around distant seeds.

    The largest patch is the first seed, and each further seed is the patch farthest from all
    previous seeds, so the selection does not depend on rigid motion.
    """
    chosen = [int(np.argmax(patches.areas))]
    squares = np.full(len(patches), np.inf)
    nearest = np.zeros(len(patches), np.intp)
    while True:
        gap = ((patches.means - patches.means[chosen[-1]]) ** 2).sum(axis=1)
        opposition = 1.0 - patches.normals @ patches.normals[chosen[-1]]
        gap = gap + p.opposite_distance**2 / 2 * opposition
        closer = gap < squares
        squares[closer], nearest[closer] = gap[closer], len(chosen) - 1
        if len(chosen) == min(p.n_coarse, len(patches)):
            break
        chosen.append(int(np.argmax(squares)))
    count = len(chosen)
    areas: Floats = np.bincount(nearest, patches.areas, count).astype(float)
    means, normals = (
        np.stack([np.bincount(nearest, patches.areas * x[:, k], count) for k in range(3)], axis=1)
        for x in (patches.means, patches.normals)
    )
    length = np.linalg.norm(normals, axis=1)
    return Patches(
        means / areas[:, None],
        normals / np.maximum(length, 1e-12)[:, None],
        areas,
        np.bincount(nearest, patches.sizes, count).astype(np.int32),
        np.clip(length / areas, 1e-12, 1.0),
    )


@kernel
def _write_sequences(
    means: Floats, normals: Floats, others: Floats, other_normals: Floats,
    most: int, minimum: float, radius: float, symbols: Floats, lengths: Ints32,
) -> None:  # fmt: skip
    count = len(others)
    squares, azimuths = np.empty(count), np.empty(most)
    neighbours = np.empty((most, 4))
    for i in range(len(means)):
        n = normals[i]
        # any direction in the plane can be azimuth 0, because the start is selected later
        k = 0
        for d in range(1, 3):
            if abs(n[d]) < abs(n[k]):
                k = d
        e = np.zeros(3)
        e[k] = 1.0
        ux, uy, uz = e[0] - n[k] * n[0], e[1] - n[k] * n[1], e[2] - n[k] * n[2]
        length = np.sqrt(ux * ux + uy * uy + uz * uz)
        ux, uy, uz = ux / length, uy / length, uz / length
        vx, vy, vz = n[1] * uz - n[2] * uy, n[2] * ux - n[0] * uz, n[0] * uy - n[1] * ux
        for j in range(count):
            dx, dy, dz = (
                others[j, 0] - means[i, 0], others[j, 1] - means[i, 1], others[j, 2] - means[i, 2]
            )  # fmt: skip
            square = dx * dx + dy * dy + dz * dz
            near = square < minimum * minimum
            squares[j] = np.inf if near or square > radius * radius else square
        m = 0
        while m < most:
            j = int(np.argmin(squares))
            if squares[j] == np.inf:
                break
            squares[j] = np.inf
            dx, dy, dz = (
                others[j, 0] - means[i, 0], others[j, 1] - means[i, 1], others[j, 2] - means[i, 2]
            )  # fmt: skip
            height = dx * n[0] + dy * n[1] + dz * n[2]
            a, b = dx * ux + dy * uy + dz * uz, dx * vx + dy * vy + dz * vz
            o = other_normals[j]
            cosine = o[0] * n[0] + o[1] * n[1] + o[2] * n[2]
            whole = np.sqrt(dx * dx + dy * dy + dz * dz)
            along = (o[0] * dx + o[1] * dy + o[2] * dz) / whole
            neighbours[m, 0] = np.sqrt(a * a + b * b)
            neighbours[m, 1] = height
            neighbours[m, 2] = np.arccos(min(max(cosine, -1.0), 1.0))
            neighbours[m, 3] = np.arccos(min(max(along, -1.0), 1.0))
            azimuths[m] = np.arctan2(b, a)
            m += 1
        lengths[i] = m
        order = np.argsort(azimuths[:m], kind="mergesort")
        # neighbours across the widest gap are least likely to be swapped
        start, widest = 0, -1.0
        for s in range(m):
            before = azimuths[order[s - 1]] - (2 * np.pi if s == 0 else 0.0)
            if azimuths[order[s]] - before > widest:
                start, widest = s, azimuths[order[s]] - before
        for s in range(m):
            symbols[i, s] = neighbours[order[(start + s) % m]]


def neighbour_sequences(patches: Patches, about: Patches, p: SequenceParameters) -> Sequences:
    """Compute the canonical sequence of each patch's nearest neighbours.

    Neighbours are in counter-clockwise order, as seen from the side of the normal. The sequence
    starts after the widest gap.

    Parameters
    ----------
    patches : P patches
    about : potential neighbours: the result of `coarse_patches`
    """
    symbols = np.zeros((len(patches), p.n_neighbours, 4))
    lengths = np.zeros(len(patches), np.int32)
    _write_sequences(
        patches.means, patches.normals, about.means, about.normals,
        p.n_neighbours, p.minimum_distance, p.radius, symbols, lengths,
    )  # fmt: skip
    return Sequences(symbols, lengths)


@kernel
def _replacement_costs(
    a: Floats, m: int, b: Floats, n: int, length: float, angle: float, out: Floats
) -> None:
    """Write the costs, in [0, 1], of replacing each of m neighbours by each of n neighbours."""
    for i in range(m):
        for j in range(n):
            off = (abs(a[i, 0] - b[j, 0]) + abs(a[i, 1] - b[j, 1])) / length
            off += (abs(a[i, 2] - b[j, 2]) + abs(a[i, 3] - b[j, 3])) / angle
            out[i, j] = min(0.5 * off, 1.0)


@kernel
def _edit_cost(
    costs: Floats, m: int, n: int, turn: int, gap: float, swap: float, most: float, rows: Floats
) -> float:
    """Return the Damerau-Levenshtein cost between sequence 1 and sequence 2, started at `turn`.

    In this variant (optimal string alignment), a swapped pair is not edited again. The result is
    infinite if the cost is certain to exceed `most`. `rows` (3, n + 1) is scratch space.
    """
    for j in range(n + 1):
        rows[0, j] = j * gap
    least_before = 0.0
    for i in range(1, m + 1):
        now, last, earlier = rows[i % 3], rows[(i - 1) % 3], rows[(i - 2) % 3]
        now[0] = i * gap
        least = now[0]
        for j in range(1, n + 1):
            at = (j - 1 + turn) % n
            cost = last[j - 1] + costs[i - 1, at]
            cost = min(cost, min(last[j], now[j - 1]) + gap)
            if i > 1 and j > 1:
                before = (j - 2 + turn) % n
                both = costs[i - 1, before] + costs[i - 2, at]
                cost = min(cost, earlier[j - 2] + both + swap)
            now[j] = cost
            least = min(least, cost)
        if least > most and least_before > most:  # a swap uses the cost from two rows before
            return np.inf
        least_before = least
    result: float = rows[m % 3, n]
    return result


@kernel
def _cyclic_cost(
    a: Floats, m: int, b: Floats, n: int, length: float, angle: float, gap: float, swap: float,
    most: float, costs: Floats, rows: Floats,
) -> float:  # fmt: skip
    """Return the minimum cost over all starts of sequence 2, as a share of the maximum cost."""
    if m == 0 or n == 0:
        return 1.0
    _replacement_costs(a, m, b, n, length, angle, costs)
    # a fast lower bound excludes most pairs: the cost of replacing or omitting each neighbour
    bound = 0.0
    for i in range(m):
        nearest = gap
        for j in range(n):
            nearest = min(nearest, costs[i, j])
        bound += nearest
    whole = (m + n) * gap
    if bound / whole > most:
        return 1.0
    limit = best = most * whole
    for turn in range(n):
        cost = _edit_cost(costs, m, n, turn, gap, swap, best, rows)
        best = min(best, cost)
    # without this test, rounding could make an equal cost smaller than `most` and replace it
    return best / whole if best < limit else 1.0


@kernel
def _match_nearest(
    source: Floats, source_lengths: Ints32, target: Floats, target_lengths: Ints32, drawn: Ints32,
    n_nearest: int, length: float, angle: float, gap: float, swap: float, pairs: Ints32,
) -> int:  # fmt: skip
    most = source.shape[1]
    costs, rows = np.empty((most, most)), np.empty((3, most + 1))
    best, at = np.empty(n_nearest), np.empty(n_nearest, np.int32)
    count = 0
    for row in range(len(drawn)):
        i = drawn[row]
        best[:] = 1.0  # sequences that have nothing in common do not correspond
        at[:] = -1
        for j in range(len(target)):
            cost = _cyclic_cost(
                source[i], source_lengths[i], target[j], target_lengths[j],
                length, angle, gap, swap, best[-1], costs, rows,
            )  # fmt: skip
            if cost < best[-1]:
                k = n_nearest - 1
                while k > 0 and best[k - 1] > cost:
                    best[k], at[k] = best[k - 1], at[k - 1]
                    k -= 1
                best[k], at[k] = cost, j
        for k in range(n_nearest):
            if at[k] >= 0:
                pairs[count, 0], pairs[count, 1] = i, at[k]
                count += 1
    return count


def sequence_correspondences(
    source: Patches, target: Patches, rng: np.random.Generator, p: SequenceParameters
) -> Ints32:
    """Match a random sample of the source's patches by neighbour sequences: Sec. III-E.

    Parameters
    ----------
    source, target : patches of the two frames
    rng : random generator for the sample

    Returns
    -------
    (M, 2) int32 correspondences, indices in source and in target; nearest first for each patch
    """
    drawn = np.sort(rng.choice(len(source), min(p.n_sources, len(source)), replace=False))
    of_source = neighbour_sequences(source, coarse_patches(source, p), p)
    of_target = neighbour_sequences(target, coarse_patches(target, p), p)
    n_nearest = min(p.n_nearest, len(target))
    pairs = np.empty((len(drawn) * n_nearest, 2), np.int32)
    count = _match_nearest(
        of_source.symbols, of_source.lengths, of_target.symbols, of_target.lengths,
        drawn.astype(np.int32), n_nearest, p.length_scale, p.angle_scale, p.gap_cost, p.swap_cost,
        pairs,
    )  # fmt: skip
    return pairs[:count]
