"""Damage: no changed or shortened file is ever used; the generation before is, or none."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from sceneprint.errors import DamagedIndex
from sceneprint.index import Generation, newest
from sceneprint.index.manifests import Manifest, manifests, read_manifest
from sceneprint.types import Bytes

Walk = Callable[..., Bytes]
Publish = Callable[..., Generation]
LENGTH = 32


@pytest.fixture
def folder(walk: Walk, published: Publish, tmp_path: Path) -> Path:
    """Two generations, of 20 and of 45 frames: refitted, so that they share a segment alone."""
    signatures = walk(45, LENGTH)
    first = published(np.arange(20), signatures[:20])
    published(np.arange(20, 45), signatures[20:], first)
    return tmp_path / "map"


def number_of(folder: Path, verify: bool = False) -> int | None:
    found = newest(folder, "model", LENGTH, verify=verify)
    return None if found is None else found.number


def own_files(folder: Path) -> dict[str, Path]:
    """Files of the second generation alone, by kind."""
    (_, second), (_, first) = manifests(folder)
    shared = {name for name, _ in read_manifest(first).files}
    own = [folder / name for name, _ in read_manifest(second).files if name not in shared]
    return {"json": second} | {path.suffix[1:]: path for path in own}


@pytest.mark.parametrize("kind", ["json", "faiss", "code", "rows", "segment"])
def test_a_changed_file_is_passed_over(
    folder: Path, kind: str, caplog: pytest.LogCaptureFixture
) -> None:
    assert number_of(folder, verify=True) == 2
    path = own_files(folder)[kind]
    data = bytearray(path.read_bytes())
    ends = range(min(len(data), 120)), range(max(len(data) - 120, 0), len(data))
    for at in sorted({*ends[0], *ends[1], *range(0, len(data), 211)}):
        data[at] ^= 1 << at % 8
        path.write_bytes(data)
        assert number_of(folder, verify=True) == 1, at
        data[at] ^= 1 << at % 8
    path.write_bytes(data)
    assert number_of(folder, verify=True) == 2
    assert caplog.record_tuples[0][:2] == ("sceneprint.index.generations", logging.WARNING)
    assert path.name in caplog.text


@pytest.mark.parametrize("kind", ["json", "faiss", "code", "rows", "segment"])
def test_a_short_long_or_missing_file_is_passed_over(folder: Path, kind: str) -> None:
    path = own_files(folder)[kind]
    data = path.read_bytes()
    for length in {*range(0, len(data), max(len(data) // 60, 1)), len(data) - 1}:
        path.write_bytes(data[:length])
        assert number_of(folder) == 1
    path.write_bytes(data + b"\0")
    assert number_of(folder) == 1
    path.unlink()
    assert number_of(folder) == 1
    path.mkdir()
    assert number_of(folder) == 1


def test_what_is_open_does_not_vouch_for_what_is_gone(folder: Path) -> None:
    """The next generation must not name a file that is mapped here and nowhere else."""
    second = newest(folder, "model", LENGTH)
    own_files(folder)["segment"].unlink()
    found = newest(folder, "model", LENGTH, known=second)
    assert found is not None
    assert found.number == 1


def test_files_removed_while_they_are_opened_are_not_damaged(
    folder: Path,
    walk: Walk,
    published: Publish,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """A builder that publishes twice between the listing of a folder and the opening."""
    passed = False

    def late(path: Path) -> Manifest:
        nonlocal passed
        if not passed:
            passed = True
            signatures = walk(10, LENGTH, seed=3)
            published(np.arange(10), signatures, published(np.arange(5), signatures[:5]))
            assert not path.exists() or int(path.name[:10]) > 2
        return read_manifest(path)

    monkeypatch.setattr("sceneprint.index.generations.read_manifest", late)
    assert number_of(folder) == 4
    assert caplog.record_tuples == []


def test_rows_of_signatures_are_read_on_demand_only(folder: Path) -> None:
    path = own_files(folder)["segment"]
    data = bytearray(path.read_bytes())
    data[4096 + 5] ^= 1
    path.write_bytes(data)
    assert number_of(folder) == 2
    assert number_of(folder, verify=True) == 1


def test_without_a_sound_generation_there_is_none(
    folder: Path, walk: Walk, published: Publish
) -> None:
    for path in folder.glob("*.faiss"):
        path.write_bytes(b"")
    assert number_of(folder) is None
    signatures = walk(45, LENGTH)
    assert published(np.arange(45), signatures).number == 3
    assert number_of(folder, verify=True) == 3


def test_publishing_goes_on_from_the_older_and_keeps_it(
    folder: Path, walk: Walk, published: Publish
) -> None:
    own_files(folder)["faiss"].unlink()
    older = newest(folder, "model", LENGTH)
    assert older is not None
    assert older.number == 1
    assert published(np.arange(20, 45), walk(45, LENGTH)[20:], older).number == 3
    assert [number for number, _ in manifests(folder)] == [3, 1]
    assert number_of(folder, verify=True) == 3
    own_files(folder)["rows"].write_bytes(b"")
    assert number_of(folder, verify=True) == 1


def test_a_damaged_file_is_written_again_when_its_content_is(
    folder: Path, walk: Walk, published: Publish
) -> None:
    """Names come from content, so that a name may be there already, with other bytes."""
    for path in folder.iterdir():
        if path.suffix in {".faiss", ".code", ".rows"}:
            path.write_bytes(b"damaged")
    signatures = walk(45, LENGTH)
    published(np.arange(20), signatures[:20])  # the very bytes of the first generation
    assert number_of(folder, verify=True) == 3


@pytest.mark.parametrize(
    "change",
    [
        {"schema_version": 2},
        {"files": []},
        {"files": [["../../etc/passwd", 1]]},
        {"number": None, "unknown": 1},
        {"files": 3},
    ],
)
def test_a_manifest_that_means_something_else_is_refused(
    folder: Path, change: dict[str, object]
) -> None:
    """With the name that its content gives: of a later version, or of somebody's own making."""
    import hashlib

    path = own_files(folder)["json"]
    data = json.dumps(json.loads(path.read_bytes()) | change).encode()
    other = path.with_name(f"0000000009-{hashlib.sha256(data).hexdigest()[:32]}.json")
    other.write_bytes(data)
    with pytest.raises(DamagedIndex):
        read_manifest(other)
    assert number_of(folder) == 2
