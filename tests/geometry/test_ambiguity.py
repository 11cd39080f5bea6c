"""Tests of ambiguity: motions along a room's planes, and planes that count as equal."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sceneprint.geometry.registration.overlap import (
    OverlapParameters,
    plane_agreement,
    plane_view,
    plane_weights,
)
from sceneprint.geometry.rigid import inverse, pose_difference, transform_points
from sceneprint.geometry.validation.acceptance import (
    AmbiguityParameters,
    best_alternative,
    select_rivals,
    symmetries,
)
from sceneprint.models import read_model
from tests.geometry.scenes import furnished, patches_of

P = AmbiguityParameters()


def on_planes(*planes):
    """Patches in planes of these normals, offsets, numbers of patches and area of each."""
    rng = np.random.default_rng(0)
    means, normals, areas = [], [], []
    for normal, offset, n, area in planes:
        across = np.linalg.svd(np.array([normal]))[2][1:]
        means.append(offset * np.array(normal) + rng.uniform(-2, 2, (n, 2)) @ across)
        normals.append(np.tile(normal, (n, 1)))
        areas.append(np.full(n, area))
    return patches_of(np.concatenate(means), np.concatenate(normals), np.concatenate(areas))


#: A floor 1.4 m below a camera, a wall 3 m ahead, and little of a wall 2 m to the right.
ROOM = on_planes(
    ([0, -1, 0], -1.4, 40, 0.05), ([0, 0, -1], -3.0, 25, 0.05), ([-1, 0, 0], -2.0, 3, 0.01)
)


def turns(transforms):
    """Those that turn, as vectors of their axis times degrees."""
    vectors = np.degrees(Rotation.from_matrix(transforms[:, :3, :3]).as_rotvec())
    return vectors[np.linalg.norm(vectors, axis=1) > 1]


def test_quarter_turns_about_the_middle_of_each_plane():
    transforms = symmetries(ROOM, P)
    sizes = np.linalg.norm(turns(transforms), axis=1)
    # of the floor and of the wall, which are the two main directions; of the third none
    np.testing.assert_allclose(np.sort(sizes), [90, 90, 90, 90, 180, 180], atol=1e-9)
    axes = np.abs(turns(transforms)) / sizes[:, None]
    assert sorted(axes.argmax(axis=1).tolist()) == [1, 1, 1, 2, 2, 2]
    middle = ROOM.means[:40].mean(axis=0)
    about_floor = [
        T for T in transforms if np.linalg.norm(transform_points(T, middle[None]) - middle) < 1e-9
    ]
    assert len(about_floor) == 3
    # the three of a plane are powers of the first
    powers = [np.linalg.matrix_power(about_floor[0], k) for k in (1, 2, 3)]
    for T, power in zip(about_floor, powers, strict=True):
        np.testing.assert_allclose(T, power, atol=1e-9)


def test_shifts_along_both_main_planes_go_both_ways():
    transforms = symmetries(ROOM, P)  # a floor across y and a wall across z: a corridor along x
    shifts = np.array([T[:3, 3] for T in transforms if np.allclose(T[:3, :3], np.eye(3))])
    np.testing.assert_allclose(shifts[:, 1:], 0.0, atol=1e-12)
    steps = P.shift * np.arange(1, P.n_shifts + 1)
    np.testing.assert_allclose(np.sort(shifts[:, 0]), [*-steps[::-1], *steps], atol=1e-12)


def test_planes_and_directions_are_taken_by_area():
    one = on_planes(([0, -1, 0], -1.0, 10, 0.1))
    assert len(turns(symmetries(one, P))) == 3
    # four steps of a stair, facing up or down: one direction, of which the largest three count
    stair = on_planes(*(([0, s, 0], 0.3 * k, 10 - k, 0.1) for k, s in enumerate((1, -1, 1, -1))))
    result = symmetries(stair, P)
    assert len(turns(result)) == 9
    for k, start, n, count in ((0, 0, 10, 3), (1, 10, 9, 3), (2, 19, 8, 3), (3, 27, 7, 0)):
        middle = stair.means[start : start + n].mean(axis=0)
        assert abs(middle[1]) == pytest.approx(0.3 * k)
        held = [np.linalg.norm(transform_points(T, middle[None]) - middle) < 1e-9 for T in result]
        assert sum(held) == count
    blank = on_planes(([0, -1, 0], -1.0, 10, 0.0))
    assert symmetries(blank, P).shape == (0, 4, 4)


def test_plane_weights_by_hand():
    patches = on_planes(
        ([0, -1, 0], -1.4, 8, 1.0), ([0, 0, -1], -3.0, 2, 5.0), ([0, -1, 0], -0.7, 1, 1.0)
    )
    weights = plane_weights(patches, P.planes)
    assert weights.dtype == np.float32
    # a floor of eight, a wall of two, a table top of one, whatever their areas: 1 each
    np.testing.assert_allclose(weights, [1 / 8] * 8 + [1 / 2] * 2 + [1.0])
    # two sides of a thin board face apart, and are two planes
    board = on_planes(([0, 0, -1], -2.0, 4, 1.0), ([0, 0, 1], 2.02, 4, 1.0))
    np.testing.assert_allclose(plane_weights(board, P.planes), 1 / 4)
    # 5 cm apart is one plane, 7 cm are two
    for gap, weight in ((0.05, 0.5), (0.07, 1.0)):
        two = on_planes(([0, 0, -1], -2.0, 1, 1.0), ([0, 0, -1], -2.0 - gap, 1, 1.0))
        np.testing.assert_allclose(plane_weights(two, P.planes), weight)


def test_far_from_equals_the_difference():
    rng = np.random.default_rng(1)
    T, others = np.eye(4), np.tile(np.eye(4), (300, 1, 1))
    T[:3, :3], T[:3, 3] = Rotation.random(rng=rng).as_matrix(), rng.normal(size=3)
    turn = Rotation.from_rotvec(rng.normal(0, math.radians(8), (300, 3))).as_matrix()
    others[:, :3, :3] = turn @ T[:3, :3]
    others[:, :3, 3] = T[:3, 3] + rng.normal(0, 0.12, (300, 3))
    apart = [pose_difference(T, other) for other in others]
    far = [metres > P.rival_m or radians > P.rival_rad for metres, radians in apart]
    assert 50 < sum(far) < 250
    np.testing.assert_array_equal(select_rivals(T, others, P), others[far])
    assert select_rivals(T, others[:0], P).shape == (0, 4, 4)
    assert select_rivals(T, T[None], P).shape == (0, 4, 4)


def test_free_space_refutes_no_rival_for_what_it_holds_against_the_transform_too():
    model, overlap_p = read_model("depth"), OverlapParameters()
    poses, seen = zip(*furnished(model, 0, 36), strict=True)
    views = [plane_view(view, P.planes) for view in seen]
    T = inverse(poses[1]) @ poses[0]
    # slid by 0.3 m each way along each axis: they agree with what lies along it, and violate
    shifts = np.tile(np.eye(4), (6, 1, 1))
    shifts[:, :3, 3] = 0.3 * np.concatenate([np.eye(3), -np.eye(3)])
    voted = shifts @ T
    agreed = plane_agreement(*views, voted, overlap_p)
    assert (agreed.violations > P.refuted).any()
    none = np.empty((0, 4, 4))
    shares = [
        best_alternative(*views, T, violations, voted, none, P, overlap_p)[0]
        for violations in (0.0, 1.0)
    ]
    # of a transform that violates everything no rival is refuted: the one that agrees most counts
    assert shares[1] >= agreed.share.max()
    assert shares[0] < agreed.share.max()
