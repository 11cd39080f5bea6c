"""Poses of hand-held cameras in rooms, and of scanners in large premises.

    Room, n, rng  --scattered_poses-->  n x T_world_camera (4, 4)

A view is (x, y, z, yaw, pitch, roll), metres and radians. A negative pitch looks down, and roll
turns the camera about its optical axis.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from sceneprint.types import Floats, Intrinsics
from sceneprint_lab.synth.large_scenes import Premises
from sceneprint_lab.synth.mesh import rotation_x, rotation_z
from sceneprint_lab.synth.rooms import Room, inside
from sceneprint_lab.synth.sensors import pixel_rays

CLEARANCE = 0.35  #: minimum distance from the camera to a surface, metres
HEIGHTS = (0.8, 1.9)  #: range of heights above the floor, metres
_GOOD_SHARE = 0.75  #: initial minimum share of a view that is within 0.5 to 5 m
_COARSE = Intrinsics(32, 24, 29.25, 29.25, 15.5, 11.5)  #: a Kinect camera with few pixels


def pose(view: Floats) -> Floats:
    """Return T_world_camera (4, 4), the pose of the optical frame, of a view (6,)."""
    x, y, z, yaw, pitch, roll = view
    forward = np.array(
        [math.cos(yaw) * math.cos(pitch), math.sin(yaw) * math.cos(pitch), math.sin(pitch)]
    )
    right = np.array([math.sin(yaw), -math.cos(yaw), 0.0])
    down = np.cross(forward, right)
    c, s = math.cos(roll), math.sin(roll)
    T = np.eye(4)
    T[:3, 0], T[:3, 1], T[:3, 2] = c * right + s * down, c * down - s * right, forward
    T[:3, 3] = x, y, z
    return T


def clear(room: Room, points: Floats, distance: float = CLEARANCE) -> NDArray[np.bool_]:
    """Return a mask (n,) of points (n, 3) in free space, `distance` metres from all surfaces.

    Rays are cast in 128 directions. A ray that hits the back of a face starts inside a solid or
    outside the room.
    """
    directions = _directions(128)
    origins = np.repeat(points.astype(np.float32), len(directions), axis=0)
    rays = np.tile(directions, (len(points), 1)).astype(np.float32)
    hits = room.caster.cast(origins, rays)
    shape = (len(points), len(directions))
    behind = (np.einsum("ij,ij->i", rays, hits.normal) > 0).reshape(shape)
    near = hits.distance.reshape(shape).min(axis=1)
    missed = (hits.face < 0).reshape(shape)
    return np.asarray((near >= distance) & (behind.mean(axis=1) < 0.02) & ~missed.any(axis=1))


def scattered_poses(room: Room, n: int, rng: np.random.Generator) -> list[Floats]:
    """Return independent views that show a large part of the room within 0.5 to 5 m.

    Half of the candidates look at an object from 0.7 to 3 m away, the others in random directions.

    Parameters
    ----------
    room : scene
    n : number of views

    Returns
    -------
    poses : n T_world_camera, (4, 4)
    """
    poses: list[Floats] = []
    least = _GOOD_SHARE
    while len(poses) < n:
        views = np.concatenate([looking_about(room, 8, rng), looking_at(room, 8, rng)])
        views = views[clear(room, views[:, :3])]
        for view in rng.permutation(views):
            T = pose(view)
            if len(poses) < n and worth_seeing(room, T, least):
                poses.append(T)
        least *= 0.98  # lower the limit, because a crowded room has few good views
    return poses


def looking_about(room: Room, n: int, rng: np.random.Generator) -> Floats:
    """Return views (n, 6) from random positions in random, slightly downward directions."""
    yaw = rng.uniform(-math.pi, math.pi, n)
    pitch = np.clip(np.radians(rng.normal(-15, 15, n)), -1.3, 0.6)
    return np.column_stack([_positions(room, n, rng), yaw, pitch, _rolls(n, rng)])


def looking_at(room: Room, n: int, rng: np.random.Generator) -> Floats:
    """Return views (n, 6) of random surface points between knee and head height."""
    a, b, c = (room.mesh.vertices[room.mesh.faces[:, k]] for k in range(3))
    middle = (a + b + c) / 3
    weight = np.sqrt(np.linalg.norm(np.cross(b - a, c - a), axis=1))  # this favours small objects
    weight *= (middle[:, 2] > 0.3) & (middle[:, 2] < 1.6)
    target = middle[rng.choice(len(middle), n, p=weight / weight.sum())]
    candidates = _positions(room, 6 * n, rng).reshape(n, 6, 3)
    offsets = target[:, None] - candidates
    distance = np.linalg.norm(offsets, axis=2)
    distances = rng.uniform(0.7, 3.0, n)
    best = np.abs(distance - distances[:, None]).argmin(axis=1)
    rows = np.arange(n)
    d = offsets[rows, best]
    yaw = np.arctan2(d[:, 1], d[:, 0]) + rng.normal(0, 0.15, n)
    pitch = np.arctan2(d[:, 2], np.hypot(d[:, 0], d[:, 1])) + rng.normal(0, 0.12, n)
    pitch = np.clip(pitch, -1.2, 0.5)
    return np.column_stack([candidates[rows, best], yaw, pitch, _rolls(n, rng)])


def _positions(room: Room, n: int, rng: np.random.Generator) -> Floats:
    low, high = room.outline.min(axis=0), room.outline.max(axis=0)
    xy = rng.uniform(low, high, (8 * n, 2))
    xy = xy[inside(room.outline, xy)]
    while len(xy) < n:
        more = rng.uniform(low, high, (8 * n, 2))
        xy = np.concatenate([xy, more[inside(room.outline, more)]])
    return np.column_stack([xy[:n], rng.uniform(*HEIGHTS, n)])


def _rolls(n: int, rng: np.random.Generator) -> Floats:
    spread = np.where(rng.random(n) < 0.1, 20.0, 5.0)
    return np.asarray(np.radians(rng.normal(0, 1, n) * spread))


def worth_seeing(room: Room, T_world_camera: Floats, least: float) -> bool:
    """Return whether a share `least` of a view is within 0.5 to 5 m and shows several surfaces.

    On a coarse grid of rays, a tenth of the pairs of neighbours must differ in depth or normal, and
    the normals must span more than one direction. These limits are proportional to `least`.
    """
    rays = pixel_rays(_COARSE) @ T_world_camera[:3, :3].T.astype(np.float32)
    origins = np.broadcast_to(T_world_camera[:3, 3].astype(np.float32), rays.shape)
    hits = room.caster.cast(origins, rays)
    good = (hits.distance > 0.5) & (hits.distance < 5.0)
    if good.mean() < least:
        return False
    normals = hits.normal[good].astype(np.float64)
    spread = np.linalg.eigvalsh(normals.T @ normals / len(normals))
    depth = hits.distance.reshape(_COARSE.height, _COARSE.width)
    normal = hits.normal.reshape(_COARSE.height, _COARSE.width, 3)
    step = np.abs(np.diff(depth, axis=1)) > 0.1 * depth[:, 1:]
    bend = (normal[:, 1:] * normal[:, :-1]).sum(axis=2) < 0.9
    ease = least / _GOOD_SHARE
    return bool(spread[1] > 0.08 * ease and (step | bend).mean() > 0.1 * ease)


def _directions(n: int) -> Floats:
    """Return evenly distributed unit vectors (n, 3): a Fibonacci lattice."""
    k = np.arange(n) + 0.5
    z = 1 - 2 * k / n
    r, turn = np.sqrt(1 - z * z), k * math.pi * (1 + math.sqrt(5))
    return np.column_stack([r * np.cos(turn), r * np.sin(turn), z])


# Views from a circle around an object.
#
# middle, radius, n, rng  --orbit-->  n x T_world_camera (4, 4), in order


def orbit(
    middle: tuple[float, float, float], radius: float, n: int, rng: np.random.Generator, *,
    first: float | None = None, sweep: float = 2 * math.pi,
) -> list[Floats]:  # fmt: skip
    """Return hand-held views of a point, from a circle around it.

    The camera is 1.05 to 1.65 m above z = 0. Distance, height, aim and roll vary slowly, by about
    0.1 m and a few degrees; the aim also jitters by 15 mm.

    Parameters
    ----------
    middle : point at which the views are aimed, metres
    radius : radius of the circle, metres
    n : number of views, at intervals of `sweep` / n from the start
    first : azimuth of the first view, rad; random by default
    sweep : angle that the views cover, rad

    Returns
    -------
    poses : n T_world_camera, (4, 4), in the order of the circle
    """
    start = float(rng.uniform(-math.pi, math.pi)) if first is None else first
    azimuth = start + sweep * np.arange(n) / n
    scale = (0.15, 0.15, 0.08, 0.08, 0.08, math.radians(4.0))
    waves = rng.normal(0, 1, (6, 3)) * np.array(scale)[:, None] / math.sqrt(3)
    phase = np.outer(np.arange(1, 4), 2 * math.pi * np.arange(n) / n)  # 1 to 3 periods per turn
    away, up, *aim, roll = waves @ np.cos(phase + rng.uniform(0, 2 * math.pi, (3, 1)))
    r, z = radius + away, rng.uniform(1.05, 1.65) + up
    eye = np.column_stack([r * np.cos(azimuth), r * np.sin(azimuth), z])
    eye[:, :2] += middle[:2]
    to = np.array(middle) + np.column_stack(aim) + rng.normal(0, 0.015, (n, 3)) - eye
    yaw, pitch = np.arctan2(to[:, 1], to[:, 0]), np.arctan2(to[:, 2], np.hypot(to[:, 0], to[:, 1]))
    return [pose(view) for view in np.column_stack([eye, yaw, pitch, roll])]


# Hand-held paths that return to earlier places: random walks through a network of viewpoints.
#
#     Room, n, rng  --trajectory-->  n x T_world_camera (4, 4), in order


def trajectory(room: Room, n: int, rng: np.random.Generator) -> list[Floats]:
    """Return a smooth hand-held path that looks around and returns to earlier places.

    The camera moves between a few viewpoints by at most 3 to 8 cm and 1 to 3 degrees per frame,
    with a slight tremor.

    Parameters
    ----------
    room : scene
    n : number of frames

    Returns
    -------
    poses : n T_world_camera, (4, 4), in the order of the path
    """
    anchors, ways = _network(room, max(3, min(8, n // 40 + 3)), rng)
    here = 0
    path = [anchors[:1]]
    length = 1
    while length < n:
        here, start = int(rng.choice(ways[here])), here
        piece = _walk(anchors[start], anchors[here], rng)
        path.append(piece)
        length += len(piece)
    views = np.concatenate(path)[:n]
    views[:, 3] = np.unwrap(views[:, 3])
    smooth = _smoothed(views, 5)
    smooth += _smoothed(rng.normal(0, (0.01, 0.01, 0.01, 0.012, 0.012, 0.012), views.shape), 3)
    return [pose(v) for v in smooth]


def _network(room: Room, count: int, rng: np.random.Generator) -> tuple[Floats, list[list[int]]]:
    """Return at most `count` viewpoints (k, 6) and, for each, the indices of its neighbours.

    A clear straight line connects neighbours. If fewer than `count` viewpoints are found, each is
    also its own neighbour, because a single viewpoint would have none.
    """
    anchors: list[Floats] = []
    ways: list[list[int]] = []
    for attempt in range(400):
        views = np.concatenate([looking_about(room, 4, rng), looking_at(room, 4, rng)])
        views = views[clear(room, views[:, :3], CLEARANCE + 0.08)]
        good = [v for v in views if worth_seeing(room, pose(v), 0.7 - 0.001 * attempt)]
        for view in good:
            reached = [k for k, a in enumerate(anchors) if _is_way_clear(room, a, view)]
            if anchors and not reached:
                continue
            for k in reached:
                ways[k].append(len(anchors))
            anchors.append(view)
            ways.append(reached)
            if len(anchors) == count:
                return np.array(anchors), ways
    for k, near in enumerate(ways):
        near.append(k)
    return np.array(anchors), ways


def _is_way_clear(room: Room, a: Floats, b: Floats) -> bool:
    """Return whether the straight line between two views is clear."""
    steps = max(2, int(np.linalg.norm(a[:3] - b[:3]) / 0.15))
    points = a[:3] + np.linspace(0, 1, steps)[:, None] * (b[:3] - a[:3])
    return bool(clear(room, points, CLEARANCE + 0.05).all())


def _walk(a: Floats, b: Floats, rng: np.random.Generator) -> Floats:
    """Return views from a (excluded) to b; the yaw turns in the shorter direction."""
    change = b - a
    change[3] = (change[3] + math.pi) % (2 * math.pi) - math.pi
    walked = np.linalg.norm(change[:3]) / rng.uniform(0.03, 0.08)
    turned = np.linalg.norm(change[3:]) / math.radians(rng.uniform(1.0, 3.0))
    steps = max(8, math.ceil(max(walked, turned)))
    return np.asarray(a + np.linspace(0, 1, steps + 1)[1:, None] * change)


def _smoothed(values: Floats, radius: int) -> Floats:
    """Return the columns, smoothed by a triangular moving mean over 2 radius + 1 rows."""
    kernel = np.bartlett(2 * radius + 3)[1:-1]
    kernel /= kernel.sum()
    padded = np.pad(values, ((radius, radius), (0, 0)), mode="edge")
    return np.column_stack([np.convolve(c, kernel, mode="valid") for c in padded.T])


# Poses of a scanner in large premises, on a walk or independent.
#
# Premises, n, rng  --walk, scattered-->  n x T_world_sensor (4, 4)

STEP = 1.5  #: distance between scans on a walk, metres
COARSE = 3  #: edge length of a cell of the grid for walks, in cells of the floor's grid


def scattered(premises: Premises, n: int, rng: np.random.Generator) -> list[Floats]:
    """Return n random poses in the premises."""
    spots = premises.floor.points[premises.walkable]
    height = float(rng.uniform(0.5, 1.9))
    chosen = spots[rng.integers(0, len(spots), n)]
    return [scanner_pose(x, y, height, rng.uniform(-math.pi, math.pi), rng) for x, y in chosen]


def walk(premises: Premises, n: int, rng: np.random.Generator, step: float = STEP) -> list[Floats]:
    """Return n poses of a scanner, `step` metres apart, on a walk that often returns to places.

    The height of the scanner, and its yaw relative to the direction of travel, are random but
    constant during the walk.
    """
    spots, graph = _ways(premises)
    path = [spots[0][None]]
    at, length = int(rng.integers(0, len(spots))), 0.0
    aims = rng.integers(0, len(spots), max(3, n // 12))
    while length < n * step:
        aim = int(aims[int(rng.integers(0, len(aims)))])
        _, before = dijkstra(graph, indices=[aim], return_predecessors=True)
        leg = [at]
        while leg[-1] != aim and before[0, leg[-1]] >= 0:
            leg.append(int(before[0, leg[-1]]))
        line = spots[leg]
        length += max(float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum()), 1e-3)
        path.append(line)
        at = leg[-1]
        if len(path) > 50 * n:  # there is only one walkable cell
            break
    line = np.concatenate(path[1:])
    line = ndimage.gaussian_filter1d(line, 1.5, axis=0, mode="nearest")
    along = np.append(0.0, np.linalg.norm(np.diff(line, axis=0), axis=1).cumsum())
    s = np.minimum(np.arange(n) * step, along[-1])
    xy = np.column_stack([np.interp(s, along, line[:, k]) for k in range(2)])
    ahead = np.column_stack([np.interp(s + 0.5, along, line[:, k]) for k in range(2)]) - xy
    height = float(rng.uniform(0.5, 1.9))
    mounted = float(rng.uniform(-math.pi, math.pi))
    return [
        scanner_pose(x, y, height, mounted + math.atan2(dy, dx), rng)
        for (x, y), (dx, dy) in zip(xy, ahead, strict=True)
    ]


def scanner_pose(x: float, y: float, z: float, yaw: float, rng: np.random.Generator) -> Floats:
    """Return T_world_sensor (4, 4) of a scanner that is carried almost upright."""
    roll, pitch = rng.normal(0, math.radians(1.5), 2)
    T = np.eye(4)
    across = rotation_z(math.pi / 2) @ rotation_x(float(pitch)) @ rotation_z(-math.pi / 2)
    T[:3, :3] = rotation_z(yaw) @ across @ rotation_x(float(roll))
    T[:3, 3] = x, y, z + rng.normal(0, 0.02)
    return T


def _ways(premises: Premises) -> tuple[Floats, csr_array]:
    """Return walkable spots (n, 2), metres, and a sparse matrix of distances to neighbours."""
    free = premises.walkable[::COARSE, ::COARSE]
    parts, count = ndimage.label(free, np.ones((3, 3)))
    if count:
        free = parts == 1 + int(np.bincount(parts.ravel())[1:].argmax())
    else:
        free = np.zeros_like(free)
        free.flat[0] = True
    spots = premises.floor.points[::COARSE, ::COARSE][free]
    number = np.full(free.shape, -1)
    number[free] = np.arange(len(spots))
    rows, columns, lengths = [], [], []
    pitch = COARSE * premises.floor.cell
    for dx, dy in ((1, 0), (0, 1), (1, 1), (1, -1)):
        a = number[: free.shape[0] - dx, max(0, -dy) : free.shape[1] - max(0, dy)]
        b = number[dx:, max(0, dy) : free.shape[1] + min(0, dy)]
        both = (a >= 0) & (b >= 0)
        rows.append(a[both])
        columns.append(b[both])
        lengths.append(np.full(int(both.sum()), pitch * math.hypot(dx, dy)))
    i, j, d = np.concatenate(rows), np.concatenate(columns), np.concatenate(lengths)
    n = len(spots)
    both_ways = np.append(i, j), np.append(j, i)
    return spots, csr_array((np.append(d, d), both_ways), shape=(n, n))
