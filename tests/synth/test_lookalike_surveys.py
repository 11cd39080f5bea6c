"""Tests of laser scans of ambiguous sites: reproducibility and similarity."""

import numpy as np
import pytest

from sceneprint_lab.synth import synthesise_lookalike_survey
from sceneprint_lab.synth.large_scenes import symmetric_hall
from sceneprint_lab.synth.lookalike_surveys import (
    MAP_SCANS,
    SURVEYED_KINDS,
    Stop,
    distinct_fraction,
)
from sceneprint_lab.synth.sensors import Spinning
from sceneprint_lab.synth.trajectories import scanner_pose

SEED = 5
#: few points, so that a scan takes a millisecond
SMALL = Spinning(rings=8, azimuth_step=0.05).perfect()


@pytest.mark.parametrize(
    "kind",
    [
        pytest.param(kind, marks=[pytest.mark.thorough] * (kind == "absent"))
        for kind in SURVEYED_KINDS
    ],
)
def test_a_site_depends_on_its_seed_and_number_alone(kind):
    site, again, other = (
        synthesise_lookalike_survey(kind, seed, 2, queries=2) for seed in (SEED, SEED, SEED + 1)
    )
    assert site.name == f"{kind}-002"
    assert site.present == (kind not in ("unmapped", "absent"))
    assert site.same_frame == (kind != "absent")
    assert (len(site.map), len(site.queries)) == (MAP_SCANS, 2)
    for one, same in zip((*site.map, *site.queries), (*again.map, *again.queries), strict=True):
        assert one.has_viewpoint
        np.testing.assert_array_equal(one.points, same.points)
        np.testing.assert_array_equal(one.pose, same.pose)
        assert len(one.points) > 1000
    assert not np.array_equal(site.queries[0].pose, other.queries[0].pose)
    names = [cloud.name for cloud in (*site.map, *site.queries)]
    assert len(set(names)) == len(names)


def test_a_scan_does_not_tell_equal_places_apart_and_tells_others():
    rng = np.random.default_rng(2)
    hall = symmetric_hall(rng)
    T = scanner_pose(3.0, 1.0, 1.2, 0.4, rng)
    half_turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    assert distinct_fraction(Stop(hall, T), hall, half_turn @ T, SMALL) < 0.01
    assert distinct_fraction(Stop(hall, T), hall, np.diag([1.0, -1.0, -1.0, 1.0]) @ T, SMALL) > 0.1
