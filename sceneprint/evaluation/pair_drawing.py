"""Which pairs of frames are tried: drawn by how much they truly overlap.

members, Overlaps, planar  --draw-->  Drawn, ...
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from sceneprint.evaluation.overlap import Overlaps
from sceneprint.types import Floats

#: Edges of the bins of true overlap: the smaller direction, agreement within 10 cm.
EDGES = (0.1, 0.3, 0.5, 0.7, 1.0)
BINS = tuple(f"{round(100 * low)}-{round(100 * high)}" for low, high in pairwise(EDGES))
#: Two frames of a scene see nothing of each other below this, mean of both directions.
NOTHING = 0.01
#: Share of cross-scene pairs that are drawn among those with a planar frame.
PLANAR_SHARE = 0.25

Kind = Literal["overlapping", "same_scene", "cross_scene"]


@dataclass(frozen=True)
class Drawing:
    """How many pairs are drawn, and how.

    Parameters
    ----------
    pairs : of each bin of each scene, and as many of each scene that see nothing of each other
    negatives : of two scenes, over all of these
    apart : places in the recording between two frames of one sequence, at least
    seed : of the draw
    """

    pairs: int = 120
    negatives: int = 400
    apart: int = 30
    seed: int = 0


@dataclass(frozen=True)
class Place:
    """Where a frame comes from.

    Parameters
    ----------
    scene : its parent frame
    run : its sequence
    number : its place in the sequence
    """

    scene: str
    run: str
    number: int


@dataclass(frozen=True)
class Drawn:
    """A pair of frames that is tried.

    Parameters
    ----------
    query, match : indices of members
    kind : overlapping, or a negative of one scene or of two
    bin : of BINS where they overlap, else None
    overlap_mean, overlap_least : as in Overlaps; 0 for two scenes
    planar : whether a frame of the two is planar
    """

    query: int
    match: int
    kind: Kind
    bin: str | None
    overlap_mean: float
    overlap_least: float
    planar: bool


def draw(
    places: Sequence[Place], truth: Overlaps, planar: NDArray[np.bool_], p: Drawing
) -> list[Drawn]:
    """Pairs of every bin and of both kinds of negatives, each pair once; fewer where fewer exist.

    The later frame is the query. Of pairs of two scenes, every two scenes have as many, and a
    quarter is drawn among those with a planar frame, so long as there are any.

    Parameters
    ----------
    places : (N,) of the frames
    truth : (N, N) overlap, 0 between scenes
    planar : (N,) whether a frame shows little but one plane
    p : see Drawing
    """
    scenes = list(dict.fromkeys(place.scene for place in places))
    of = {s: np.flatnonzero([place.scene == s for place in places]) for s in scenes}
    drawn: list[Drawn] = []
    for number, scene in enumerate(scenes):
        drawn += _of_one_scene(of[scene], places, truth, planar, p, number)
    couples = list(combinations(scenes, 2))
    for number, (a, b) in enumerate(couples):
        share = p.negatives // len(couples) + (number < p.negatives % len(couples))
        rng = np.random.default_rng((p.seed, 1, number))
        drawn += _of_two_scenes(of[a], of[b], planar, share, rng)
    return drawn


def _of_one_scene(
    own: NDArray[np.intp],
    places: Sequence[Place],
    truth: Overlaps,
    planar: NDArray[np.bool_],
    p: Drawing,
    scene: int,
) -> list[Drawn]:
    later, earlier = np.tril_indices(len(own), -1)
    later, earlier = own[later], own[earlier]
    _, runs = np.unique([place.run for place in places], return_inverse=True)
    numbers = np.array([place.number for place in places], int)
    near = (runs[later] == runs[earlier]) & (np.abs(numbers[later] - numbers[earlier]) < p.apart)
    later, earlier = later[~near], earlier[~near]
    least, mean = truth.least[later, earlier], truth.mean[later, earlier]
    found = []
    choices: list[tuple[Kind, str | None, NDArray[np.bool_]]] = [
        ("overlapping", name, inside(least, name)) for name in BINS
    ]
    choices.append(("same_scene", None, (mean < NOTHING) & (least < NOTHING)))
    for number, (kind, name, good) in enumerate(choices):
        rng = np.random.default_rng((p.seed, 0, scene, number))
        for k in _some(np.flatnonzero(good), p.pairs, rng):
            i, j = int(later[k]), int(earlier[k])
            flat = bool(planar[i] or planar[j])
            found.append(Drawn(i, j, kind, name, float(mean[k]), float(least[k]), flat))
    return found


def inside(least: Floats, name: str) -> NDArray[np.bool_]:
    """Whether overlaps lie in a bin; the last one has its upper edge."""
    low, high = list(pairwise(EDGES))[BINS.index(name)]
    return (least >= low) & ((least < high) | (high == EDGES[-1]))


def _of_two_scenes(
    a: NDArray[np.intp],
    b: NDArray[np.intp],
    planar: NDArray[np.bool_],
    n: int,
    rng: np.random.Generator,
) -> list[Drawn]:
    flat = (planar[a][:, None] | planar[b]).ravel()
    first = _some(np.flatnonzero(flat), round(PLANAR_SHARE * n), rng)
    rest = np.setdiff1d(np.arange(len(flat)), first)
    chosen = np.concatenate([first, _some(rest, n - len(first), rng)])
    return [
        Drawn(int(a[k // len(b)]), int(b[k % len(b)]), "cross_scene", None, 0.0, 0.0, bool(flat[k]))
        for k in np.sort(chosen)
    ]


def _some(of: NDArray[np.intp], n: int, rng: np.random.Generator) -> NDArray[np.intp]:
    """At most n of some numbers, each once, rising."""
    return np.sort(rng.choice(of, min(n, len(of)), replace=False))
