"""Tests of the pair table on disk: built once, memory-mapped, and verified."""

import numpy as np

from sceneprint.models import build_table, open_table


def same(a, b):
    return (
        np.array_equal(a.features, b.features)
        and np.array_equal(a.components, b.components)
        and np.array_equal(a.posteriors, b.posteriors)
    )


def test_built_once_and_mapped(small_model, tmp_path):
    steps = []
    first = open_table(small_model, tmp_path / "cache", lambda done, n: steps.append((done, n)))
    (file,) = (tmp_path / "cache").iterdir()
    assert small_model.id in file.name
    assert steps[-1] == (small_model.parameters.table.n_bins,) * 2
    steps.clear()
    again = open_table(small_model, tmp_path / "cache", lambda done, n: steps.append((done, n)))
    assert steps == []
    assert same(first, again)
    assert same(first, build_table(small_model))
    base = again.features
    while isinstance(base, np.ndarray) and not isinstance(base, np.memmap):
        base = base.base
    assert isinstance(base, np.memmap)


def test_a_damaged_file_is_built_anew(small_model, tmp_path):
    right = build_table(small_model)
    open_table(small_model, tmp_path)
    (file,) = tmp_path.iterdir()
    whole = file.read_bytes()
    flipped = bytearray(whole)
    flipped[len(whole) // 2] ^= 1
    for damage in (b"", whole[: len(whole) // 2], b"x" * len(whole), bytes(flipped), whole + b"x"):
        file.unlink()  # a file that is mapped somewhere must not be written over
        file.write_bytes(damage)
        assert same(open_table(small_model, tmp_path), right)
        assert file.read_bytes() == whole


def test_without_a_cache_folder_the_table_is_held(small_model, tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("not a folder")
    assert same(open_table(small_model, blocked), build_table(small_model))
    assert blocked.read_text() == "not a folder"
