"""Tests of the alignment of neighbour sequences, and of its invariance to rigid motion."""

from dataclasses import replace

import numpy as np
import pytest

from sceneprint.geometry.registration.alignment import AlignmentParameters
from sceneprint.geometry.registration.sequence_alignment import (
    SequenceParameters,
    _cyclic_cost,
    coarse_patches,
    neighbour_sequences,
    sequence_correspondences,
)
from sceneprint.geometry.rigid import inverse, pose_difference, transform_points
from sceneprint.geometry.validation.validation import ValidationParameters, validate
from sceneprint.models import read_model
from sceneprint.pipeline import geometry_of
from sceneprint.signing import see
from sceneprint.types import DepthFrame, Patches
from sceneprint_lab.synth import KINECT, take, trajectory
from sceneprint_lab.synth.dataset import room_and_rng

P = SequenceParameters()


def patches_at(means, normals, areas=None):
    count = len(means)
    return Patches(
        np.asarray(means, float),
        normals / np.linalg.norm(normals, axis=1, keepdims=True),
        np.ones(count) if areas is None else areas,
        np.full(count, 50, np.int32),
        np.ones(count),
    )


def scattered(seed, count):
    rng = np.random.default_rng(seed)
    means, normals = rng.uniform(-1.5, 1.5, (count, 3)), rng.normal(size=(count, 3))
    return patches_at(means, normals, rng.uniform(0.01, 0.1, count))


def carried(patches, T):
    return replace(
        patches, means=transform_points(T, patches.means), normals=patches.normals @ T[:3, :3].T
    )


def motion(seed):
    rng = np.random.default_rng(seed)
    R, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    T = np.eye(4)
    T[:3, :3] = R * np.linalg.det(R)
    T[:3, 3] = rng.uniform(-3, 3, 3)
    return T


def alignment_cost(a, b, p):
    """Share of the cost of leaving all of one out and inserting all of the other: 0 alike."""
    m, n = len(a), len(b)
    costs, rows = np.empty((max(m, 1), max(n, 1))), np.empty((3, n + 1))
    cost = _cyclic_cost(
        np.ascontiguousarray(a, float), m, np.ascontiguousarray(b, float), n,
        p.length_scale, p.angle_scale, p.gap_cost, p.swap_cost, 1.0, costs, rows,
    )  # fmt: skip
    return float(cost)


def symbols(seed, count):
    """Neighbours that are alike often enough for every kind of edit to pay."""
    rng = np.random.default_rng(seed)
    kinds = rng.uniform(-0.5, 0.5, (5, 4))
    return kinds[rng.integers(0, 5, count)] + rng.normal(0, 0.05, (count, 4))


def test_the_edits_by_hand():
    a = np.arange(4.0)[:, None] * np.ones(4)  # every two of them others: 1 m and 1 rad apart
    whole = 8 * P.gap_cost
    assert alignment_cost(a, a, P) == 0.0
    assert alignment_cost(a, a[[2, 3, 0, 1]], P) == 0.0  # begun elsewhere
    assert alignment_cost(a, a[:3], P) == pytest.approx(P.gap_cost / (7 * P.gap_cost))
    assert alignment_cost(a, a[[0, 2, 1, 3]], P) == pytest.approx(P.swap_cost / whole)
    off = a.copy()
    off[1, 0] += 0.5 * P.length_scale  # half a scale of one number of four is a quarter
    assert alignment_cost(a, off, P) == pytest.approx(0.25 / whole)
    assert alignment_cost(a, a + 100.0, P) == 1.0  # nothing in common
    assert alignment_cost(a, a[:0], P) == 1.0


def test_golden():
    """Every number of the alignment at once: changed only on purpose."""
    source, target = scattered(40, 50), carried(scattered(40, 50), motion(3))
    p = replace(P, n_sources=6, n_coarse=20)
    pairs = sequence_correspondences(source, target, np.random.default_rng(0), p)
    nearest = [[2, 37, 5], [12, 27, 33], [15, 7, 37], [24, 48, 47], [29, 43, 34], [38, 24, 29]]
    assert pairs.tolist() == [[own[0], one] for own in nearest for one in own]
    # which are the nearest of all, without the bounds that spare most of the alignments
    of_source, of_target = (
        [one.symbols[i, : one.lengths[i]] for i in range(50)]
        for one in (neighbour_sequences(a, coarse_patches(a, p), p) for a in (source, target))
    )
    for own in nearest:
        cost = [alignment_cost(of_source[own[0]], one, p) for one in of_target]
        assert np.argsort(cost)[:3].tolist() == own
    costs = [round(alignment_cost(symbols(k, 9), symbols(k + 50, 11), P), 9) for k in range(4)]
    assert costs == [0.904202517, 0.805803733, 0.744911764, 0.850303579]


def test_two_views_are_aligned_by_sequences():
    """The whole of validation, with few patches drawn: the transform is found as by histograms."""
    model = read_model("paper")
    room, rng = room_and_rng(11, 0)
    poses = trajectory(room, 61, rng)[12:36:12]
    query, match = (
        geometry_of(see(DepthFrame(take(room, T, KINECT, rng), KINECT), model.parameters), model)
        for T in poses
    )
    alignment = AlignmentParameters(sequence=replace(P, n_sources=40, n_coarse=40))
    p = ValidationParameters(alignment=alignment)
    found = validate(query, match, 0, p, matching="sequence")
    assert found.status == "accepted"
    metres, radians = pose_difference(found.T_match_query, inverse(poses[1]) @ poses[0])
    assert metres < 0.05
    assert radians < 0.03
    # not by the histograms behind one's back
    blank = replace(query, descriptors=np.zeros_like(query.descriptors))
    again = validate(blank, match, 0, p, matching="sequence")
    assert again.T_match_query is not None
    np.testing.assert_array_equal(again.T_match_query, found.T_match_query)
    unknown = "letters"
    with pytest.raises(ValueError, match="does not exist"):
        validate(query, match, matching=unknown)
