"""The coarse index keeps codes as integers of one step: what is lost, and what lies outside."""

from __future__ import annotations

import numpy as np
import pytest

from sceneprint.errors import DamagedIndex
from sceneprint.index.coarse import MARGIN, Coarse, read_coarse, train_coarse, write_coarse
from sceneprint.types import Floats32

NONE = np.empty(0, np.int64)


def coarse_of(known: Floats32) -> Coarse:
    return train_coarse(known).appended(NONE, [known])


def test_one_step_for_all_axes_spans_the_sample_and_a_margin() -> None:
    """By hand: the widest axis, from -10 to 20, and half of that on either side together."""
    known = np.array([[-10, 5], [20, 6]], np.float32)
    empty = train_coarse(known)
    assert empty.middle.tolist() == [5, 5.5]
    assert empty.step == np.float32(30 * (1 + 2 * MARGIN) / 255)
    # a point between levels goes to the nearer one: a third of a step decides
    line = np.array([[5 + i * empty.step, 5.5] for i in (-0.5, 0.5)], np.float32)
    index = empty.appended(NONE, [line])
    for third, nearer in ((-1 / 3, 0), (1 / 3, 1)):
        query = np.array([5 + third * empty.step, 5.5], np.float32)
        assert index.nearest(query, 1, NONE).tolist() == [nearer]


def test_the_order_is_that_of_whole_distances() -> None:
    """Wide and narrow axes, none in the middle of the scale: the nearest stay the nearest."""
    rng = np.random.default_rng(3)
    spread = np.geomspace(100, 2, 32)
    known = (rng.normal(size=(3000, 32)) * spread + 500).astype(np.float32)
    queries = (rng.normal(size=(40, 32)) * spread + 500).astype(np.float32)
    index = coarse_of(known)
    kept = []
    for query in queries:
        right = np.argsort(((known - query) ** 2).sum(axis=1))[:50]
        kept.append(np.isin(right, index.nearest(query, 60, NONE)).mean())
    assert np.mean(kept) > 0.995


def test_what_lies_outside_goes_to_the_edge_of_its_axis() -> None:
    """A number beyond 8 bits would begin again at the other end, or be whatever the cast gives."""
    sample = np.random.default_rng(0).uniform(-1, 1, (50, 3)).astype(np.float32)
    far = np.array([[40, 0, 0], [-40, 0, 0], [0, 1e9, 0], [0, 0, -1e9]], np.float32)
    index = train_coarse(sample).appended(NONE, [sample, far])
    for k, query in enumerate(far):
        assert index.nearest(query, 1, NONE).tolist() == [50 + k]
        assert index.nearest(query / 20, 1, NONE).tolist() == [50 + k]


def test_codes_that_are_all_equal() -> None:
    same = np.full((5, 4), 7, np.float32)
    index = coarse_of(same)
    assert sorted(index.nearest(same[0], 5, NONE)) == [0, 1, 2, 3, 4]
    assert len(read_coarse(write_coarse(index), 4, 5).nearest(same[0] + 1, 2, NONE)) == 2


def test_bytes_keep_the_scale_and_are_the_same_for_the_same_codes() -> None:
    known = np.random.default_rng(1).normal(3, 20, (60, 8)).astype(np.float32)
    index = coarse_of(known)
    data = write_coarse(index)
    assert write_coarse(coarse_of(known)) == data
    again = read_coarse(data, 8, 60)
    assert again.step == index.step
    np.testing.assert_array_equal(again.middle, index.middle)
    assert write_coarse(again) == data
    more = again.appended(np.arange(60), [known[:3]])
    assert write_coarse(more) == write_coarse(index.appended(np.arange(60), [known[:3]]))


def test_bytes_of_another_schema_are_refused() -> None:
    known = np.random.default_rng(1).normal(size=(20, 8)).astype(np.float32)
    data = write_coarse(coarse_of(known))
    faiss_alone = data[16 + 4 * 8 :]
    for wrong in (b"", data[:10], data[:16], data[:20], data[:47], data[:48], faiss_alone,
                  b"X" + data[1:], data[:6] + b"\x01" + data[7:]):  # fmt: skip
        with pytest.raises(DamagedIndex):
            read_coarse(wrong, 8, 20)
    with pytest.raises(DamagedIndex, match="of 7 numbers"):
        read_coarse(data, 7, 20)
