"""Tests of ambiguous sites: reproducibility and similarity."""

import numpy as np
import pytest

from sceneprint.formats.dataset import find_sequences
from sceneprint.types import Intrinsics
from sceneprint_lab.evaluation.protocol import overlaps, view_of
from sceneprint_lab.synth import synthesise_lookalike
from sceneprint_lab.synth.lookalikes import (
    APART,
    ELSEWHERE,
    KINDS,
    Likeness,
    difference_share,
    equal_offices,
)
from sceneprint_lab.synth.trajectories import scattered_poses

SEED = 5
#: a Kinect's field of view in few samples
SMALL = Intrinsics(160, 120, 146.25, 146.25, 79.5, 59.5)


@pytest.mark.parametrize("kind", [*KINDS[:-1], pytest.param(KINDS[-1], marks=pytest.mark.thorough)])
def test_a_site_depends_on_its_seed_and_number_alone(kind):
    site, again, other = (
        synthesise_lookalike(kind, seed, 1, queries=2, intrinsics=SMALL)
        for seed in (SEED, SEED, SEED + 1)
    )
    assert site.name == f"{kind}-001"
    assert (site.present, site.same_frame) == (kind not in ELSEWHERE, kind not in APART)
    assert len(site.queries) == 2
    assert len(site.map) >= 15
    for one, same in zip(
        (*site.map[:3], *site.queries), (*again.map[:3], *again.queries), strict=True
    ):
        np.testing.assert_array_equal(one.depth, same.depth)
        np.testing.assert_array_equal(one.pose, same.pose)
    assert not np.array_equal(site.queries[0].depth, other.queries[0].depth)
    names = [frame.name for frame in (*site.map, *site.queries)]
    assert len(set(names)) == len(names)
    shown = [float(np.mean(frame.depth > 0)) for frame in site.queries]
    assert min(shown) > 0.3


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
    found = find_sequences(out)
    assert len({sequence.parent_frame for sequence in found}) == scenes
    parts = {sequence.split: sequence for sequence in found}
    assert set(parts) == {"train", "test"}
    for part, frames in (("train", site.map), ("test", site.queries)):
        read = parts[part].frames
        assert len(read) == len(frames)
        for reference, frame in zip(read[:3], frames, strict=False):
            back = reference.read()
            np.testing.assert_allclose(back.depth, frame.depth, atol=1e-6)
            np.testing.assert_allclose(back.pose, frame.pose, atol=1e-6)
