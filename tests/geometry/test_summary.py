"""Summaries of a map: the greedy k-DPP against determinants, and novelty against its sentence."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from sceneprint.geometry.retrieval.ranking import diversify, novel, summarise
from sceneprint.types import Floats


def points(seed: int, n: int, dimension: int = 5) -> Floats:
    return np.random.default_rng(seed).exponential(size=(n, dimension)) * 100


def among(x: Floats) -> Floats:
    found: Floats = np.abs(x[:, None] - x[None]).sum(axis=2)
    return found


def one_to_all(distances: Floats) -> Callable[[int], Floats]:
    return lambda i: distances[i]


def naive(distances: Floats, k: int, sigma: float) -> list[int]:
    """Try every candidate; keep the one with the largest determinant."""
    kernel, taken = np.exp(-distances / sigma), [0]
    while len(taken) < k:
        rest = [i for i in range(len(kernel)) if i not in taken]
        values = [np.linalg.det(kernel[np.ix_([*taken, i], [*taken, i])]) for i in rest]
        taken.append(rest[int(np.argmax(values))])
    return sorted(taken)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("sigma", [50.0, 500.0])
def test_what_is_kept_has_the_greatest_determinant(seed: int, sigma: float) -> None:
    distances = among(points(seed, 24))
    found = summarise(one_to_all(distances), 24, 7, sigma)
    assert found.kept.tolist() == naive(distances, 7, sigma)
    kernel = np.exp(-distances[np.ix_(found.kept, found.kept)] / sigma)
    np.testing.assert_allclose(found.gains.prod(), np.linalg.det(kernel), rtol=1e-10)


@pytest.mark.parametrize("seed", range(6))
def test_it_is_the_selection_of_a_query_that_prefers_nothing(seed: int) -> None:
    """`diversify` with all equally near, its sigma the median distance within the ranking."""
    distances = among(points(seed, 30))
    sigma = float(np.median(distances[np.triu_indices(30, 1)]))
    found = summarise(one_to_all(distances), 30, 9, sigma)
    selected = diversify(np.full(30, 5.0), distances, 9)
    np.testing.assert_array_equal(found.kept, selected.indices)
    np.testing.assert_array_equal(found.gains, selected.gains)


@pytest.mark.parametrize("seed", range(6))
def test_each_has_its_nearest_that_is_kept(seed: int) -> None:
    distances = among(points(seed, 40))
    found = summarise(one_to_all(distances), 40, 6, 200.0)
    to_kept = distances[:, found.kept]
    np.testing.assert_array_equal(found.distances, to_kept.min(axis=1))
    np.testing.assert_array_equal(found.nearest, found.kept[to_kept.argmin(axis=1)])
    np.testing.assert_array_equal(found.nearest[found.kept], found.kept)


@pytest.mark.parametrize("seed", range(6))
def test_behind_the_first_the_order_does_not_matter(seed: int) -> None:
    x = points(seed, 30)
    order = np.concatenate([[0], 1 + np.random.default_rng(seed + 100).permutation(29)])
    one = summarise(one_to_all(among(x)), 30, 8, 200.0)
    other = summarise(one_to_all(among(x[order])), 30, 8, 200.0)
    assert set(one.kept.tolist()) == set(order[other.kept].tolist())


def test_duplicates_go_first_and_are_never_kept_twice() -> None:
    position = np.array([0.0, 0.1, 0.0, 7.0, 0.1, 3.0])
    distances = np.abs(position[:, None] - position[None])
    assert summarise(one_to_all(distances), 6, 3, 4.0).kept.tolist() == [0, 3, 5]
    whole = summarise(one_to_all(distances), 6, 6, 4.0)
    assert whole.kept.tolist() == [0, 1, 3, 5]
    assert whole.nearest.tolist() == [0, 1, 0, 3, 1, 5]
    assert whole.distances.tolist() == [0.0] * 6
    # where half of all pairs are duplicates, the scale may be 0
    assert summarise(one_to_all(distances), 6, 6, 0.0).kept.tolist() == [0, 1, 3, 5]


def test_of_two_as_near_the_first_taken_counts() -> None:
    position = np.array([0.0, 10.0, 5.0, 11.0])
    found = summarise(one_to_all(np.abs(position[:, None] - position[None])), 4, 3, 5.0)
    assert found.kept.tolist() == [0, 2, 3]
    found = summarise(one_to_all(np.abs(position[:3, None] - position[None, :3])), 3, 2, 5.0)
    assert (found.kept.tolist(), found.nearest.tolist()) == ([0, 1], [0, 1, 0])


def test_distances_are_asked_once_for_each_that_is_kept() -> None:
    distances, asked = among(points(1, 50)), []

    def of(index: int) -> Floats:
        asked.append(index)
        return distances[index]

    found = summarise(of, 50, 9, 200.0)
    assert sorted(asked) == found.kept.tolist()
    assert asked[0] == 0


@pytest.mark.parametrize(
    ("n", "k", "sigma"), [(0, 3, 1.0), (3, 0, 1.0), (3, 2, -1.0), (3, 2, np.nan), (3, 2, np.inf)]
)
def test_wrong_input(n: int, k: int, sigma: float) -> None:
    with pytest.raises(ValueError, match="with sigma"):
        summarise(lambda i: np.zeros(n), n, k, sigma)


def naive_novel(before: list[Floats], x: Floats, limit: float) -> tuple[list[bool], list[int]]:
    kept, said, nearest = list(before), [], []
    places = [-1] * len(before)
    for i, one in enumerate(x):
        found = [float(np.abs(one - other).sum()) for other in kept]
        said.append(not found or min(found) > limit)
        nearest.append(places[int(np.argmin(found))] if found else -1)
        if said[-1]:
            kept.append(one)
            places.append(i)
    return said, nearest


@pytest.mark.parametrize("seed", range(12))
def test_novel_is_what_its_sentence_says(seed: int) -> None:
    rng = np.random.default_rng(seed)
    x = rng.integers(0, 6, (40, 3)).astype(np.int64)
    before = rng.integers(0, 6, (seed % 4, 3)).astype(np.int64)
    far = np.iinfo(np.int64).max
    to_kept = np.abs(x[:, None] - before[None]).sum(axis=2).min(axis=1, initial=far)
    kept, nearest = novel(to_kept, np.abs(x[:, None] - x[None]).sum(axis=2), 2)
    expected, places = naive_novel(list(before), x, 2)
    assert kept.tolist() == expected
    assert 0 < sum(expected) < 40
    np.testing.assert_array_equal(nearest[~kept], np.array(places)[~kept])


def test_novel_by_hand() -> None:
    # one kept before at 0; these at 2, 3, 4 and 9; the second is as near as the limit to the first
    position = np.array([2, 3, 4, 9])
    kept, nearest = novel(position, np.abs(position[:, None] - position[None]), 1)
    assert kept.tolist() == [True, False, True, True]
    assert nearest[1] == 0
    kept, nearest = novel(position, np.abs(position[:, None] - position[None]), 2)
    assert kept.tolist() == [False, True, False, True]
    assert nearest.tolist()[:1] == [-1]
    assert nearest[2] == 1
