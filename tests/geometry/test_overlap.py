"""Tests of the overlap of two surfaces against manual results and the definition."""

import numpy as np

from sceneprint.geometry.registration import overlap as module
from sceneprint.geometry.registration.overlap import (
    OverlapParameters,
    overlap_counts,
    sample_points,
)
from sceneprint.geometry.surface import camera
from tests.geometry import scenes, validation_goldens

P = OverlapParameters()


def test_by_hand():
    validation_goldens.check_projecting(camera)
    validation_goldens.check_targets(module)
    validation_goldens.check_agreement(module)
    validation_goldens.check_agreement_of_clouds(module)
    validation_goldens.check_sampling(module)


def test_nothing_to_compare():
    corner, _ = scenes.corner()
    none = overlap_counts(np.empty((0, 6), np.float32), corner, np.eye(4), P)
    assert (none.points, none.inliers, none.violations) == (0, 0, 0)
    source = sample_points(corner, 5)
    corner.points[:] = 0.0
    unseen = overlap_counts(source, corner, np.eye(4), P)
    assert (unseen.points, unseen.inliers, unseen.violations) == (192, 0, 0)
