"""Loops of edges against a naive oracle, and wrong edges among right ones."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sceneprint.geometry.rigid import difference, inverse
from sceneprint.geometry.session_join import (
    CycleParameters,
    LoopEdges,
    RobotPath,
    run_of,
    verdicts,
)
from sceneprint.types import Floats


def moved_by(rng: np.random.Generator, metres: float, degrees: float) -> Floats:
    T = np.eye(4)
    turn = Rotation.from_rotvec(rng.normal(0, math.radians(degrees), 3))
    T[:3, :3], T[:3, 3] = turn.as_matrix(), rng.normal(0, metres, 3)
    return T


def walk(rng: np.random.Generator, n: int, metres: float = 0.05, degrees: float = 2.0) -> Floats:
    poses = [moved_by(rng, 1.0, 40.0)]
    for _ in range(n - 1):
        poses.append(poses[-1] @ moved_by(rng, metres, degrees))
    return np.array(poses)


def a_run(poses: Floats, parents: list[int] | None = None) -> RobotPath:
    return run_of(poses, np.array(parents or [0] * len(poses), np.int64))


def edges_between(
    rng: np.random.Generator, here: Floats, there: Floats, n: int, metres: float, degrees: float
) -> LoopEdges:
    """Edges of two walks through one world, each with an error."""
    source = np.sort(rng.integers(0, len(here), n))
    target = np.clip(source + rng.integers(-3, 4, n), 0, len(there) - 1)
    pairs = zip(source, target, strict=True)
    true = [inverse(there[j]) @ here[i] @ moved_by(rng, metres, degrees) for i, j in pairs]
    weights = rng.choice([0.5, 1.0], n)
    return LoopEdges(source, target, np.array(true), weights)


def oracle(
    edges: LoopEdges, source: RobotPath, target: RobotPath, p: CycleParameters
) -> dict[tuple[int, int], bool]:
    """Pairs of edges near each other, and which close: one after the other, in matrices."""
    found = {}
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
            metres, radians = difference(over, edges.transforms[f])
            back = inverse(target.poses[j]) @ target.poses[m] @ edges.transforms[f] @ inverse(along)
            metres = max(metres, difference(back, edges.transforms[e])[0])
            found[e, f] = metres <= p.close_m + p.drift * sum(
                ways
            ) and radians <= p.close_rad + p.drift * sum(turns)
    return found


@pytest.mark.parametrize("seed", range(4))
def test_loops_are_those_of_the_oracle(seed: int) -> None:
    rng = np.random.default_rng(seed)
    here, there = walk(rng, 60), walk(rng, 60)
    edges = edges_between(rng, here, there, 40, 0.03, 2.0)
    source, target, p = a_run(here), a_run(there), CycleParameters()
    expected = oracle(edges, source, target, p)
    assert any(expected.values())
    assert not all(expected.values())
    found = verdicts(edges, source, target)
    kept = np.ones(len(edges), bool)
    while True:  # the most outvoted first
        against = np.zeros(len(edges))
        for (e, f), closes in expected.items():
            if kept[e] and kept[f]:
                sign = -1.0 if closes else 1.0
                against[e] += sign * edges.weights[f]
                against[f] += sign * edges.weights[e]
        against[~kept] = 0.0
        if against.max() <= 0:
            break
        kept[int(np.argmax(against))] = False
    np.testing.assert_array_equal(found.kept, kept)
    for e in range(len(edges)):
        own = [closes for pair, closes in expected.items()
               if e in pair and kept[pair[0] if pair[1] == e else pair[1]]]  # fmt: skip
        assert (found.loops[e], found.closed[e]) == (len(own), sum(own))


def test_wrong_edges_are_outvoted_and_right_ones_are_not() -> None:
    rng = np.random.default_rng(5)
    # the second run has another origin, and nobody knows where
    here, there = walk(rng, 120), walk(rng, 120)
    for i in range(120):
        there[i] = here[i] @ moved_by(rng, 0.05, 2.0)
    edges = edges_between(rng, here, there, 150, 0.01, 0.5)
    wrong = rng.choice(150, 45, replace=False)
    for e in wrong:
        edges.transforms[e] = edges.transforms[e] @ moved_by(rng, 0.6, 30.0)
    elsewhere = moved_by(rng, 5.0, 90.0)
    found = verdicts(edges, a_run(here), a_run(elsewhere @ there))
    assert set(np.flatnonzero(~found.kept)) == set(wrong)


def test_odometry_that_drifts_does_no_harm() -> None:
    rng = np.random.default_rng(6)
    true = walk(rng, 300, 0.04, 1.0)
    drifting = [true[0]]
    for a, b in pairwise(true):
        step = inverse(a) @ b
        step[:3, 3] *= 1.03
        drifting.append(drifting[-1] @ step @ moved_by(rng, 0.003, 0.15))
    drifted = np.array(drifting)
    assert difference(inverse(true[0]) @ true[-1], inverse(drifted[0]) @ drifted[-1])[0] > 0.1
    source = np.arange(150, 300)
    target = source - 150
    exact = np.array([inverse(true[j]) @ true[i] for i, j in zip(source, target, strict=True)])
    run = a_run(drifted)
    found = verdicts(LoopEdges(source, target, exact, np.ones(150)), run, run)
    assert found.kept.all()
    assert (found.loops > 0).all()
    blind = CycleParameters(reach_m=1e3, reach_rad=1e3, drift=0.0)
    assert not verdicts(LoopEdges(source, target, exact, np.ones(150)), run, run, blind).kept.all()


def test_by_hand() -> None:
    """Three frames 10 cm apart on a line, seen again from there; one edge is 20 cm off."""
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 0, 3] = (0.0, 0.1, 0.2)
    transforms = np.tile(np.eye(4), (3, 1, 1))
    transforms[1, 1, 3] = 0.2
    every = np.arange(3)
    found = verdicts(LoopEdges(every, every, transforms, np.ones(3)), a_run(poses), a_run(poses))
    assert found.kept.tolist() == [True, False, True]
    assert found.loops.tolist() == [1, 2, 1]
    assert found.closed.tolist() == [1, 0, 1]
    # 5 % of 0.2 m of way on either side is what a loop may be off besides
    transforms[1, 1, 3] = 0.0
    transforms[2, 1, 3] = 0.07 + 0.05 * 0.2 + 1e-6
    edges = LoopEdges(every, every, transforms, np.ones(3))
    assert verdicts(edges, a_run(poses), a_run(poses)).closed.tolist() == [2, 1, 1]
    transforms[2, 1, 3] = 0.07 + 0.05 * 0.4 + 1e-6
    assert verdicts(edges, a_run(poses), a_run(poses)).kept.tolist() == [True, True, False]


def test_nothing_checks_where_there_are_no_poses_or_odometry_is_broken() -> None:
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[:, 0, 3] = (0.0, 0.1, 0.2, 0.3)
    every, transforms = np.arange(4), np.tile(np.eye(4), (4, 1, 1))
    edges = LoopEdges(every, every, transforms, np.ones(4))
    lost = poses.copy()
    lost[1] = np.nan
    found = verdicts(edges, a_run(lost), a_run(poses))
    assert found.loops.tolist() == [2, 0, 2, 2]
    assert found.kept.all()
    found = verdicts(edges, a_run(poses, [0, 0, 1, 1]), a_run(poses))
    assert found.loops.tolist() == [1, 1, 1, 1]


def test_no_edges() -> None:
    run = a_run(np.tile(np.eye(4), (2, 1, 1)))
    none = np.empty(0, np.int64)
    found = verdicts(LoopEdges(none, none, np.empty((0, 4, 4)), np.empty(0)), run, run)
    assert len(found.kept) == len(found.loops) == len(found.closed) == 0


def test_the_reach_is_shortened_rather_than_memory_taken() -> None:
    rng = np.random.default_rng(8)
    here = walk(rng, 100)
    edges = edges_between(rng, here, here, 200, 0.001, 0.1)
    run = a_run(here)
    every = verdicts(edges, run, run)
    few = verdicts(edges, run, run, CycleParameters(most_loops=500))
    assert 0 < few.loops.sum() <= 1000 < every.loops.sum()
    assert few.kept.all()
