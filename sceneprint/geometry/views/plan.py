"""Selection of poses whose views cover a surface.

    surface, parameters  --choose_views-->  ViewPlan

Candidates are views from free places above the floors that show enough surface. A greedy loop
selects the view that adds most to the coverage. Coverage is counted for each combination of a piece
of surface, a side and a distance, because robots may see a piece from any side and distance.
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

#: Maximum number of pieces of surface, and maximum number of places.
_MOST_PIECES, _MOST_PLACES = 60_000, 3_000
#: Maximum distance of a covered piece, as a share of the range.
_REACH = 0.5
#: Minimum share of a view that must show a surface: for a camera, for a scanner, and for the
#: horizontal directions of a scanner.
_LEAST_HIT, _LEAST_AROUND, _LEAST_BESIDE = 0.45, 0.25, 0.25
#: Minimum median depth of a camera's view, as a share of the range.
_LEAST_DEPTH = 1.0 / 11.0
#: Minimum share of directions that show a surface, for a place to vote on the front of a mesh.
_INDOORS = 0.6
#: Maximum share of surface seen from behind: in a camera's view of a mesh; in a scanner's view,
#: which shows both sides of partitions; and in a view of a cloud, whose sides are estimated.
_MOST_BACK, _MOST_BACK_AROUND, _MOST_BACK_GUESSED = 0.1, 0.5, 0.3
#: Maximum cosine between up and the normal of a wall.
_WALL = 0.7
#: Maximum ratio of votes for the back to votes for the front of a one-sided piece of a cloud.
_ONE_SIDED = 0.1
#: Number of yaws, and pitches in degrees, of a camera's views from a place.
_TURNS, _PITCHES = 8, (-25.0, 10.0)
#: Gain of the first, of the second and of each further view of an element.
_WORTH = np.array([1.0, 0.5, 0.0])
#: Share of the first view's gain at which the selection ends, for a camera and for a scanner; a
#: scanner sees all around and needs fewer views.
_LEAST_GAIN, _LEAST_GAIN_AROUND = 0.01, 0.03
#: Number of the map's views per test view, and minimum and maximum number of test views.
_VIEWS_A_TEST, _LEAST_TESTS, _MOST_TESTS = 4, 20, 60


@dataclass(frozen=True, eq=False)
class ViewPlan:
    """The selected views of a surface.

    Parameters
    ----------
    poses : (V, 4, 4) T_map_sensor in the order of selection, in the coordinates of the surface
        without its offset
    held_out : (H, 4, 4) poses of test views, which are not part of the map
    floor : height of the lowest floor along `up`, metres; None without a floor
    candidates : number of candidate views
    covered : share of the surface visible from free space that the selected views show
    """

    poses: Floats
    held_out: Floats
    floor: float | None
    candidates: int
    covered: float


def choose_views(surface: ReferenceSurface, parameters: ViewParameters) -> ViewPlan:
    """Select poses in the free space of a surface whose views cover the surface.

    The result is deterministic. If there is no free space, it has no poses.
    """
    if not len(surface.points if surface.triangles is None else surface.triangles):
        return ViewPlan(np.zeros((0, 4, 4)), np.zeros((0, 4, 4)), None, 0, 0.0)
    p, axes = parameters, level_axes(surface.up)
    pieces = surfels(surface, p.cell, _MOST_PIECES)
    level = replace(
        pieces,
        points=pieces.points @ axes.T.astype(np.float32),
        normals=pieces.normals @ axes.T.astype(np.float32),
    )
    turns = np.eye(3)[None] if p.camera is None else camera_turns()
    floors = find_floors(level, 2.0 * p.spacing, has_tables=p.camera is not None)
    spacing, places = p.spacing, candidate_places(floors, level, p, p.spacing)
    while len(places) > _MOST_PLACES:
        spacing *= max(math.sqrt(len(places) / _MOST_PLACES), 1.05)
        places = candidate_places(floors, level, p, spacing)
    lookout = Lookout(
        level, _REACH * p.farthest, p.farthest, _LEAST_DEPTH * p.farthest, turns, p.camera,
        p.elevation,
    )  # fmt: skip
    seen = [(place, lookout.look(place)) for place in places]
    free = [(place, sight) for place, sight in seen if _is_free(sight, p, level.one_sided)]
    free = _select_front(free, level, lookout, p)
    sights = [sight for _, sight in free]
    views = [(k, d) for k, sight in enumerate(sights) for d in _useful_views(sight, p)]
    least = _LEAST_GAIN if p.camera else _LEAST_GAIN_AROUND
    chosen, covered = _cover(sights, views, lookout.universe, p.most_views, least)
    others = sorted(set(range(len(views))) - set(chosen))
    tests = min(max(len(chosen) // _VIEWS_A_TEST, _LEAST_TESTS), _MOST_TESTS, len(others))
    spread = np.linspace(0, len(others) - 1, tests).astype(int)

    def poses(indices: Sequence[int]) -> Floats:
        transforms = np.tile(np.eye(4), (len(indices), 1, 1))
        for T, index in zip(transforms, indices, strict=True):
            k, d = views[index]
            T[:3, :3], T[:3, 3] = axes.T @ turns[d], axes.T @ free[k][0]
        return transforms

    return ViewPlan(
        poses(chosen), poses([others[k] for k in spread]), floors.lowest, len(views), covered
    )


def level_axes(up: Floats) -> Floats:
    """Return two level directions and up as the rows of a rotation (3, 3)."""
    level = np.zeros(3)
    level[int(np.argmin(np.abs(up)))] = 1.0
    first = np.cross(level, up)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(up, first), up])


def camera_turns() -> Floats:
    """Return R_level_camera (D, 3, 3) for each of a camera's views from a place."""
    turns = []
    for yaw in np.arange(_TURNS) * (2.0 * math.pi / _TURNS):
        for pitch in np.radians(_PITCHES):
            flat = np.array([math.cos(yaw), math.sin(yaw), 0.0])
            ahead = math.cos(pitch) * flat + math.sin(pitch) * np.array([0.0, 0.0, 1.0])
            right = np.cross(flat, (0.0, 0.0, 1.0))
            turns.append(np.stack([right, np.cross(ahead, right), ahead], axis=1))
    return np.array(turns)


def _is_free(sight: Sight, p: ViewParameters, one_sided: bool) -> bool:
    """Return whether a place has room for the sensor, a surface beside it and no ceiling below."""
    if sight.nearest < p.clearance:
        return False
    if p.camera is None:
        return bool(sight.hit[0] >= _LEAST_AROUND) and sight.beside >= _LEAST_BESIDE
    return one_sided or sight.beside >= _LEAST_BESIDE


def _select_front(
    free: list[tuple[Floats, Sight]], pieces: Surfels, lookout: Lookout, p: ViewParameters
) -> list[tuple[Floats, Sight]]:
    """Return the free places from which surfaces are seen from the front.

    The sides of a mesh that is inside out are swapped. In a cloud, the views of each wall vote on
    its front.
    """
    if pieces.one_sided:
        # a mesh that is inside out shows its back in all free space
        shares = np.array([sight.back.mean() for _, sight in free if sight.hit.mean() > _INDOORS])
        if len(shares) and (shares > 1.0 - _MOST_BACK).sum() > (shares < _MOST_BACK).sum():
            free = [(place, replace(sight, back=1.0 - sight.back)) for place, sight in free]
        if p.camera is None:
            free = [(place, sight) for place, sight in free if sight.back[0] <= _MOST_BACK_AROUND]
        return free
    # only walls tell the sides of a surface apart, because all places see floors from above
    is_wall = (lookout.normals != 0).any(axis=1) & (np.abs(lookout.normals[:, 2]) < _WALL)
    votes = np.zeros((len(lookout.points), 2))
    for _, sight in free:
        piece, side = sight.elements // (SIDES * OCTAVES), (sight.masks & BEHIND) > 0
        np.add.at(votes, (piece, side.astype(int)), sight.beside**2)
    in_front = []
    for place, sight in free:
        piece, side = sight.elements // (SIDES * OCTAVES), ((sight.masks & BEHIND) > 0).astype(int)
        behind = votes[piece, side] < _ONE_SIDED * votes[piece, 1 - side]
        walls = is_wall[piece]
        if not walls.any() or behind[walls].mean() <= _MOST_BACK_GUESSED:
            in_front.append((place, sight))
    return in_front


def _useful_views(sight: Sight, p: ViewParameters) -> list[int]:
    """Return the views that show enough surface, from the front and at a sufficient distance."""
    if p.camera is None:
        return [0]
    useful = (sight.hit >= _LEAST_HIT) & (sight.close <= 0.5) & (sight.back <= _MOST_BACK)
    return [int(d) for d in np.flatnonzero(useful)]


@kernel
def _gain(
    elements: NDArray[np.int32], masks: NDArray[np.uint32], bit: int, counts: NDArray[np.uint8],
    worth: Floats,
) -> float:  # fmt: skip
    """Return the gain of a view, which depends on how many selected views show each element."""
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
    """Add a view to the counts of its elements."""
    of_view = np.uint32(1) << np.uint32(bit)
    for i in range(len(elements)):
        if masks[i] & of_view and counts[elements[i]] < most:
            counts[elements[i]] += 1


def _cover(
    sights: Sequence[Sight], views: Sequence[tuple[int, int]], universe: int, most: int,
    least_gain: float,
) -> tuple[list[int], float]:  # fmt: skip
    """Select views greedily until gains are small; return their indices and the share covered.

    The share refers to the elements that at least one of `views` shows. The second view of an
    element also gains, see `_WORTH`. Gains can only decrease during the selection, so most need not
    be recomputed.

    Parameters
    ----------
    sights : visible parts from each place
    views : place and direction of each view
    universe : number of elements
    most : maximum number of views
    least_gain : share of the first view's gain at which the selection ends; it also ends below 1
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
