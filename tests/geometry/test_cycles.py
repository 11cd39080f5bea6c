"""Tests of cycles of edges against a simple search, and of wrong edges."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sceneprint.geometry.rigid import inverse, inverses, pose_difference
from sceneprint.geometry.session_join import CycleParameters, LoopEdges, judge_edges, robot_path
from tests.geometry.scenes import rigid


def walk(rng, n, metres=0.05, degrees=2.0):
    poses = [rigid(rng, 1.0, 40.0)]
    for _ in range(n - 1):
        poses.append(poses[-1] @ rigid(rng, metres, degrees))
    return np.array(poses)


def a_run(poses, parents=None):
    return robot_path(poses, np.array(parents or [0] * len(poses), np.int64))


def edges_between(rng, here, there, n, metres, degrees):
    """Edges of two walks through one world, each with an error."""
    source = np.sort(rng.integers(0, len(here), n))
    target = np.clip(source + rng.integers(-3, 4, n), 0, len(there) - 1)
    pairs = zip(source, target, strict=True)
    true = [inverse(there[j]) @ here[i] @ rigid(rng, metres, degrees) for i, j in pairs]
    weights = rng.choice([0.5, 1.0], n)
    return LoopEdges(source, target, np.array(true), weights)


def oracle(edges, source, target, p):
    """Pairs of edges near each other, and which close: one after the other, in matrices."""
    results = {}
    for e in range(len(edges)):
        for f in range(e + 1, len(edges)):
            i, j, k, m = edges.source[e], edges.target[e], edges.source[f], edges.target[f]
            ways = [
                abs(source.metres[i] - source.metres[k]),
                abs(target.metres[j] - target.metres[m]),
            ]
            turns = [
                abs(source.radians[i] - source.radians[k]),
                abs(target.radians[j] - target.radians[m]),
            ]
            if max(ways) > p.reach_m or max(turns) > p.reach_rad:
                continue
            # over f: from k to m; over e: from k along the run to i, to j, along the run to m
            along = inverse(source.poses[i]) @ source.poses[k]
            over = inverse(target.poses[m]) @ target.poses[j] @ edges.transforms[e] @ along
            metres, radians = pose_difference(over, edges.transforms[f])
            back = inverse(target.poses[j]) @ target.poses[m] @ edges.transforms[f] @ inverse(along)
            metres = max(metres, pose_difference(back, edges.transforms[e])[0])
            results[e, f] = metres <= p.close_m + p.drift * sum(
                ways
            ) and radians <= p.close_rad + p.drift * sum(turns)
    return results


@pytest.mark.parametrize("seed", range(2))
def test_loops_are_those_of_the_oracle(seed):
    rng = np.random.default_rng(seed)
    here, there = walk(rng, 60), walk(rng, 60)
    edges = edges_between(rng, here, there, 40, 0.03, 2.0)
    source, target, p = a_run(here), a_run(there), CycleParameters()
    expected = oracle(edges, source, target, p)
    assert any(expected.values())
    assert not all(expected.values())
    verdicts = judge_edges(edges, source, target)
    mask = np.ones(len(edges), bool)
    while True:  # the most outvoted first
        against = np.zeros(len(edges))
        for (e, f), closes in expected.items():
            if mask[e] and mask[f]:
                sign = -1.0 if closes else 1.0
                against[e] += sign * edges.weights[f]
                against[f] += sign * edges.weights[e]
        against[~mask] = 0.0
        if against.max() <= 0:
            break
        mask[int(np.argmax(against))] = False
    np.testing.assert_array_equal(verdicts.accepted, mask)
    for e in range(len(edges)):
        own = [closes for pair, closes in expected.items()
               if e in pair and mask[pair[0] if pair[1] == e else pair[1]]]  # fmt: skip
        assert (verdicts.loops[e], verdicts.closed[e]) == (len(own), sum(own))


def test_by_hand():
    """Three frames 10 cm apart on a line, seen again from there; one edge is 20 cm off."""
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 0, 3] = (0.0, 0.1, 0.2)
    transforms = np.tile(np.eye(4), (3, 1, 1))
    transforms[1, 1, 3] = 0.2
    every = np.arange(3)
    found = judge_edges(LoopEdges(every, every, transforms, np.ones(3)), a_run(poses), a_run(poses))
    assert found.accepted.tolist() == [True, False, True]
    assert found.loops.tolist() == [1, 2, 1]
    assert found.closed.tolist() == [1, 0, 1]
    # 5 % of 0.2 m of way on either side is what a loop may be off besides
    transforms[1, 1, 3] = 0.0
    transforms[2, 1, 3] = 0.07 + 0.05 * 0.2 + 1e-6
    edges = LoopEdges(every, every, transforms, np.ones(3))
    assert judge_edges(edges, a_run(poses), a_run(poses)).closed.tolist() == [2, 1, 1]
    transforms[2, 1, 3] = 0.07 + 0.05 * 0.4 + 1e-6
    assert judge_edges(edges, a_run(poses), a_run(poses)).accepted.tolist() == [True, True, False]


def line(*x):
    poses = np.tile(np.eye(4), (len(x), 1, 1))
    poses[:, 0, 3] = x
    return poses


def test_an_edge_of_the_same_viewpoint_supports_nothing():
    """Frames at 0 and 5 cm are one viewpoint, that at 20 cm is another one; all edges agree."""
    here = line(0.0, 0.05, 0.2)

    def accepted_edges(chosen, target, there):
        source, onto = np.array(chosen), np.array(target)
        transforms = inverses(there[onto]) @ here[source]
        edges = LoopEdges(source, onto, transforms, np.ones(len(source)))
        judged = judge_edges(edges, a_run(here), a_run(there))
        assert judged.accepted.all()
        assert (judged.closed == len(source) - 1).all()
        return judged.supported.tolist()

    still = line(0.0, 0.01, 0.02)
    assert accepted_edges([0, 1], [0, 1], still) == [False, False]
    assert accepted_edges([0, 1, 2], [0, 1, 2], still) == [True, True, True]
    # on either run: one frame that was found at two places of the other one
    assert accepted_edges([0, 0], [0, 2], here) == [True, True]
    assert accepted_edges([0], [0], here) == [False]
    # or turned by 7 degrees where it stood
    turned = still.copy()
    turned[1, :3, :3] = Rotation.from_euler("y", 7.0, degrees=True).as_matrix()
    assert accepted_edges([0, 1], [0, 1], turned) == [True, True]


def test_no_odometry_drifts_from_one_side_of_an_object_to_the_other():
    """Half a circle of 2 m radius about an object: each frame looks like that half a turn later."""
    angles = np.linspace(0.0, 2 * np.pi, 41)[:-1]
    poses = np.tile(np.eye(4), (40, 1, 1))
    poses[:, :3, :3] = Rotation.from_euler("z", angles[:, None]).as_matrix()
    poses[:, :2, 3] = 2.0 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    source, run = np.arange(20, 40), a_run(poses)
    alike = LoopEdges(source, source - 20, np.tile(np.eye(4), (20, 1, 1)), np.ones(20))
    # all edges are turned alike, so that they agree with each other and with nothing else
    verdicts = judge_edges(alike, run, run)
    assert verdicts.accepted.all()
    assert verdicts.supported.all()
    within = judge_edges(alike, run, run, within_run=True)
    assert within.accepted.all()
    assert not within.supported.any()
    # right ones are 4 m apart, over a way of 6.3 m that may be wrong by a fifth
    true = inverses(poses[source - 20]) @ poses[source]
    for metres, supported in ((0.0, True), (1.2, True), (1.5, False)):
        transforms = true.copy()
        transforms[:, 2, 3] += metres
        edges = LoopEdges(source, source - 20, transforms, np.ones(20))
        verdicts = judge_edges(edges, run, run, within_run=True)
        assert verdicts.supported.tolist() == [supported] * 20
    # a gap in the odometry allows everything
    gap = a_run(poses, [0] * 20 + [1] * 20)
    assert judge_edges(alike, gap, gap, within_run=True).supported.all()


def test_lengths_are_multiples_of_the_scale():
    p, large = CycleParameters(), CycleParameters().scaled(5.0)
    lengths = [(p.close_m, large.close_m), (p.reach_m, large.reach_m), (p.view_m, large.view_m)]
    assert [b / a for a, b in lengths] == pytest.approx([5.0] * 3)
    assert (large.drift, large.close_rad) == (p.drift, p.close_rad)


def test_nothing_checks_where_there_are_no_poses_or_odometry_is_broken():
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[:, 0, 3] = (0.0, 0.1, 0.2, 0.3)
    every, transforms = np.arange(4), np.tile(np.eye(4), (4, 1, 1))
    edges = LoopEdges(every, every, transforms, np.ones(4))
    lost = poses.copy()
    lost[1] = np.nan
    verdicts = judge_edges(edges, a_run(lost), a_run(poses))
    assert verdicts.loops.tolist() == [2, 0, 2, 2]
    assert verdicts.accepted.all()
    verdicts = judge_edges(edges, a_run(poses, [0, 0, 1, 1]), a_run(poses))
    assert verdicts.loops.tolist() == [1, 1, 1, 1]


def test_the_reach_is_shortened_rather_than_memory_taken():
    rng = np.random.default_rng(8)
    here = walk(rng, 100)
    edges = edges_between(rng, here, here, 200, 0.001, 0.1)
    run = a_run(here)
    every = judge_edges(edges, run, run)
    few = judge_edges(edges, run, run, CycleParameters(most_loops=500))
    assert 0 < few.loops.sum() <= 1000 < every.loops.sum()
    assert few.accepted.all()
