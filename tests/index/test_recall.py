"""Recall as measured when a generation is published, against naive sums and sorts."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from sceneprint.index import Generation, newest, recall
from sceneprint.index.codes import draw
from sceneprint.index.manifests import Recall, manifests, read_manifest
from sceneprint.types import Bytes
from sceneprint.writing import write_durable

Walk = Callable[..., Bytes]
Publish = Callable[..., Generation]


def told(folder: Path) -> Recall | None:
    return read_manifest(manifests(folder)[0][1]).recall


def test_recall_is_the_share_of_the_nearest_that_the_shortlist_finds(
    walk: Walk, published: Publish, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recall, "SHORTLIST", 10)  # as many as are wanted: some must be missed
    monkeypatch.setattr(recall, "BLOCK_BYTES", 7 * 256)  # what is compared at once: 7 frames
    signatures = walk(90, walks=3)
    generation = published(np.arange(90) + 1000, signatures)
    found = told(tmp_path / "map")
    assert found is not None
    assert (found.near, found.sample, found.shortlist) == (10, 50, 10)
    codes = generation.code.encode(signatures)
    hits = 0
    for row in draw(90, 50, 0).tolist():
        exact = np.abs(signatures.astype(int) - signatures[row].astype(int)).sum(1)
        others = [i for i in range(90) if i != row]
        proposed = generation.coarse.nearest(codes[row], 10, np.array([row]))
        tenth = sorted(exact[others])[9]
        hits += int((exact[proposed] <= tenth).sum())
    assert 250 < hits < 500
    assert found.share == hits / 500


def test_a_map_that_is_compared_whole_has_nothing_to_miss(
    walk: Walk, published: Publish, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recall, "SHORTLIST", 20)
    first = published(np.arange(21), walk(21))  # without itself there are as many as are proposed
    assert told(tmp_path / "map") == Recall(1.0, 10, 0, 20, 21)
    published(np.arange(21, 22), walk(22)[21:], first)
    found = told(tmp_path / "map")
    assert found is not None
    assert found.sample == 22


def test_a_map_that_has_hardly_grown_is_not_measured_again(
    walk: Walk, published: Publish, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recall, "SHORTLIST", 10)
    signatures = walk(60)
    measured = []
    generation = None
    for first, after in ((0, 40), (40, 44), (44, 45), (45, 60)):
        generation = published(np.arange(first, after), signatures[first:after], generation)
        found = told(tmp_path / "map")
        assert found is not None
        measured.append(found.frames)
    assert measured == [40, 40, 45, 60]
    assert generation is not None
    assert told(tmp_path / "map") == recall.measure_recall(generation)


def test_so_many_are_looked_up_that_the_scans_stay_short(
    walk: Walk, published: Publish, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recall, "SHORTLIST", 10)
    for limit, sample in ((60 * 256 * 31, 31), (60 * 256 * 31 - 1, 30), (1, 10)):
        monkeypatch.setattr(recall, "COMPARED_BYTES", limit)
        generation = published(np.arange(60), walk(60), folder=tmp_path / str(limit))
        assert recall.measure_recall(generation).sample == sample
        assert recall.measure_recall(generation) == told(tmp_path / str(limit))


@pytest.mark.parametrize("recalled", [{}, {"recall": {"share": 1.0, "measured": "otherwise"}}])
def test_a_generation_of_another_version_is_read_and_was_not_measured(
    walk: Walk, published: Publish, tmp_path: Path, recalled: dict[str, object]
) -> None:
    published(np.arange(5), walk(5))
    ((_, path),) = manifests(tmp_path / "map")
    record = json.loads(path.read_bytes())
    del record["recall"]
    data = json.dumps(record | recalled).encode()
    path.unlink()
    name = f"{record['number']:010d}-{hashlib.sha256(data).hexdigest()[:32]}.json"
    write_durable(path.with_name(name), data)
    opened = newest(tmp_path / "map", "model", 256, verify=True)
    assert opened is not None
    assert len(opened) == 5
    assert told(tmp_path / "map") is None
