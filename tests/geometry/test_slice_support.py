"""Tests of the support for a transform by points above the ground, and of its refinement."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from sceneprint.geometry.registration.plan_search import (
    PlanParameters,
    ScanPlan,
    slice_correlation,
    slice_hypotheses,
)
from sceneprint.geometry.registration.slice_support import (
    measure_distinctness,
    refine_by_points,
    refine_by_slices,
    split_correlations,
)
from sceneprint.geometry.rigid import inverse, pose_difference
from sceneprint.geometry.validation.acceptance import (
    AcceptanceParameters,
    Evidence,
    sliced_evidence_suffices,
)
from sceneprint.geometry.validation.validation import validate
from sceneprint.models import read_model
from sceneprint.pipeline import geometry_of
from sceneprint.signing import see
from sceneprint_lab.synth import synthesise_survey

P = PlanParameters(cell=0.5)
UP = np.array([0.0, 0.0, 1.0])


def shifted(x, y=0.0, z=0.0, degrees=0.0):
    T = np.eye(4)
    T[:2, :2] = [
        [math.cos(math.radians(degrees)), -math.sin(math.radians(degrees))],
        [math.sin(math.radians(degrees)), math.cos(math.radians(degrees))],
    ]
    T[:3, 3] = x, y, z
    return T


def plan_of(points, R=None, slices=None):
    """A plan of points in the sensor's coordinates, all in the first slice."""
    R = np.eye(3) if R is None else R
    level = (points @ R.T).astype(np.float32)
    n = 2 * round(P.height_range / P.height_step)
    slices = np.ones(len(points), np.uint8) if slices is None else slices
    return ScanPlan(R, level, 0 * level, slices, np.ones(P.n_yaws), np.ones((2, n)))


def test_correlations_are_split_by_hand():
    T = shifted(20)
    hypotheses = np.stack([
        shifted(23.9, z=9),  # near: within 4 m, heights aside
        shifted(20, degrees=7.9),  # near: within 1.6 steps of yaw, 8 degrees
        shifted(24.1), shifted(20, degrees=8.1),  # not near
        shifted(4.9), shifted(-4.9),  # scanners within 5 m of each other
    ])  # fmt: skip
    values = np.array([3.0, 4.0, 1.0, 2.0, 9.0, 8.0])
    assert split_correlations(T, hypotheses, values, UP, P) == (4.0, 2.0)
    assert split_correlations(shifted(60), hypotheses, values, UP, P) == (0.0, 4.0)
    assert split_correlations(shifted(6), hypotheses, values, UP, P) == (0.0, 4.0)
    # hypotheses that were not kept may correlate as much as the last one
    only, lowest = hypotheses[[0, 4, 5]], np.array([3.0, 9.0, 2.0])
    assert split_correlations(T, only, lowest, UP, P) == (3.0, 2.0)


def nearest_pairs_step(a, b, T):
    """One step of point-to-point ICP in both directions, by k-d trees and an SVD."""
    pairs = []
    for points, onto, move in ((a, b, T), (b, a, inverse(T))):
        moved = points @ move[:3, :3].T + move[:3, 3]
        distance, index = cKDTree(onto).query(moved)
        own = np.flatnonzero(distance < 1.0)
        chosen = (points[own], onto[index[own]], (1 - distance[own] ** 2) ** 2)
        pairs.append(chosen if points is a else (chosen[1], chosen[0], chosen[2]))
    x, y, w = (np.concatenate(parts) for parts in zip(*pairs, strict=True))
    x0, y0 = np.average(x, 0, w), np.average(y, 0, w)
    U, _, Vt = np.linalg.svd((w[:, None] * (y - y0)).T @ (x - x0))
    result = np.eye(4)
    result[:3, :3] = U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt
    result[:3, 3] = y0 - result[:3, :3] @ x0
    return result


def test_points_are_refined_as_by_naive_icp():
    rng = np.random.default_rng(1)
    a = rng.uniform(-20, 20, (600, 3)) * [1, 1, 0.1]
    true = shifted(12, -5, 0.3, 25)
    true[:3, :3] = Rotation.from_rotvec([0.02, -0.01, 0.0]).as_matrix() @ true[:3, :3]
    b = a[:500] @ true[:3, :3].T + true[:3, 3] + rng.normal(0, 0.05, (500, 3))
    first = true.copy()
    first[:3, :3] = Rotation.from_rotvec([-0.01, 0.01, 0.02]).as_matrix() @ first[:3, :3]
    first[:3, 3] += 0.3, 0.2, -0.2
    expected = first
    for _ in range(16):
        expected = nearest_pairs_step(a, b, expected)
    tilted = shifted(0, degrees=30)[:3, :3]  # level axes of the source that are not the sensor's
    ground = np.concatenate([a, rng.uniform(-20, 20, (300, 3))])  # outside all slices
    slices = (np.arange(900) < 600).astype(np.uint8)
    refined = refine_by_points(plan_of(ground, tilted, slices), plan_of(b), first, P)
    np.testing.assert_allclose(refined, expected, atol=1e-5)
    metres, radians = pose_difference(refined, true)
    assert metres < 0.03
    assert math.degrees(radians) < 0.1


def test_points_that_do_not_correspond_refine_nothing():
    a = np.random.default_rng(2).uniform(-20, 20, (300, 3))
    for shift in ([0.0, 0.0, 50.0], [90.0, 0.0, 0.0]):
        assert refine_by_points(plan_of(a), plan_of(a + np.array(shift)), np.eye(4), P) is None


def test_distinctness_compares_a_transform_with_all_others():
    points = np.random.default_rng(3).uniform(-40, 40, (400, 3)) * [1, 1, 0.1]
    true = shifted(9, 0.4, 0.2, 3)
    source, target = plan_of(points), plan_of(points @ true[:3, :3].T + true[:3, 3])
    first = shifted(9.3, 0.2, 0.0, 2.5)

    def refine(near, elsewhere, T=first, p=P):
        pair = np.stack([shifted(9, degrees=5), shifted(-20)])
        return refine_by_slices(source, target, T, pair, np.array([near, elsewhere]), p)

    exact = slice_correlation(source, target, true, P)
    assert exact > 2  # above the values below, which are those of the nearest yaw
    for elsewhere in (exact / 1.41, 0.99 * exact):
        refined, distinctness = refine(0.75 * elsewhere, elsewhere)
        np.testing.assert_allclose(refined, true, atol=1e-3)
        assert distinctness == pytest.approx(exact / elsewhere, rel=0.01)
    assert refine(1.41 * exact, exact)[1] == pytest.approx(1.41)
    refined, distinctness = refine(0.69, 1.0)  # much less than elsewhere
    assert (refined is first, distinctness) == (True, 0.0)
    # the hypothesis is near the transform, but not near what that is refined to
    near = np.stack([shifted(5, -0.5), shifted(-20)])
    refined, distinctness = refine_by_slices(
        source, target, shifted(8.4, 0.2, 0.0, 2.5), near, np.array([2 * exact, exact]), P
    )
    np.testing.assert_allclose(refined, true, atol=1e-3)
    assert distinctness == pytest.approx(0.5, rel=0.01)
    apart = replace(P, slice_distance=19.0)  # 9.5 m
    refined, distinctness = refine(1.0, 0.1, p=apart)
    assert (refined is first, distinctness) == (True, 0.0)
    measured = measure_distinctness(source, target, true, P)
    hypotheses, values = slice_hypotheses(source, target, P)
    places = hypotheses[:, :2, 3]
    elsewhere = np.linalg.norm(places - true[:2, 3], axis=1) > 4
    elsewhere &= np.linalg.norm(places, axis=1) >= 5  # at close scanners, all points correlate
    assert measured == pytest.approx(exact / values[elsewhere].max())
    assert measure_distinctness(source, target, shifted(-20), P) == 0.0
    assert measure_distinctness(source, target, true, apart) == 0.0
    nowhere = shifted(9, z=50)  # no points correspond
    refined, distinctness = refine(1.0, 0.1, T=nowhere)
    assert (refined is nowhere, distinctness) == (True, 0.0)


A = AcceptanceParameters()
SUPPORTED = Evidence(
    A.residual_m, A.residual_rad, 0.03, 0.03, A.sliced_violations, A.stiffness,
    planes=A.sliced_planes, plane_violations=A.sliced_plane_violations,
)  # fmt: skip


def test_little_evidence_suffices_if_slices_support_a_transform():
    assert sliced_evidence_suffices(SUPPORTED, A)
    for field, value in {
        "residual_m": 1.01 * A.residual_m, "residual_rad": 1.01 * A.residual_rad,
        "violations": 1.01 * A.sliced_violations, "planes": 0.99 * A.sliced_planes,
        "plane_violations": 1.01 * A.sliced_plane_violations, "stiffness": 0.99 * A.stiffness,
        "one_sided": True,
    }.items():  # fmt: skip
        assert not sliced_evidence_suffices(replace(SUPPORTED, **{field: value}), A), field
    assert not sliced_evidence_suffices(replace(SUPPORTED, violations=None), A)


def test_distant_scans_of_a_street_are_accepted_by_their_points_above_the_ground():
    clouds = synthesise_survey(9800, 8, 5, kind="block").clouds
    model = read_model("lidar")
    query, match = (geometry_of(see(clouds[k], model.parameters), model) for k in (4, 2))
    true = inverse(clouds[2].pose) @ clouds[4].pose
    assert np.linalg.norm(true[:3, 3]) > 5
    numbers = model.parameters.validation
    result = validate(query, match, 0, numbers)
    assert (result.status, result.strength) == ("accepted", "weak")
    assert result.distinctness > numbers.alignment.plan.slice_margin
    assert "points above the ground" in result.reason
    metres, radians = pose_difference(result.T_match_query, true)
    assert metres < 0.2  # measured: .03
    assert math.degrees(radians) < 1
    # with a margin that nothing reaches, the overlap is too small
    plan = replace(numbers.alignment.plan, slice_margin=100.0)
    without = replace(numbers, alignment=replace(numbers.alignment, plan=plan))
    assert validate(query, match, 0, without).status == "rejected"


def test_scans_that_see_a_part_are_measured_if_planes_agree():
    clouds = synthesise_survey(9800, 8, 5, kind="block").clouds
    model = read_model("lidar")
    parts = {}
    for k in (0, 2, 3):
        x, y, _ = (clouds[k].points @ clouds[k].pose[:3, :3].T).T
        ahead = np.abs(np.degrees(np.arctan2(y, x))) < 120  # two thirds of a turn
        part = replace(clouds[k], points=clouds[k].points[ahead])
        parts[k] = geometry_of(see(part, model.parameters), model)
    numbers = model.parameters.validation
    result = validate(parts[2], parts[0], 0, numbers)
    assert not result.around
    assert pose_difference(result.T_match_query, inverse(clouds[0].pose) @ clouds[2].pose)[0] < 0.5
    assert result.distinctness > 1.5  # measured: 2.6
    apart = validate(parts[3], parts[0], 0, numbers)
    assert (apart.planes < numbers.acceptance.sliced_planes, apart.distinctness) == (True, 0.0)
