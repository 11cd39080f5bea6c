"""Tests that a damaged file is never used, but an older version or none."""

import json
import logging

import faiss
import numpy as np
import pytest

from sceneprint.errors import DamagedIndex
from sceneprint.index.faiss_index import map_index
from sceneprint.index.index_manifest import manifests, read_manifest
from sceneprint.index.index_version import newest
from sceneprint.index.sketches import map_sketches
from sceneprint.sealed_record import _checksum as checksum
from sceneprint.sealed_record import unseal

LENGTH = 32


KINDS = ["json", "keys", "faiss", "sketches", "means"]
RECALL = {"share": 1.0, "near": 10, "sample": 0, "probes": 0, "frames": 0}


@pytest.fixture
def folder(walk, published, tmp_path):
    signatures = walk(45, LENGTH)
    first = published(np.arange(20), signatures[:20], flat_bytes=0)
    published(np.arange(20, 45), signatures[20:], first, flat_bytes=0)
    return tmp_path / "map"


def number_of(folder):
    actual = newest(folder, "model", LENGTH)
    return None if actual is None else actual.number


def own_files(folder):
    (_, path), *_ = manifests(folder)
    own = [folder / name for name, _ in read_manifest(path).files]
    return {"json": path} | {path.suffix[1:]: path for path in own}


@pytest.mark.parametrize("kind", KINDS)
def test_a_changed_file_is_passed_over(folder, kind, caplog):
    assert number_of(folder) == 2
    path = own_files(folder)[kind]
    data = bytearray(path.read_bytes())
    ends = range(min(len(data), 40)), range(max(len(data) - 40, 0), len(data))
    for at in sorted({*ends[0], *ends[1], *range(0, len(data), 211)}):
        data[at] ^= 1 << at % 8
        path.write_bytes(data)
        assert number_of(folder) == 1, at
        data[at] ^= 1 << at % 8
    path.write_bytes(data)
    assert number_of(folder) == 2
    assert caplog.record_tuples[0][:2] == ("sceneprint.index.index_version", logging.WARNING)
    assert path.name in caplog.text


@pytest.mark.parametrize("kind", KINDS)
def test_a_short_long_or_missing_file_is_passed_over(folder, kind):
    path = own_files(folder)[kind]
    data = path.read_bytes()
    for length in {*range(0, len(data), max(len(data) // 20, 1)), len(data) - 1}:
        path.write_bytes(data[:length])
        assert number_of(folder) == 1
    path.write_bytes(data + b"\0")
    assert number_of(folder) == 1
    path.unlink()
    assert number_of(folder) == 1
    path.mkdir()
    assert number_of(folder) == 1


def test_what_is_open_does_not_vouch_for_what_is_gone(folder):
    second = newest(folder, "model", LENGTH)
    own_files(folder)["faiss"].unlink()
    actual = newest(folder, "model", LENGTH, previous=second)
    assert actual.number == 1


def test_without_a_sound_version_there_is_none(folder, walk, published):
    for path in folder.glob("*.faiss"):
        path.write_bytes(b"")
    assert number_of(folder) is None
    signatures = walk(45, LENGTH)
    assert published(np.arange(45), signatures).number == 3
    assert number_of(folder) == 3


def test_publishing_goes_on_from_the_older_and_keeps_it(folder, walk, published):
    own_files(folder)["faiss"].unlink()
    older = newest(folder, "model", LENGTH)
    assert older.number == 1
    assert published(np.arange(20, 45), walk(45, LENGTH)[20:], older).number == 3
    assert [number for number, _ in manifests(folder)] == [3, 1]
    assert number_of(folder) == 3
    own_files(folder)["keys"].write_bytes(b"")
    assert number_of(folder) == 1


def test_a_damaged_file_is_written_again_when_its_content_is(folder, walk, published):
    """Names come from content, so that a name may be there already, with other bytes."""
    for path in folder.iterdir():
        if path.suffix in {".faiss", ".keys", ".sketches", ".means"}:
            path.write_bytes(b"damaged")
    signatures = walk(45, LENGTH)
    published(np.arange(20), signatures[:20], flat_bytes=0)
    assert number_of(folder) == 3


@pytest.mark.parametrize(
    "change",
    [
        {"schema_version": 3},
        {"number": 8},
        {"segments": [{"files": [], "recall": RECALL}]},
        {"segments": [{"files": [["../../etc/passwd", 1]], "recall": RECALL}]},
        {"segments": [{"files": [[f"{'0' * 64}.keys", 8]], "recall": RECALL}]},
        {"segments": [{"files": [], "recall": None}]},
        {"segments": 3},
        {"unknown": 1},
    ],
)
def test_a_manifest_that_means_something_else_is_refused(folder, change):
    values = unseal(own_files(folder)["json"].read_bytes()) | {"number": 9} | change
    other = folder / "0000000009.json"
    other.write_bytes(json.dumps(values | {"sha256": checksum(values)}).encode())
    with pytest.raises(DamagedIndex):
        read_manifest(other)
    assert number_of(folder) == 2


@pytest.mark.parametrize(
    ("kind", "dimension", "qtype", "n"),
    [
        ("IndexFlat", LENGTH, None, 45),
        ("IndexScalarQuantizer", LENGTH, "QT_8bit_direct", 44),
        ("IndexScalarQuantizer", LENGTH - 1, "QT_8bit_direct", 45),
    ],
)
def test_another_kind_of_faiss_index_is_refused(tmp_path, kind, dimension, qtype, n):
    rows = np.random.default_rng(0).integers(0, 256, (n, dimension)).astype(np.float32)
    more = () if qtype is None else (getattr(faiss.ScalarQuantizer, qtype),)
    index = getattr(faiss, kind)(dimension, *more)
    index.train(rows)
    index.add(rows)
    faiss.write_index(index, str(tmp_path / "other"))
    with pytest.raises(DamagedIndex, match="not a FAISS index of 45"):
        map_index(tmp_path / "other", 45, LENGTH)


def test_sketches_of_other_signatures_are_refused(folder, tmp_path):
    path, means = (own_files(folder)[kind] for kind in ("sketches", "means"))
    assert len(map_sketches(path, means, 45, LENGTH, 1)) == 45
    for n, dimension in ((44, LENGTH), (45, LENGTH + 8)):
        with pytest.raises(DamagedIndex, match=rf"not a FAISS index of {n} sketches"):
            map_sketches(path, means, n, dimension, 1)
    with pytest.raises(DamagedIndex, match="not the means of signatures of 31 bytes"):
        map_sketches(path, means, 45, LENGTH - 1, 1)  # as many bytes of bits
    data = path.read_bytes()
    for wrong in (b"", data[:20], data[:-1], b"X" + data[1:]):
        path.write_bytes(wrong)
        with pytest.raises(DamagedIndex, match="FAISS cannot read it"):
            map_sketches(path, means, 45, LENGTH, 1)
    other = faiss.IndexBinaryHash(LENGTH, 8)
    faiss.write_index_binary(other, str(tmp_path / "other"))
    with pytest.raises(DamagedIndex, match="not a FAISS index of 0 sketches"):
        map_sketches(tmp_path / "other", means, 0, LENGTH, 1)
