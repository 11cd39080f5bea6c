"""Tests that all lengths scale together: a scaled world gives the same results."""

from dataclasses import fields, is_dataclass, replace

import numpy as np
import pytest

from sceneprint.geometry.surface.cloud import CloudParameters
from sceneprint.models import ModelParameters
from sceneprint.models.model import POWERS, scale_lengths
from sceneprint.pipeline import prepare, validate
from sceneprint.types import Cloud
from tests.geometry import cloud_scenes

#: Numbers that no scale changes; a new one belongs here or in POWERS.
BARE = {
    "DepthParameters": {"same_surface", "focal_length_px"},
    "NormalParameters": {"depth_gate", "plane_gate", "minimum_spread", "minimum_cosine"},
    "SegmentationParameters": {"normal_weight", "minimum_size"},
    "HierarchyParameters": {"factor", "normal_weight"},
    "WeightParameters": {"size_exponent", "coherence_exponent"},
    "PropertyParameters": {"angular_tolerance", "colinearity"},
    "TableLayout": {"distance_exponent"},
    "CloudParameters": {
        "voxel_angle", "seed_px", "validation_seed_px", "same_surface", "range_gate",
        "plane_gate", "minimum_spread", "minimum_cosine", "image_angle", "gap_cosine",
    },
    "AcceptanceParameters": {
        "residual_rad", "violation_weight", "evidence", "plane_overlap", "strong", "weak",
        "ambiguous", "ambiguous_share", "stiffness", "blind_ambiguous_share",
        "blind_evidence", "blind_plane_overlap", "net_weight", "net", "net_strong", "planes",
        "many_planes", "many_planes_net", "plane_violations", "worst_violations", "sparse_evidence",
        "sparse_plane_overlap", "sparse_planes", "sparse_plane_violations",
        "sparse_worst_violations", "alone_planes",
        "apart_rad", "apart_planes", "apart_plane_overlap", "sliced_planes",
        "sliced_violations", "sliced_plane_violations",
    },
    "AmbiguityParameters": {
        "same_direction", "least_crossing", "hopeful_share", "hopeful_violations", "refuted",
        "rival_rad",
    },
    "PlaneParameters": {"coplanar"},
    "RefinementParameters": {"normal_cosine"},
    "AlignmentParameters": {"violation_weight", "rank_violations", "same_rad"},
    "GravityParameters": {"gate", "proposed_tilt", "refined_tilt", "rival_tilt", "floor_tilt"},
    "PlanParameters": {
        "tilt", "blur", "flat_weight", "slice_blur", "slice_trend", "slice_share", "slice_margin",
        "slice_distance",
    },
    "ConsensusParameters": {"angle_tolerance", "inlier_cosine"},
    "SequenceParameters": {"angle_scale", "gap_cost", "swap_cost"},
    "OverlapParameters": {"normal_cosine"},
    "CovarianceParameters": {"independent", "free"},
    "ValidationParameters": {"guided_rad"},
}  # fmt: skip


def leaves(record):
    results = []
    for field in fields(record):
        value = getattr(record, field.name)
        if is_dataclass(value):
            results += leaves(value)
        elif isinstance(value, float):
            results.append((type(record), field.name))
    return results


def test_every_number_is_a_length_or_bare():
    unknown = [
        (kind.__name__, name)
        for kind, name in leaves(ModelParameters())
        if name not in POWERS.get(kind, {}) and name not in BARE.get(kind.__name__, set())
    ]
    assert unknown == []
    for kind, powers in POWERS.items():
        assert set(powers) <= {field.name for field in fields(kind)}
        assert not set(powers) & BARE.get(kind.__name__, set())


def test_scaled_by_hand():
    p = scale_lengths(ModelParameters(), 4.0)
    assert p.properties.radius == 12.0
    assert p.cloud.noise_gate == CloudParameters().noise_gate / 4
    assert p.validation.alignment.consensus.normal_weight == pytest.approx(0.05 * 16)
    assert (
        p.validation.rivals.first.first_gate
        == ModelParameters().validation.rivals.first.first_gate * 4
    )
    assert p.hierarchy == ModelParameters().hierarchy
    assert scale_lengths(p, 0.25) == ModelParameters()


def test_a_larger_world_signs_and_validates_the_same(small_signer):
    """A power of two changes no digit of a float: so the bytes are the same."""
    model = small_signer.model
    small = replace(model.parameters, cloud=CloudParameters(voxel_angle=0.02, image_angle=0.02))
    step = np.array([0.12, -0.1, 0.05])
    R = cloud_scenes.rotation(1)
    here = cloud_scenes.in_room(cloud_scenes.directions(30_000, 1, 75))[0]
    there = (cloud_scenes.in_room(cloud_scenes.directions(30_000, 2, 80))[0] - step) @ R.T
    results = []
    for factor in (1.0, 8.0):
        larger = replace(
            small_signer, model=replace(model, parameters=scale_lengths(small, factor))
        )
        results.append(
            [prepare(Cloud((one * factor).astype(np.float32)), larger) for one in (here, there)]
        )
    for (a, _), (b, _) in zip(*results, strict=True):
        assert a.n_patches == b.n_patches
        np.testing.assert_allclose(a.vector.astype(int), b.vector.astype(int), atol=1)
    rivals_allowed = replace(small.validation.acceptance, ambiguous=9.0, ambiguous_share=9.0)
    p = replace(small.validation, acceptance=rivals_allowed)
    first = validate(results[0][0][1], results[0][1][1], 3, p)
    second = validate(results[1][0][1], results[1][1][1], 3, scale_lengths(p, 8.0))
    assert (first.status, first.strength) == (second.status, second.strength)
    np.testing.assert_allclose(second.T_match_query[:3, :3], first.T_match_query[:3, :3], atol=1e-5)
    np.testing.assert_allclose(
        second.T_match_query[:3, 3], 8 * first.T_match_query[:3, 3], atol=1e-4
    )
    for name in ("overlap", "plane_overlap", "violations", "ambiguity"):
        assert getattr(second, name) == pytest.approx(getattr(first, name), abs=1e-3)
    assert second.residual_m == pytest.approx(8 * first.residual_m, abs=1e-4)
    assert first.covariance is not None
    assert second.covariance is not None
    size = np.sqrt(np.diag(second.covariance) / np.diag(first.covariance))
    np.testing.assert_allclose(size, [8, 8, 8, 1, 1, 1], rtol=0.01)
