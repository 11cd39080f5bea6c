"""Tests of session differences: a box in front of a wall that appears, disappears or stays."""

import numpy as np

from sceneprint.geometry.cells import (
    CHANGED,
    SAME,
    UNSEEN,
    ViewStamp,
    cell_positions,
    cell_states,
    count_cells,
    empty_counts,
    frame_verdicts,
    merge_views,
    view_cells,
)
from sceneprint.geometry.registration.overlap import OverlapParameters
from sceneprint.geometry.rigid import transform_points
from sceneprint.types import Intrinsics
from sceneprint_client.surface_encoding import NO_SESSION
from tests.geometry import scenes

P = OverlapParameters()
CAMERA = Intrinsics(160, 120, 140.0, 140.0, 79.5, 59.5)
CELL_M = 0.05
WALL_M, BOX_M = 3.0, 2.0
#: Pixels of the box's front; far from those of the picture's edge.
BOX = (slice(40, 80), slice(60, 100))


def view(*, box):
    """A wall that faces the camera, with the front of a box before it, or without."""
    q = np.full((CAMERA.height, CAMERA.width), 1.0 / WALL_M)
    if box:
        q[BOX] = 1.0 / BOX_M
    normals = np.zeros((*q.shape, 3))
    normals[..., 2] = -1.0
    return scenes.lifted(CAMERA, q, normals)


def poses(count):
    """Sensors a centimetre apart, half a million metres from where the parent frame begins."""
    results = []
    for i in range(count):
        T = np.eye(4)
        T[:3, 3] = (500_000.0 + 0.01 * i, -4_000_000.0, 30.0)
        results.append(T)
    return results


def cells_of(surface, sensors):
    points = surface.points[surface.valid].astype(np.float64)
    views = [
        view_cells(transform_points(T, points), CELL_M, ViewStamp(i, None, NO_SESSION))
        for i, T in enumerate(sensors)
    ]
    return merge_views(merge_views({}, views[:1]), views[1:])


def judged(cells, other, sensors):
    """States of cells by what sensors of the other session see, and their depths."""
    positions = cell_positions(cells, CELL_M)
    counts = empty_counts(len(positions))
    for T in sensors:
        counts.add(frame_verdicts(positions, other, T, P))
    return cell_states(counts, len(sensors)), positions[:, 2] - 30.0


def test_a_box_that_was_added_is_new_and_the_wall_behind_it_is_not_gone():
    empty, full = view(box=False), view(box=True)
    sensors = poses(3)
    states, depths = judged(cells_of(full, sensors), empty, sensors)
    of_box = depths < 2.5
    assert np.isclose(depths[of_box], BOX_M, atol=1e-2).all()
    assert (states[of_box] == CHANGED).all()
    assert of_box.sum() > 100
    assert not (states[~of_box] == CHANGED).any()
    wall, _ = judged(cells_of(empty, sensors), full, sensors)
    assert not (wall == CHANGED).any()
    assert (wall == UNSEEN).sum() > 100  # what the box hides
    assert (wall == SAME).sum() > 1000


def test_one_frame_of_several_is_not_enough_and_one_that_agrees_decides():
    empty, full = view(box=False), view(box=True)
    (sensor,) = poses(1)
    cells = cells_of(full, [sensor])
    positions = cell_positions(cells, CELL_M)
    of_box = positions[:, 2] - 30.0 < 2.5
    counts = empty_counts(len(positions))
    counts.add(frame_verdicts(positions, empty, sensor, P))
    assert (cell_states(counts, 1)[of_box] == CHANGED).all()  # the only frame there is
    assert (cell_states(counts, 2)[of_box] == UNSEEN).all()
    counts.add(frame_verdicts(positions, empty, sensor, P))
    assert (cell_states(counts, 2)[of_box] == CHANGED).all()
    counts.add(frame_verdicts(positions, full, sensor, P))
    assert (cell_states(counts, 3)[of_box] == SAME).all()
    assert (cell_states(empty_counts(2), 0) == UNSEEN).all()


def test_cells_lie_at_the_mean_of_what_frames_saw_in_them():
    points = np.array([[0.01, 0.0, 0.0], [0.03, 0.04, 0.0], [-0.01, 0.0, 0.2]])
    cells = merge_views({}, [view_cells(points, CELL_M, ViewStamp(0, None, NO_SESSION))])
    assert count_cells(cells) == 2
    result = cell_positions(cells, CELL_M)
    np.testing.assert_allclose(result, [[-0.01, 0.0, 0.2], [0.02, 0.02, 0.0]], atol=CELL_M / 256)
