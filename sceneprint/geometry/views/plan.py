"""Where views of a surface are taken from, so that they cover it.

    surface, parameters  --choose_views-->  ViewPlan

Places above the floors are looked around from; those that are not free, and views of next to
nothing, are left out. Of the rest, the view that sees most of what too few have seen yet is chosen,
again and again. What is seen is counted by piece of surface, side and distance, so that a piece is
covered when it was seen as any robot may see it.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sceneprint.geometry.kernel import kernel
from sceneprint.geometry.views.free_space import candidate_places, find_floors
from sceneprint.geometry.views.lookout import BEHIND, OCTAVES, SIDES, Lookout, Sight
from sceneprint.geometry.views.parameters import ViewParameters
from sceneprint.geometry.views.samples import Surfels, surfels
from sceneprint.types import Floats, ReferenceSurface

#: Pieces of surface, and places that are looked around from, at most.
_MOST_PIECES, _MOST_PLACES = 60_000, 3_000
#: Pieces farther than this share of the range are not counted as seen.
_REACH = 0.5
#: Least share of a view in which there is something: of a camera, of a scanner, and of what is
#: beside a scanner.
_LEAST_HIT, _LEAST_AROUND, _LEAST_BESIDE = 0.45, 0.25, 0.25
#: Median depth of a camera's view, as a share of its range, at least.
_LEAST_DEPTH = 1.0 / 11.0
#: Places that see something in this share of all directions tell which side of a mesh is its front.
_INDOORS = 0.6
#: Share of what is hit that may be seen from behind: by a camera's view of a mesh; by a scanner in
#: it, which sees both sides of partitions, but from behind the walls next to nothing else; and in a
#: cloud, whose sides are estimated.
_MOST_BACK, _MOST_BACK_AROUND, _MOST_BACK_GUESSED = 0.1, 0.5, 0.3
#: Cosine between up and the normal of a wall, at most.
_WALL = 0.7
#: A cloud's piece has one side where the other has at most this share of the votes.
_ONE_SIDED = 0.1
#: Directions of a camera's views from one place: turns of a whole, and pitches, degrees.
_TURNS, _PITCHES = 8, (-25.0, 10.0)
#: What a view adds that is the first, or the second, to see something; later ones add nothing.
_WORTH = np.array([1.0, 0.5, 0.0])
#: Choosing ends once the best view adds less than this share of the first one's gain: of a camera,
#: and of a scanner, which sees all around and needs fewer.
_LEAST_GAIN, _LEAST_GAIN_AROUND = 0.01, 0.03
#: Views that are none of the map: one for so many of its views, and at least and at most so many.
_VIEWS_A_TEST, _LEAST_TESTS, _MOST_TESTS = 4, 20, 60


@dataclass(frozen=True, eq=False)
class ViewPlan:
    """The views of a surface.

    Parameters
    ----------
    poses : (V, 4, 4) T_map_sensor, in the coordinates of the surface without its offset; those
        that cover most come first
    held_out : (H, 4, 4) poses of views that are none of the map, to measure it with
    floor : height of the lowest floor along `up`, metres; None where no floor was found
    candidates : how many views there were to choose from
    covered : share of what a sensor sees in the free space that the chosen views see as well
    """

    poses: Floats
    held_out: Floats
    floor: float | None
    candidates: int
    covered: float


def choose_views(surface: ReferenceSurface, parameters: ViewParameters) -> ViewPlan:
    """Choose poses in the free space of a surface whose views cover it.

    Parameters
    ----------
    surface : see ReferenceSurface
    parameters : of the sensor

    Returns
    -------
    plan : the same one for the same surface; without poses where there is no free space
    """
    if not len(surface.points if surface.triangles is None else surface.triangles):
        return ViewPlan(np.zeros((0, 4, 4)), np.zeros((0, 4, 4)), None, 0, 0.0)
    p, axes = parameters, level_axes(surface.up)
    pieces = surfels(surface, p.cell, _MOST_PIECES)
    level = replace(
        pieces, points=_turned(pieces.points, axes), normals=_turned(pieces.normals, axes)
    )
    turns = np.eye(3)[None] if p.camera is None else camera_turns()
    floors = find_floors(level, 2.0 * p.spacing, has_tables=p.camera is not None)
    spacing, places = p.spacing, candidate_places(floors, level, p, p.spacing)
    while len(places) > _MOST_PLACES:
        spacing *= max(math.sqrt(len(places) / _MOST_PLACES), 1.05)
        places = candidate_places(floors, level, p, spacing)
    lookout = Lookout(
        level,
        _REACH * p.farthest,
        p.farthest,
        _LEAST_DEPTH * p.farthest,
        turns,
        p.camera,
        p.elevation,
    )
    seen = [(place, lookout.look(place)) for place in places]
    free = [(place, one) for place, one in seen if _is_free(one, p, one_sided=level.one_sided)]
    free = _in_front(free, level, lookout, p)
    views = [(k, d) for k, (_, one) in enumerate(free) for d in _worth_seeing(one, p)]
    sights = [one for _, one in free]
    least = _LEAST_GAIN if p.camera else _LEAST_GAIN_AROUND
    chosen, covered = _cover(sights, views, lookout.universe, p.most_views, least)
    left = sorted(set(range(len(views))) - set(chosen))
    tests = min(max(len(chosen) // _VIEWS_A_TEST, _LEAST_TESTS), _MOST_TESTS, len(left))
    spread = np.linspace(0, len(left) - 1, tests).astype(int)

    def poses(indices: Sequence[int]) -> Floats:
        found = np.tile(np.eye(4), (len(indices), 1, 1))
        for row, index in enumerate(indices):
            k, d = views[index]
            found[row, :3, :3], found[row, :3, 3] = axes.T @ turns[d], axes.T @ free[k][0]
        return found

    return ViewPlan(
        poses(chosen), poses([left[k] for k in spread]), floors.lowest, len(views), covered
    )


def level_axes(up: Floats) -> Floats:
    """Return (3, 3), rows: two level directions, and up."""
    level = np.zeros(3)
    level[int(np.argmin(np.abs(up)))] = 1.0
    first = np.cross(level, up)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(up, first), up])


def camera_turns() -> Floats:
    """Return (D, 3, 3) R_level_camera of the views from one place."""
    found = []
    for yaw in np.arange(_TURNS) * (2.0 * math.pi / _TURNS):
        for pitch in np.radians(_PITCHES):
            flat = np.array([math.cos(yaw), math.sin(yaw), 0.0])
            ahead = math.cos(pitch) * flat + math.sin(pitch) * np.array([0.0, 0.0, 1.0])
            right = np.cross(flat, (0.0, 0.0, 1.0))
            found.append(np.stack([right, np.cross(ahead, right), ahead], axis=1))
    return np.array(found)


def _turned(vectors: NDArray[np.float32], axes: Floats) -> NDArray[np.float32]:
    turned: NDArray[np.float32] = vectors @ axes.T.astype(np.float32)
    return turned


def _is_free(one: Sight, p: ViewParameters, *, one_sided: bool) -> bool:
    """Whether a place has room for the sensor, and something beside it: not above a ceiling."""
    if one.nearest < p.clearance:
        return False
    if p.camera is None:
        return bool(one.hit[0] >= _LEAST_AROUND) and one.beside >= _LEAST_BESIDE
    return one_sided or one.beside >= _LEAST_BESIDE


def _in_front(
    free: list[tuple[Floats, Sight]], pieces: Surfels, lookout: Lookout, p: ViewParameters
) -> list[tuple[Floats, Sight]]:
    """Leave out places, or views, behind surfaces that have one side."""
    if pieces.one_sided:
        # a mesh whose triangles are turned inside out shows its back wherever there is room
        shares = np.array([one.back.mean() for _, one in free if one.hit.mean() > _INDOORS])
        if len(shares) and (shares > 1.0 - _MOST_BACK).sum() > (shares < _MOST_BACK).sum():
            free = [(place, replace(one, back=1.0 - one.back)) for place, one in free]
        if p.camera is None:
            free = [(place, one) for place, one in free if one.back[0] <= _MOST_BACK_AROUND]
        return free
    # level surfaces are seen from above wherever one stands; walls tell where one is
    is_wall = (lookout.normals != 0).any(axis=1) & (np.abs(lookout.normals[:, 2]) < _WALL)
    votes = np.zeros((len(lookout.points), 2))
    for _, one in free:
        piece, side = one.elements // (SIDES * OCTAVES), (one.masks & BEHIND) > 0
        np.add.at(votes, (piece, side.astype(int)), one.beside**2)
    kept = []
    for place, one in free:
        piece, side = one.elements // (SIDES * OCTAVES), ((one.masks & BEHIND) > 0).astype(int)
        behind = votes[piece, side] < _ONE_SIDED * votes[piece, 1 - side]
        walls = is_wall[piece]
        if not walls.any() or behind[walls].mean() <= _MOST_BACK_GUESSED:
            kept.append((place, one))
    return kept


def _worth_seeing(one: Sight, p: ViewParameters) -> list[int]:
    """Which views from a place show enough of the surface, far enough away, from its front."""
    if p.camera is None:
        return [0]
    shown = (one.hit >= _LEAST_HIT) & (one.close <= 0.5)
    shown &= one.back <= _MOST_BACK
    return [int(d) for d in np.flatnonzero(shown)]


@kernel
def _gain(
    elements: NDArray[np.int32], masks: NDArray[np.uint32], bit: int, counts: NDArray[np.uint8],
    worth: Floats,
) -> float:  # fmt: skip
    """What a view adds to the elements that were seen so often."""
    gain, of_view = 0.0, np.uint32(1) << np.uint32(bit)
    for i in range(len(elements)):
        if masks[i] & of_view:
            gain += worth[counts[elements[i]]]
    return gain


@kernel
def _add(
    elements: NDArray[np.int32], masks: NDArray[np.uint32], bit: int, counts: NDArray[np.uint8],
    most: int,
) -> None:  # fmt: skip
    """Count the elements of a view as seen once more."""
    of_view = np.uint32(1) << np.uint32(bit)
    for i in range(len(elements)):
        if masks[i] & of_view and counts[elements[i]] < most:
            counts[elements[i]] += 1


def _cover(
    sights: Sequence[Sight], views: Sequence[tuple[int, int]], universe: int, most: int,
    least_gain: float,
) -> tuple[list[int], float]:  # fmt: skip
    """Choose views, greedily, until none adds much; their indices, and the share that is covered.

    Gains only fall as views are chosen, so that most need not be worked out anew each time.

    Parameters
    ----------
    sights : from each place
    views : place and direction of each
    universe : how many elements there are
    most : views that are chosen
    least_gain : choosing ends once a view adds less than this share of the first one's gain
    """
    counts = np.zeros(universe, np.uint8)

    def gain(index: int) -> float:
        k, d = views[index]
        return float(_gain(sights[k].elements, sights[k].masks, d, counts, _WORTH))

    heap = [(-gain(index), index) for index in range(len(views))]
    heapq.heapify(heap)
    chosen: list[int] = []
    least = least_gain * -heap[0][0] if heap else 0.0
    while heap and len(chosen) < most:
        _, index = heapq.heappop(heap)
        fresh = gain(index)
        if heap and (-fresh, index) > heap[0]:
            heapq.heappush(heap, (-fresh, index))
            continue
        if fresh < max(least, 1.0):
            break
        k, d = views[index]
        _add(sights[k].elements, sights[k].masks, d, counts, len(_WORTH) - 1)
        chosen.append(index)
    possible = np.zeros(universe, np.uint8)
    for k, d in views:
        _add(sights[k].elements, sights[k].masks, d, possible, 1)
    return chosen, float((counts > 0).sum() / max(int(possible.sum()), 1))
