"""Tests of ambiguous sites, as images and as scans: reproducibility and similarity."""

import numpy as np
import pytest

from sceneprint.formats.dataset import find_sequences
from sceneprint.types import Intrinsics
from sceneprint_lab.evaluation.protocol import overlaps, view_of
from sceneprint_lab.synth import synthesise_lookalike, synthesise_lookalike_survey
from sceneprint_lab.synth.large_scenes import symmetric_hall
from sceneprint_lab.synth.lookalike_surveys import (
    MAP_SCANS,
    SURVEYED_KINDS,
    Stop,
    distinct_fraction,
)
from sceneprint_lab.synth.lookalikes import (
    APART,
    ELSEWHERE,
    KINDS,
    Likeness,
    difference_share,
    equal_offices,
)
from sceneprint_lab.synth.sensors import Spinning
from sceneprint_lab.synth.trajectories import scanner_pose, scattered_poses

SEED = 5
#: A Kinect's field of view in few samples, and a scan that takes a millisecond.
SMALL = Intrinsics(160, 120, 146.25, 146.25, 79.5, 59.5)
FEW_RAYS = Spinning(rings=8, azimuth_step=0.05).perfect()
#: Per kind of site, whether its map has the place of a query, and whether both share a frame.
OF_IMAGES = {kind: (kind not in ELSEWHERE, kind not in APART) for kind in KINDS}
OF_SCANS = {
    kind: (kind not in ("unmapped", "absent"), kind != "absent") for kind in SURVEYED_KINDS
}  # fmt: skip


@pytest.mark.parametrize(
    ("kind", "is_scanned"),
    [
        pytest.param(kind, is_scanned, marks=[pytest.mark.thorough] * (kind == "absent"))
        for is_scanned, kinds in enumerate((OF_IMAGES, OF_SCANS))
        for kind in kinds
    ],
)
def test_a_site_depends_on_its_seed_and_number_alone(kind, is_scanned):
    number = 2 if is_scanned else 1  # whose map lacks no scan

    def synthesise(seed):
        if is_scanned:
            return synthesise_lookalike_survey(kind, seed, number, queries=2)
        return synthesise_lookalike(kind, seed, number, queries=2, intrinsics=SMALL)

    def samples(frame):
        return frame.points if is_scanned else frame.depth

    site, again, other = map(synthesise, (SEED, SEED, SEED + 1))
    assert (site.name, len(site.queries)) == (f"{kind}-00{number}", 2)
    assert (site.present, site.same_frame) == (OF_SCANS if is_scanned else OF_IMAGES)[kind]
    assert len(site.map) == MAP_SCANS if is_scanned else len(site.map) >= 15
    for one, same in zip((*site.map, *site.queries), (*again.map, *again.queries), strict=True):
        np.testing.assert_array_equal(samples(one), samples(same))
        np.testing.assert_array_equal(one.pose, same.pose)
    assert min(np.count_nonzero(samples(query)) for query in site.queries) > 5000
    assert not np.array_equal(site.queries[0].pose, other.queries[0].pose)
    names = [frame.name for frame in (*site.map, *site.queries)]
    assert len(set(names)) == len(names)


def test_a_scan_does_not_tell_equal_places_apart_and_tells_others():
    rng = np.random.default_rng(2)
    hall = symmetric_hall(rng)
    T = scanner_pose(3.0, 1.0, 1.2, 0.4, rng)
    for signs, least, most in (((-1, -1, 1, 1), 0, 0.01), ((1, -1, -1, 1), 0.1, 1)):
        share = distinct_fraction(Stop(hall, T), hall, np.diag(signs) @ T, FEW_RAYS)
        assert least <= share < most


def test_every_query_around_an_object_has_a_frame_beside_it_and_one_across():
    site = synthesise_lookalike("object", SEED, 0, queries=6, noise=None)
    seen = overlaps([view_of(q) for q in site.queries], [view_of(d) for d in site.map])
    assert seen.least.max(axis=1).min() > 0.5
    where = np.array([d.pose[:2, 3] for d in site.map if d.pose is not None])
    for query in site.queries:
        across = np.linalg.norm(where + query.pose[:2, 3], axis=1)
        assert across.min() < 0.8


def test_equal_offices_differ_by_what_people_move_and_not_at_all_without_it():
    same = equal_offices(2, Likeness(0.0, 0.0, 0.0, 1.0), np.random.default_rng(1))
    moved = equal_offices(2, Likeness(0.0, 0.0, 0.3, 0.5), np.random.default_rng(1))
    np.testing.assert_array_equal(same[0].vertices, same[1].vertices)
    poses = scattered_poses(moved[0], 6, np.random.default_rng(2))
    assert max(difference_share(same[0], same[1], T) for T in poses) == 0.0
    shares = [difference_share(moved[0], moved[1], T) for T in poses]
    assert 0.01 < np.median(shares) < 0.4


@pytest.mark.thorough
@pytest.mark.parametrize(("kind", "scenes"), [("object", 1), ("kitchens", 2)])
def test_the_layout_is_read_back(kind, scenes, tmp_path, run_command):
    out = tmp_path / "sites"
    said, _ = run_command(
        "synth", out, "--lookalikes", kind, "--rooms", 1, "--views", 3, "--seed", SEED
    )
    assert f"1 sites of 3 queries in {out}" in said
    site = synthesise_lookalike(kind, SEED, 0, queries=3)
    sequences = find_sequences(out)
    assert len({sequence.parent_frame for sequence in sequences}) == scenes
    parts = {sequence.split: sequence for sequence in sequences}
    assert set(parts) == {"train", "test"}
    for part, frames in (("train", site.map), ("test", site.queries)):
        read = parts[part].frames
        assert len(read) == len(frames)
        for reference, frame in zip(read[:3], frames, strict=False):
            back = reference.read()
            np.testing.assert_allclose(back.depth, frame.depth, atol=1e-6)
            np.testing.assert_allclose(back.pose, frame.pose, atol=1e-6)
