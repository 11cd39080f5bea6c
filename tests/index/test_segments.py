"""Segments: what was written is what is read, and whatever happened to a file is noticed."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from sceneprint.errors import DamagedIndex
from sceneprint.index import open_segment, write_segment
from sceneprint.index.segments import blocks_of, gather

PAGE = 4096


def rows(n: int, length: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (n, length), np.uint8)


@pytest.fixture
def small(tmp_path: Path) -> Path:
    """Seven signatures of 13 bytes: 91, and 5 of padding, and 56 of keys."""
    name = write_segment(tmp_path, [(np.arange(7) * 10, rows(7, 13))])
    return tmp_path / name


@pytest.mark.parametrize(("n", "length"), [(1, 1), (7, 13), (8, 16), (3, 12800)])
def test_round_trip(tmp_path: Path, n: int, length: int) -> None:
    keys, signatures = np.arange(n)[::-1] * 3 - 5, rows(n, length)
    segment = open_segment(tmp_path / write_segment(tmp_path, [(keys, signatures)]), verify=True)
    np.testing.assert_array_equal(segment.keys, keys)
    np.testing.assert_array_equal(segment.signatures, signatures)
    assert len(segment) == n
    assert segment.size == (tmp_path / segment.name).stat().st_size
    assert type(segment.signatures) is np.ndarray
    assert segment.signatures.flags.c_contiguous
    assert not segment.signatures.flags.writeable


def test_the_same_content_has_the_same_name_however_it_came(
    tmp_path: Path, in_blocks: Callable[..., object]
) -> None:
    keys, signatures = np.arange(100), rows(100, 64)
    names = {
        write_segment(tmp_path, in_blocks(keys, signatures, step))  # type: ignore[arg-type]
        for step in (1, 37, 100)
    }
    names.add(write_segment(tmp_path, [(keys, np.asfortranarray(signatures))]))
    assert len(names) == 1
    assert [path.name for path in tmp_path.iterdir()] == list(names)
    other = write_segment(tmp_path, [(keys + 1, signatures)])
    assert other not in names


def test_a_mapping_outlives_its_file(small: Path) -> None:
    segment = open_segment(small, verify=False)
    small.unlink()
    np.testing.assert_array_equal(segment.signatures, rows(7, 13))


def test_every_shorter_file_and_a_longer_one_are_refused(small: Path) -> None:
    data = small.read_bytes()
    assert len(data) == PAGE + 91 + 5 + 56
    for length in (*range(0, PAGE, 31), *range(PAGE, len(data))):
        small.write_bytes(data[:length])
        with pytest.raises(DamagedIndex):
            open_segment(small, verify=False)
    small.write_bytes(data + b"\0")
    with pytest.raises(DamagedIndex, match="4249 bytes, where 4248 were written"):
        open_segment(small, verify=False)
    small.write_bytes(data)
    assert len(open_segment(small, verify=True)) == 7


def test_every_flipped_byte_is_noticed(small: Path) -> None:
    data = bytearray(small.read_bytes())
    signatures = range(PAGE, PAGE + 91)
    for at in (*range(100), *range(100, PAGE, 31), *range(PAGE, len(data))):
        data[at] ^= 1 << at % 8
        small.write_bytes(data)
        if at in signatures:  # too many to read at every start
            assert len(open_segment(small, verify=False)) == 7
        with pytest.raises(DamagedIndex):
            open_segment(small, verify=at in signatures)
        data[at] ^= 1 << at % 8


def test_another_name_or_no_file_is_refused(small: Path) -> None:
    renamed = small.with_name("0" * 64 + ".segment")
    with pytest.raises(DamagedIndex, match="cannot be read"):
        open_segment(renamed, verify=False)
    small.rename(renamed)
    with pytest.raises(DamagedIndex, match="changed header"):
        open_segment(renamed, verify=False)


@pytest.mark.parametrize(
    "blocks",
    [
        [],
        [(np.arange(0), rows(0, 5))],
        [(np.arange(2), rows(3, 5))],
        [(np.arange(3), rows(3, 5)), (np.arange(3), rows(3, 6))],
        [(np.arange(3, dtype=np.int32), rows(3, 5))],
        [(np.arange(3), rows(3, 5).astype(np.int16))],
        [(np.arange(3), rows(3, 0))],
        [(np.arange(3)[None], rows(3, 5))],
    ],
)
def test_what_is_no_block_leaves_nothing_behind(tmp_path: Path, blocks: object) -> None:
    with pytest.raises(ValueError, match=r"segment of no|keys"):
        write_segment(tmp_path, blocks)  # type: ignore[arg-type]
    assert list(tmp_path.iterdir()) == []


def test_gather_counts_rows_through_all_segments(tmp_path: Path) -> None:
    parts = [rows(4, 9, 1), rows(1, 9, 2), rows(5, 9, 3)]
    segments = [
        open_segment(tmp_path / write_segment(tmp_path, [(np.arange(len(x)), x)]), verify=True)
        for x in parts
    ]
    whole = np.concatenate(parts)
    for wanted in ([9, 0, 4, 4, 3], [1, 2, 3], [4], [5, 7], [], list(range(10)), [3, 2]):
        chosen = np.array(wanted, np.int64)
        np.testing.assert_array_equal(gather(segments, chosen), whole[chosen])


def test_blocks_of_rows_fill_their_size() -> None:
    assert [x.tolist() for x in blocks_of(np.arange(5), 10, 25)] == [[0, 1], [2, 3], [4]]
    assert [x.tolist() for x in blocks_of(np.arange(2), 10, 5)] == [[0], [1]]
    assert list(blocks_of(np.arange(0), 10, 5)) == []
