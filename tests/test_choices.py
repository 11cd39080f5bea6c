"""What is stored was decided by rule: prefixes, paired intervals and ties by hand."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.choices import (
    CHOICES,
    ONE,
    PAPER,
    SEVERAL,
    Choice,
    Figure,
    Trial,
    by_levels,
    compare,
    decide,
    measure,
)

L2 = Choice(1000, "l2", 4)
TIE, BETTER, WORSE = (Figure(0.5, mean, *ends) for mean, ends in (
    (0.1, (0.0, 0.2)), (0.1, (0.01, 0.2)), (-0.1, (-0.2, -0.01))
))  # fmt: skip


def test_levels_are_prefixes() -> None:
    query = np.array([[10, 20, 30, 40]], np.uint8)
    database = np.array([[11, 20, 33, 40], [10, 25, 30, 30]], np.uint8)
    l1, l2 = (by_levels(query, database, metric, 2) for metric in ("l1", "l2"))
    assert [rows.tolist() for rows in l1] == [[[1, 5]], [[4, 15]]]
    assert [rows.tolist() for rows in l2] == [[[1, 25]], [[10, 125]]]


@pytest.mark.parametrize("change", [0.25, 0.0, -0.5])
def test_interval_of_a_constant_difference_is_that_difference(change: float) -> None:
    values = np.linspace(0, 1, 33)
    found = compare(values + change, values, ["a"] * 12 + ["b"] * 21)
    assert (found.low, found.high) == (change, change)
    assert found.difference == pytest.approx(change)
    assert found.value == pytest.approx(0.5 + change)


def test_interval_of_one_block_in_two() -> None:
    """Both, none or one of the two blocks drawn: the mean is 1, 0 or a half."""
    found = compare(np.repeat([1.0, 0.0], 10), np.zeros(20), ["a"] * 20)
    assert (found.difference, found.low, found.high) == (0.5, 0.0, 1.0)
    # a block ends where its scene does: 5 of 15 queries are the first of two blocks
    uneven = compare(np.repeat([1.0, 0.0], [5, 10]), np.zeros(15), ["a"] * 5 + ["b"] * 10)
    assert (uneven.low, uneven.high) == (0.0, 1.0)
    assert uneven.difference == pytest.approx(1 / 3)


def test_ties_keep_the_papers_choice() -> None:
    same = {"f": Figure(0.5, 0.0, 0.0, 0.0)}
    others = [c for c in CHOICES if c != PAPER]
    assert decide({c: {"f": TIE} for c in others} | {PAPER: same}) == PAPER
    assert decide({PAPER: same, L2: {"f": TIE, "g": BETTER}}) == L2
    assert decide({PAPER: same, L2: {"f": WORSE, "g": BETTER}}) == PAPER
    more = Choice(500, "l1", 2)
    assert decide({L2: {"f": BETTER, "g": TIE}, more: {"f": BETTER, "g": BETTER}}) == more


def test_figures_of_the_first_that_is_allowed() -> None:
    """Two queries of two scenes: the nearest of the first is not allowed, the next is strange."""
    database = np.array([[0] * 4, [1] * 4, [9] * 4], np.uint8)
    queries = np.array([[0] * 4, [9] * 4], np.uint8)
    same = np.array([[True, False, True], [False, True, True]])
    shared = np.array([[0.9, 0.0, 0.6], [0.0, 0.3, 0.4]])
    stored = dict.fromkeys((1000, 500), queries), dict.fromkeys((1000, 500), database)
    trial = Trial(*stored, ["a", "b"], same, shared, shared < 0.8)
    table = measure(trial, "t", (*ONE, SEVERAL[0]))
    assert list(table) == CHOICES
    for row in table.values():
        assert [f.value for f in row.values()] == [0.2, 0.0, 0.5]
        assert {(f.difference, f.low, f.high) for f in row.values()} == {(0.0, 0.0, 0.0)}
