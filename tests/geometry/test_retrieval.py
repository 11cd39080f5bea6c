"""L1 distances of bytes, exact."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sceneprint.geometry.retrieval import distances
from sceneprint.types import Bytes


def oracle(query: Bytes, database: Bytes) -> list[int]:
    differences = database.astype(np.int64) - query.astype(np.int64)
    return [int(d) for d in np.abs(differences).sum(axis=1)]


def test_by_hand() -> None:
    query = np.array([0, 255, 10, 200], np.uint8)
    database = np.array(
        [
            [0, 255, 10, 200],  # itself
            [255, 0, 10, 200],  # the extremes, each way round
            [1, 254, 12, 199],  # larger and smaller
            [255, 255, 255, 255],
        ],
        np.uint8,
    )
    found = distances(query, database)
    assert found.dtype == np.int64
    assert found.tolist() == [0, 510, 5, 255 + 245 + 55]


@pytest.mark.parametrize("n", [1, 31, 32, 33, 1000, 31_250])
def test_equals_the_oracle(n: int) -> None:
    rng = np.random.default_rng(n)
    query, database = rng.integers(0, 256, n, np.uint8), rng.integers(0, 256, (5, n), np.uint8)
    assert distances(query, database).tolist() == oracle(query, database)


def test_sums_do_not_overflow() -> None:
    n = 200_000
    found = distances(np.zeros(n, np.uint8), np.full((1, n), 255, np.uint8))
    assert found.tolist() == [n * 255]  # 51 million: no 8, 16 or 24 bits


SIGNATURES = st.integers(1, 70).flatmap(
    lambda n: st.tuples(*[st.binary(min_size=n, max_size=n)] * 3)
)


@settings(max_examples=80, deadline=None, derandomize=True)
@given(SIGNATURES)
def test_is_a_metric(triple: tuple[bytes, bytes, bytes]) -> None:
    x, y, z = (np.frombuffer(b, np.uint8) for b in triple)

    def d(a: Bytes, b: Bytes) -> int:
        return int(distances(a, b[None])[0])

    assert d(x, y) == oracle(x, y[None])[0]
    assert d(x, x) == 0
    assert (d(x, y) == 0) == (x.tobytes() == y.tobytes())
    assert d(x, y) == d(y, x)
    assert d(x, z) <= d(x, y) + d(y, z)


def test_empty_database() -> None:
    found = distances(np.zeros(8, np.uint8), np.zeros((0, 8), np.uint8))
    assert found.shape == (0,)
    assert found.dtype == np.int64


def test_any_memory_layout() -> None:
    rng = np.random.default_rng(0)
    big, wide = rng.integers(0, 256, (12, 80), np.uint8), rng.integers(0, 256, 80, np.uint8)
    query, database = wide[::2], big[::3, ::2]
    assert distances(query, database).tolist() == oracle(query, database)
    fortran = np.asfortranarray(database)
    assert distances(query[::-1], fortran[:, ::-1]).tolist() == oracle(query, database)
    read_only = big.copy()
    read_only.setflags(write=False)
    assert distances(wide, read_only).tolist() == oracle(wide, big)


def test_lengths_must_agree() -> None:
    for query, database in (((8,), (3, 9)), ((1, 8), (3, 8)), ((8,), (8,)), ((8,), (2, 8, 1))):
        with pytest.raises(ValueError, match="signatures of"):
            distances(np.zeros(query, np.uint8), np.zeros(database, np.uint8))
