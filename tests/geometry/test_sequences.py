"""Tests of the alignment of neighbour sequences, and of its invariance to rigid motion."""

from dataclasses import replace

import numpy as np
import pytest

from sceneprint.geometry.registration.alignment import AlignmentParameters
from sceneprint.geometry.registration.sequence_alignment import SequenceParameters, _cyclic_cost
from sceneprint.geometry.rigid import inverse, pose_difference
from sceneprint.geometry.validation.validation import ValidationParameters, validate
from sceneprint.models import read_model
from tests.geometry.scenes import furnished

P = SequenceParameters()


def alignment_cost(a, b, p):
    """Share of the cost of leaving all of one out and inserting all of the other: 0 alike."""
    m, n = len(a), len(b)
    costs, rows = np.empty((max(m, 1), max(n, 1))), np.empty((3, n + 1))
    cost = _cyclic_cost(
        np.ascontiguousarray(a, float), m, np.ascontiguousarray(b, float), n,
        p.length_scale, p.angle_scale, p.gap_cost, p.swap_cost, 1.0, costs, rows,
    )  # fmt: skip
    return float(cost)


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


def test_two_views_are_aligned_by_sequences():
    """The whole of validation, with few patches drawn: the transform is found as by histograms."""
    model = read_model("paper")
    poses, (query, match) = zip(*furnished(model, 0, 36), strict=True)
    alignment = AlignmentParameters(sequence=replace(P, n_sources=40, n_coarse=40))
    p = ValidationParameters(alignment=alignment)
    result = validate(query, match, 0, p, matching="sequence")
    assert result.status == "accepted"
    metres, radians = pose_difference(result.T_match_query, inverse(poses[1]) @ poses[0])
    assert metres < 0.05
    assert radians < 0.03
    # not by the histograms behind one's back
    blank = replace(query, descriptors=np.zeros_like(query.descriptors))
    again = validate(blank, match, 0, p, matching="sequence")
    assert again.T_match_query is not None
    np.testing.assert_array_equal(again.T_match_query, result.T_match_query)
    unknown = "letters"
    with pytest.raises(ValueError, match="does not exist"):
        validate(query, match, matching=unknown)
