"""Tests of laser scans of ambiguous sites: reproducibility and similarity."""

import math

import numpy as np
import pytest
from scipy.spatial import cKDTree

from sceneprint.formats.dataset import find_sequences
from sceneprint_lab.synth import synthesise_lookalike_survey
from sceneprint_lab.synth.large_scenes import symmetric_hall
from sceneprint_lab.synth.lookalike_surveys import (
    MAP_SCANS,
    SURVEYED_KINDS,
    Stop,
    bay,
    block,
    distinct_fraction,
    row_of,
    with_drift,
)
from sceneprint_lab.synth.lookalikes import Likeness
from sceneprint_lab.synth.sensors import Rosette, Spinning
from sceneprint_lab.synth.trajectories import scanner_pose

SEED = 5
#: copies that do not differ at all
EQUAL = Likeness(0.0, 0.0, 0.0)
#: few points, so that a scan takes a millisecond
SMALL = Spinning(rings=8, azimuth_step=0.05).perfect()


def positions(clouds):
    return np.array([cloud.pose[:3, 3] for cloud in clouds])


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


def test_half_a_turn_maps_the_hall_onto_itself():
    """Every corner of the turned mesh is one of the mesh; the floor to walk on turns as well."""
    for seed in range(3):
        hall = symmetric_hall(np.random.default_rng(seed))
        v = hall.mesh.vertices
        far, _ = cKDTree(v).query(v * (-1.0, -1.0, 1.0))
        assert far.max() < 1e-9
        np.testing.assert_array_equal(hall.floor.claimed, hall.floor.claimed[::-1, ::-1])
        np.testing.assert_allclose(hall.floor.points, -hall.floor.points[::-1, ::-1], atol=1e-9)
        assert 0.3 < hall.walkable.mean() < 1.0


@pytest.mark.parametrize("make", [bay, block])
def test_units_repeat_along_the_row_but_for_what_is_missing(make):
    unit = make(np.random.default_rng(3))
    row = row_of(unit, 3, EQUAL, np.random.default_rng(0))
    step = np.array([unit.pitch, 0.0, 0.0])
    inner = row.mesh.vertices[np.abs(row.mesh.vertices[:, 0] - 0.5 * unit.pitch) < 0.4 * unit.pitch]
    far, _ = cKDTree(row.mesh.vertices).query(inner + step)
    assert far.max() < 1e-9
    # without a third of the things, two of the copies differ
    fewer = row_of(unit, 3, Likeness(0.0, 0.0, 0.0, missing=0.35), np.random.default_rng(0))
    assert len(fewer.mesh.faces) < len(row.mesh.faces)
    assert unit.things


def test_a_scan_does_not_tell_equal_places_apart_and_tells_others():
    rng = np.random.default_rng(2)
    hall = symmetric_hall(rng)
    T = scanner_pose(3.0, 1.0, 1.2, 0.4, rng)
    half_turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    assert distinct_fraction(Stop(hall, T), hall, half_turn @ T, SMALL) < 0.01
    assert distinct_fraction(Stop(hall, T), hall, np.diag([1.0, -1.0, -1.0, 1.0]) @ T, SMALL) > 0.1


def test_drift_is_a_random_walk_that_starts_true():
    poses = np.stack([scanner_pose(2.0 * k, 0.0, 1.0, 0.1 * k, np.random.default_rng(k))
                      for k in range(400)])  # fmt: skip
    off = with_drift(poses, np.random.default_rng(1))
    np.testing.assert_array_equal(off[0], poses[0])
    np.testing.assert_allclose(off[:, :3, :3] @ off[:, :3, :3].swapaxes(1, 2),
                               np.broadcast_to(np.eye(3), (400, 3, 3)), atol=1e-9)  # fmt: skip
    relative = np.linalg.inv(poses[:-1]) @ poses[1:]
    recorded = np.linalg.inv(off[:-1]) @ off[1:]
    errors = (recorded - relative)[:, :3, 3]
    assert 0.009 < errors.std() < 0.055  # of a normal error of 1 to 5 cm, 1,197 draws
    assert np.abs(errors).max() < 0.3


def test_maps_drift_and_lack_scans_and_a_query_lies_where_its_neighbours_say():
    """Site 1 of each kind drifts and lacks scans; a query's points lie on its neighbour's."""
    site = synthesise_lookalike_survey("streets", SEED, 1, queries=4)
    assert 0.6 * MAP_SCANS < len(site.map) < MAP_SCANS
    true = synthesise_lookalike_survey("streets", SEED, 1, queries=4, perfect=True)
    off = np.linalg.norm(positions(site.map) - positions(true.map), axis=1)
    assert off[0] == 0.0
    assert 0.02 < off.max() < 1.5
    for query, ideal in zip(site.queries, true.queries, strict=True):
        near = np.linalg.norm(positions(true.map) - ideal.pose[:3, 3], axis=1).argmin()
        here, there = site.map[near].pose, true.map[near].pose
        assert here is not None
        assert there is not None
        np.testing.assert_allclose(
            np.linalg.inv(here) @ query.pose, np.linalg.inv(there) @ ideal.pose, atol=1e-9
        )


def test_the_queries_of_a_site_are_not_in_its_map_and_some_lie_beside_its_path():
    site = synthesise_lookalike_survey("sites", SEED, 0, queries=9)
    apart = np.linalg.norm(positions(site.queries)[:, None] - positions(site.map), axis=2)
    assert apart.min() > 0.3
    assert apart.min(axis=1).max() < 8.0


def test_a_rosette_fills_a_cone_about_x_and_never_twice_the_same():
    sensor = Rosette(half_angle=math.radians(35.0), firings=6_000)
    first, second = (sensor.rays(np.random.default_rng(k)) for k in range(2))
    for rays in (first, second):
        np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1.0, atol=1e-6)
        angle = np.degrees(np.arccos(rays[:, 0].astype(float)))
        assert 34.0 < angle.max() < 35.0 + 2.0 + 0.1  # five steps of .8 degrees, half to each side
        # all around, up to the edge
        around = np.arctan2(rays[angle > 25, 2], rays[angle > 25, 1])
        counts, _ = np.histogram(around, 12, (-math.pi, math.pi))
        assert counts.min() > 50
    nearest, _ = cKDTree(first).query(second)
    assert np.median(nearest) > 1e-3


@pytest.mark.parametrize(
    ("kind", "scenes"), [("bays", 1), pytest.param("absent", 2, marks=pytest.mark.thorough)]
)
def test_the_layout_is_read_back(kind, scenes, tmp_path, run_command):
    out = tmp_path / "sites"
    said, _ = run_command("synth", out, "--lookalikes", kind, "--sensor", "lidar", "--rooms", 1,
                  "--views", 2, "--seed", SEED)  # fmt: skip
    assert f"1 sites of 2 queries in {out}" in said
    site = synthesise_lookalike_survey(kind, SEED, 0, queries=2)
    found = find_sequences(out)
    assert len({sequence.parent_frame for sequence in found}) == scenes
    parts = {sequence.split: sequence for sequence in found}
    assert set(parts) == {"train", "test"}
    for part, clouds in (("train", site.map), ("test", site.queries)):
        read = parts[part].frames
        assert len(read) == len(clouds)
        back = read[1].read()
        np.testing.assert_allclose(back.points, clouds[1].points, atol=1e-5)
        np.testing.assert_allclose(back.pose, clouds[1].pose, atol=1e-6)
