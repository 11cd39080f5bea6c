"""Tests of the distance kernels against exact integers."""

import mmap

import numpy as np
import pytest

from sceneprint.geometry.retrieval.ranking import scan


def oracle(queries, database, rows):
    """(Q, r), each entry summed by Python's own integers."""
    return [
        [sum(abs(x - y) for x, y in zip(query, database[r].tolist(), strict=True)) for r in rows]
        for query in queries.tolist()
    ]


def random_bytes(seed, *shape):
    return np.random.default_rng(seed).integers(0, 256, shape, np.uint8)


@pytest.mark.parametrize("n", [0, 1, 15, 17, 33, 63, 65, 200, 4161, 8193])
def test_any_length(n):
    """Multiples of no width, and past a tile; more rows and queries than go together."""
    queries, database, rows = random_bytes(n, 5, n), random_bytes(n + 1, 6, n), np.arange(6)
    expected = oracle(queries, database, rows)
    assert scan(queries, database, rows).tolist() == expected
    # one query is another way through the loop
    assert scan(queries[3:4], database, rows).tolist() == expected[3:4]


@pytest.mark.parametrize("number", [0, 1, 2, 5, 9, 33])
def test_half_of_all_pairs(number):
    signatures, rows = random_bytes(number, number, 130), np.arange(number)
    found = scan(signatures, signatures, rows, half=True)
    expected = np.array(oracle(signatures, signatures, rows), np.int64).reshape(number, number)
    np.testing.assert_array_equal(np.triu(found, 1), np.triu(expected, 1))


def test_sums_beyond_32_bits():
    """The farthest there are, of a length at which even unsigned integers of 32 bits overflow."""
    n = 2**32 // 255 + 100
    database = np.vstack([np.zeros(n, np.uint8), np.full(n, 255, np.uint8)])
    rows = np.array([0, 1, 0, 1, 1])
    expected = [[0, n * 255, 0, n * 255, n * 255], [n * 255, 0, n * 255, 0, 0]]
    assert scan(database, database, rows).tolist() == expected
    assert scan(database[:1], database, rows).tolist() == expected[:1]


@pytest.mark.parametrize("offset", [1, 31])
def test_any_place_in_memory_and_in_a_mapped_file(offset, tmp_path):
    """Rows on no boundary, read-only; the last one ends where the file does."""
    n, rows = 4096 - 3, np.array([0, 1, 2, 3, 7, 5, 6])
    queries, database = random_bytes(1, 2, n), random_bytes(2, 8, n)
    expected = oracle(queries, database, rows)
    path = tmp_path / "signatures"
    path.write_bytes(bytes(offset) + database.tobytes())
    with path.open("rb") as file:
        mapped = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    stored = np.frombuffer(mapped, np.uint8, offset=offset).reshape(8, n)
    assert not stored.flags.writeable
    memory = np.frombuffer(bytes(offset) + queries.tobytes(), np.uint8, offset=offset)
    asked = memory.reshape(2, n)
    assert scan(asked, stored, rows).tolist() == expected
    assert scan(asked[1:], stored, rows).tolist() == expected[1:]
