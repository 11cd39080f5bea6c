"""A hand-held path: a camera that looks around and comes back.

    Room, n, rng  --trajectory-->  n x T_world_camera (4, 4), in order

Viewpoints are joined by straight clear ways to a network; the path wanders over it.
"""

from __future__ import annotations

import math

import numpy as np

from sceneprint.synth.poses import (
    CLEARANCE,
    clear,
    looking_about,
    looking_at,
    pose,
    worth_seeing,
)
from sceneprint.synth.rooms import Room
from sceneprint.types import Floats


def trajectory(room: Room, n: int, rng: np.random.Generator) -> list[Floats]:
    """A smooth hand-held path that looks around and comes back to places it has seen.

    The camera wanders between a few viewpoints, 3 to 8 cm or 1 to 3 degrees a frame,
    whichever takes longer; its hand trembles a little.

    Parameters
    ----------
    room : the scene
    n : how many frames

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
    """Viewpoints (k, 6) and, for each, those that a clear straight way leads to."""
    anchors: list[Floats] = []
    ways: list[list[int]] = []
    for attempt in range(400):
        views = np.concatenate([looking_about(room, 4, rng), looking_at(room, 4, rng)])
        views = views[clear(room, views[:, :3], CLEARANCE + 0.08)]
        good = [v for v in views if worth_seeing(room, pose(v), 0.7 - 0.001 * attempt)]
        for view in good:
            reached = [k for k, a in enumerate(anchors) if _way(room, a, view)]
            if anchors and not reached:
                continue
            for k in reached:
                ways[k].append(len(anchors))
            anchors.append(view)
            ways.append(reached)
            if len(anchors) == count:
                return np.array(anchors), ways
    for k, near in enumerate(ways):  # a nook: look about on the spot
        near.append(k)
    return np.array(anchors), ways


def _way(room: Room, a: Floats, b: Floats) -> bool:
    steps = max(2, int(np.linalg.norm(a[:3] - b[:3]) / 0.15))
    points = a[:3] + np.linspace(0, 1, steps)[:, None] * (b[:3] - a[:3])
    return bool(clear(room, points, CLEARANCE + 0.05).all())


def _walk(a: Floats, b: Floats, rng: np.random.Generator) -> Floats:
    """Views from a (left out) to b; yaw goes the short way round."""
    change = b - a
    change[3] = (change[3] + math.pi) % (2 * math.pi) - math.pi
    walked = np.linalg.norm(change[:3]) / rng.uniform(0.03, 0.08)
    turned = np.linalg.norm(change[3:]) / math.radians(rng.uniform(1.0, 3.0))
    steps = max(8, math.ceil(max(walked, turned)))
    return np.asarray(a + np.linspace(0, 1, steps + 1)[1:, None] * change)


def _smoothed(values: Floats, radius: int) -> Floats:
    """Columns after a triangular moving mean over 2 radius + 1 rows, the ends held."""
    kernel = np.bartlett(2 * radius + 3)[1:-1]
    kernel /= kernel.sum()
    padded = np.pad(values, ((radius, radius), (0, 0)), mode="edge")
    return np.column_stack([np.convolve(c, kernel, mode="valid") for c in padded.T])
