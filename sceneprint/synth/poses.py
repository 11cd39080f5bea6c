"""Where a hand-held camera is and where it looks.

    Room, n, rng  --scattered_poses-->  n x T_world_camera (4, 4)

A view is (x, y, z, yaw, pitch, roll): metres and radians; pitch is negative when the
camera looks down; roll turns it about its optical axis.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sceneprint.synth.layout import inside
from sceneprint.synth.rays import pixel_rays
from sceneprint.synth.rooms import Room
from sceneprint.types import Floats, Intrinsics

CLEARANCE = 0.35  #: metres from the camera to the nearest surface, at least
HEIGHTS = (0.8, 1.9)  #: metres over the floor
_GOOD_SHARE = 0.75  #: of a view within 0.5 to 5 m
_COARSE = Intrinsics(32, 24, 29.25, 29.25, 15.5, 11.5)  #: what a Kinect sees, in few rays


def pose(view: Floats) -> Floats:
    """T_world_camera (4, 4) of a view (6,); the optical frame is x right, y down, z forward."""
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
    """(n,) whether points (n, 3) are in free space, that far from all surfaces.

    Rays go out in 128 directions. One that meets the back of a face has started inside a
    solid or outside the room.
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
    """Independent views; each sees a good share of the room within 0.5 to 5 m.

    Half of them look at some object from 0.7 to 3 m, half look about from anywhere.

    Parameters
    ----------
    room : the scene
    n : how many views

    Returns
    -------
    poses : n T_world_camera, (4, 4)
    """
    found: list[Floats] = []
    least = _GOOD_SHARE
    while len(found) < n:
        views = np.concatenate([looking_about(room, 8, rng), looking_at(room, 8, rng)])
        views = views[clear(room, views[:, :3])]
        for view in rng.permutation(views):
            T = pose(view)
            if len(found) < n and worth_seeing(room, T, least):
                found.append(T)
        least *= 0.98  # a crowded room offers little: be content with less
    return found


def looking_about(room: Room, n: int, rng: np.random.Generator) -> Floats:
    """(n, 6) views from anywhere, slightly downward."""
    yaw = rng.uniform(-math.pi, math.pi, n)
    pitch = np.clip(np.radians(rng.normal(-15, 15, n)), -1.3, 0.6)
    return np.column_stack([_positions(room, n, rng), yaw, pitch, _rolls(n, rng)])


def looking_at(room: Room, n: int, rng: np.random.Generator) -> Floats:
    """(n, 6) views whose middle is a point on some surface between knee and head."""
    a, b, c = (room.mesh.vertices[room.mesh.faces[:, k]] for k in range(3))
    middle = (a + b + c) / 3
    weight = np.sqrt(np.linalg.norm(np.cross(b - a, c - a), axis=1))  # small things count too
    weight *= (middle[:, 2] > 0.3) & (middle[:, 2] < 1.6)
    target = middle[rng.choice(len(middle), n, p=weight / weight.sum())]
    candidates = _positions(room, 6 * n, rng).reshape(n, 6, 3)
    offsets = target[:, None] - candidates
    distance = np.linalg.norm(offsets, axis=2)
    wanted = rng.uniform(0.7, 3.0, n)
    best = np.abs(distance - wanted[:, None]).argmin(axis=1)
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
    """Whether a share `least` of the view lies within 0.5 to 5 m, on several surfaces.

    Of the neighbours in a coarse grid of rays, a tenth must differ in depth or in normal,
    and the normals must span more than one direction. Less is asked as `least` falls.
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
    """(n, 3) unit vectors spread evenly: a Fibonacci lattice."""
    k = np.arange(n) + 0.5
    z = 1 - 2 * k / n
    r, turn = np.sqrt(1 - z * z), k * math.pi * (1 + math.sqrt(5))
    return np.column_stack([r * np.cos(turn), r * np.sin(turn), z])
