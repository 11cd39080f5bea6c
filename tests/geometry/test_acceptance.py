"""Tests of the acceptance of a transform on both sides of every threshold."""

import math
from dataclasses import replace

import numpy as np
import pytest

from sceneprint.geometry.registration.alignment import AlignmentParameters, FrameSamples, _score
from sceneprint.geometry.registration.overlap import OverlapParameters, PlaneView, agreements
from sceneprint.geometry.validation.acceptance import (
    AcceptanceParameters,
    Evidence,
    belief,
    objection,
    sparse_evidence_suffices,
)
from sceneprint.types import Geometry, Intrinsics, Surface
from sceneprint_lab.training import preset_parameters
from tests.geometry.scenes import patches_of

NO_PATCHES = patches_of([], [])
NO_WEIGHTS = np.zeros(0, np.float32)
P = AcceptanceParameters()
GOOD = Evidence(0.01, 0.01, 0.6, 0.5, 0.01, 1e-3)


def test_what_is_good_meets_no_objection():
    assert objection(GOOD, P, "full") is None
    # overlap less five times the violations
    assert GOOD.total(P) == pytest.approx(0.55)
    status, strength, _ = belief(GOOD, 0.0, P)
    assert (status, strength) == ("accepted", "strong")


@pytest.mark.parametrize(
    ("worse", "just", "status", "reason"),
    [
        ({"residual_m": 0.081}, {"residual_m": 0.079}, "rejected", "disagree by 0.081 m"),
        (
            {"residual_rad": math.radians(5.1)}, {"residual_rad": math.radians(4.9)},
            "rejected", "5.1 deg",
        ),
        ({"overlap": 0.24}, {"overlap": 0.26}, "rejected", "1.0% of the points lie"),
        ({"overlap": 0.19}, {"overlap": 0.26}, "rejected", "only 19% of the surfaces"),
        ({"violations": 0.09}, {"violations": 0.07}, "rejected", "9.0% of the points"),
        ({"plane_overlap": 0.14}, {"plane_overlap": 0.16}, "rejected", "mostly one plane agrees"),
        # plane overlap less three times the violations
        (
            {"plane_overlap": 0.159, "violations": 0.02}, {"plane_overlap": 0.161},
            "rejected", "plane overlap is 16%, but 2.0% of the points",
        ),
        ({"stiffness": 9e-6}, {"stiffness": 1.1e-5}, "ambiguous", "do not constrain one direction"),
    ],
)  # fmt: skip
def test_each_objection_has_its_threshold(worse, just, status, reason):
    result = objection(replace(GOOD, **worse), P, "full")
    assert result[0] == status
    assert reason in result[1]
    assert objection(replace(GOOD, **just), P, "full") is None
    # the paper checks the residual only
    alone = objection(replace(GOOD, **worse), P, "paper")
    assert (alone is not None) == ("disagree" in result[1])


@pytest.mark.parametrize(
    ("worse", "just", "status", "reason"),
    [
        (
            {"worst_violations": 0.051}, {"worst_violations": 0.049},
            "rejected", "5.1% of the points lie where the other frame saw",
        ),
        (
            {"plane_violations": 0.081}, {"plane_violations": 0.079},
            "rejected", "8.1% of the points lie where the other frame saw",
        ),
        ({"planes": 5.4}, {"planes": 6.1}, "ambiguous", "only 5 distinct planes agree"),
    ],
)  # fmt: skip
def test_scans_are_held_to_more(worse, just, status, reason):
    scans = preset_parameters("lidar")[0].validation.acceptance
    result = objection(replace(GOOD, **worse), scans, "full")
    assert result[0] == status
    assert reason in result[1]
    assert objection(replace(GOOD, **just), scans, "full") is None
    # of depth images the last two decide nothing
    assert (objection(replace(GOOD, **worse), P, "full") is None) == (
        "worst_violations" not in worse
    )


def test_scans_may_share_little_but_not_against_free_space():
    scans = preset_parameters("lidar")[0].validation.acceptance
    little = replace(GOOD, overlap=0.06, plane_overlap=0.16, violations=0.0, planes=10.0)
    assert objection(little, scans, "full") is None
    assert belief(little, 0.0, scans)[:2] == ("accepted", "strong")
    assert belief(replace(little, plane_overlap=0.14), 0.0, scans)[:2] == ("accepted", "weak")
    result = objection(replace(little, violations=0.025), scans, "full")
    assert result == (
        "rejected",
        "the plane overlap is 16%, but 2.5% of the points lie where the other frame saw free space",
    )
    # less is enough if more than ten planes agree
    many = replace(little, planes=10.1, violations=0.033)
    assert objection(many, scans, "full") is None
    assert belief(many, 0.0, scans)[:2] == ("accepted", "weak")
    assert objection(replace(many, violations=0.034), scans, "full") is not None


SPARSE = Evidence(0.01, 0.01, 0.15, 0.2, 0.004, 1e-3, planes=8.0, worst_violations=0.01)


@pytest.mark.parametrize(
    ("worse", "just"),
    [
        ({"residual_m": 0.081}, {"residual_m": 0.079}),
        ({"residual_rad": math.radians(5.1)}, {"residual_rad": math.radians(4.9)}),
        # overlap less five times the violations: .119 - .02 and .121 - .02
        ({"overlap": 0.119}, {"overlap": 0.121}),
        ({"plane_overlap": 0.099, "violations": 0.0}, {"plane_overlap": 0.101, "violations": 0.0}),
        # plane overlap less three times the violations: .13 - .0303 and .13 - .0297
        (
            {"plane_overlap": 0.13, "violations": 0.0101, "overlap": 0.2},
            {"plane_overlap": 0.13, "violations": 0.0099, "overlap": 0.2},
        ),
        ({"planes": 4.9}, {"planes": 5.1}),
        ({"plane_violations": 0.061}, {"plane_violations": 0.059}),
        ({"worst_violations": 0.031}, {"worst_violations": 0.029}),
        ({"stiffness": 9e-6}, {"stiffness": 1.1e-5}),
        ({"one_sided": True}, {"one_sided": False}),
        ({"violations": None}, {"violations": 0.0}),
    ],
)
def test_little_evidence_must_be_good_in_every_respect(worse, just):
    assert sparse_evidence_suffices(SPARSE, 0.02, P)
    # the evidence that a match usually needs, it has not
    assert objection(SPARSE, P, "full") == ("rejected", "only 15% of the surfaces agree")
    assert not sparse_evidence_suffices(replace(SPARSE, **worse), 0.02, P)
    assert sparse_evidence_suffices(replace(SPARSE, **just), 0.02, P)


def test_one_search_alone_needs_another_plane():
    assert sparse_evidence_suffices(replace(SPARSE, planes=6.1), 0.02, P, alone=True)
    assert not sparse_evidence_suffices(replace(SPARSE, planes=5.9), 0.02, P, alone=True)


APART = replace(SPARSE, residual_m=0.15, plane_overlap=0.25, planes=13.0)


@pytest.mark.parametrize(
    ("worse", "just"),
    [
        ({"residual_m": 0.21}, {"residual_m": 0.19}),
        ({"residual_rad": math.radians(4.1)}, {"residual_rad": math.radians(3.9)}),
        ({"planes": 11.9}, {"planes": 12.1}),
        ({"plane_overlap": 0.19}, {"plane_overlap": 0.21}),
        ({"worst_violations": 0.051}, {"worst_violations": 0.049}),
        ({"plane_violations": 0.061}, {"plane_violations": 0.059}),
    ],
)
def test_refinements_that_settle_apart_need_many_planes(worse, just):
    assert sparse_evidence_suffices(replace(APART, **just), 0.1, P, alone=True)
    assert not sparse_evidence_suffices(replace(APART, **worse), 0.1, P, alone=True)
    # two searches that disagree by as much have found two places
    assert not sparse_evidence_suffices(replace(APART, **just), 0.1, P)


def test_little_evidence_must_fix_the_transform():
    assert sparse_evidence_suffices(SPARSE, 0.044, P)
    assert not sparse_evidence_suffices(SPARSE, 0.046, P)


def test_one_direction_alone_is_not_believed():
    alone = replace(GOOD, residual_m=math.inf, residual_rad=math.inf)
    result = objection(alone, P, "full")
    assert result == ("rejected", "only one of the two directions found a transform")


@pytest.mark.parametrize(
    ("ambiguity", "changed", "status", "strength"),
    [
        (0.049, {}, "accepted", "strong"),
        (0.051, {}, "accepted", "weak"),
        (0.139, {}, "accepted", "weak"),
        (0.141, {}, "ambiguous", None),
        # half of what the transform itself explains by planes
        (0.079, {"plane_overlap": 0.16}, "accepted", "weak"),
        (0.081, {"plane_overlap": 0.16}, "ambiguous", None),
        (0.0, {"overlap": 0.34}, "accepted", "weak"),
        (0.0, {"overlap": 0.36}, "accepted", "strong"),
        (0.0, {"violations": 0.061}, "accepted", "weak"),
    ],
)
def test_rivals_and_little_agreement_weaken(ambiguity, changed, status, strength):
    assert belief(replace(GOOD, **changed), ambiguity, P)[:2] == (status, strength)


def wall(z):
    """A wall square to the camera, which sees it in 40 x 30 pixels."""
    k = Intrinsics(40, 30, 40.0, 40.0, 19.5, 14.5)
    y, x = np.mgrid[:30, :40].astype(np.float32)
    points = np.stack([(x - k.cx) / k.fx * z, (y - k.cy) / k.fy * z, np.full_like(x, z)], axis=-1)
    normals = np.tile(np.array([0, 0, -1], np.float32), (30, 40, 1))
    one = np.ones((30, 40), np.float32)
    return Surface(points.astype(np.float32), normals, one > 0, one, k)


def _frame(surface):
    return Geometry(surface, NO_PATCHES, np.zeros((0, 8), np.uint8), "")


def test_a_violation_costs_three_inliers():
    p, seen = OverlapParameters(), wall(2.0)
    on, before = np.zeros((5, 6), np.float32), np.zeros((2, 6), np.float32)
    on[:, 2], before[:, 2] = 2.0, 1.0  # on the wall, and a metre before it
    source = np.concatenate([on, before])
    source[:, 5] = -1.0
    assert agreements(source, seen, np.eye(4)[None], p).tolist() == [[5.0, 2.0]]
    # a share of all points; and the wall's own, of which every one is on it
    wall_points = np.zeros((4, 6), np.float32)
    wall_points[:, 2], wall_points[:, 5] = 2.0, -1.0
    frames = [
        FrameSamples(_frame(surface), points, PlaneView(surface, NO_PATCHES, points, NO_WEIGHTS))
        for surface, points in ((seen, source), (seen, wall_points))
    ]
    every = AlignmentParameters(score_stride=1)
    scores = _score(frames[0], frames[1], np.eye(4)[None], every, p)
    assert scores == pytest.approx([(5 - 3 * 2) / 7 + 4 / 4])


def test_evidence_at_every_limit_suffices():
    p = AcceptanceParameters(violation_weight=0.0, net_weight=0.0, net=0.15, planes=5.0)
    e = Evidence(
        p.residual_m, p.residual_rad, p.evidence, p.plane_overlap, 0.0, p.stiffness,
        planes=p.planes, plane_violations=p.plane_violations, worst_violations=p.worst_violations,
    )  # fmt: skip
    assert objection(e, p, "full") is None
