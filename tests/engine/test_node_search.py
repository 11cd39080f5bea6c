"""Tests of a node without an index, which compares all signatures."""

from contextlib import contextmanager

import numpy as np
import pytest

from benchmarks.indexed_frames import fill
from sceneprint.engine.search import local_index
from sceneprint.geometry.retrieval.ranking import distances
from sceneprint.settings import Settings
from sceneprint_client.api import NamedFrame, Query
from tests.whole_engine import Engine

#: Frames of both maps, and bytes of a signature.
SIZES, LENGTH = {"hall": 300, "yard": 200}, 64


@pytest.fixture
def node(store_url, tmp_path, monkeypatch):
    """Nodes with indexes of their own on one database; they always look for a newer index."""
    monkeypatch.setattr(local_index, "_LOOK_S", 0.0)
    opened = []

    def engine(name):
        values = {
            "data_dir": tmp_path / "data", "index_dir": tmp_path / name, "database_url": store_url,
            "unindexed_frames": 10, "decoders": 0,
        }  # fmt: skip
        (tmp_path / "data" / "blobs").mkdir(parents=True, exist_ok=True)
        opened.append(Engine(Settings.model_validate(values)))
        return opened[-1]

    yield engine
    for one in reversed(opened):
        one.close()


@pytest.fixture(scope="module")
def places():
    """Signatures of both maps."""
    return {name: drawn(n, LENGTH, seed=i) for i, (name, n) in enumerate(SIZES.items())}


def drawn(n, length, seed):
    return np.random.default_rng(seed).integers(0, 256, (n, length), np.uint8)


def ask(engine, frame, maps):
    query = Query(stages=("retrieve",), k=10, keep=False)
    named = NamedFrame(map=frame.rpartition("-")[0], frame_id=frame)
    return engine.queries.stored(maps, named, query)


def found(answer):
    return [(one.frame_id, one.distance) for one in answer.matches]


def nearest(places, frame, metric="l2"):
    """The ten nearest frames of all maps: all compared; equal ones in the order they came."""
    home, _, number = frame.rpartition("-")
    query = places[home][int(number) - 1]
    listed = [
        (distance, order, f"{name}-{i + 1}")
        for name, made in places.items()
        for order, (i, distance) in enumerate(enumerate(distances(query, made, metric).tolist()))
        if (name, i + 1) != (home, int(number))
    ]
    return [(name, distance) for distance, _, name in sorted(listed)[:10]]


@contextmanager
def rows_read(engine):
    """Count the signatures that are read for a map, by statement."""
    read = []

    def changes(connection, row, revision, limit=256):
        for block in real(connection, row, revision, limit):
            read.append(len(block))
            yield block

    real = local_index.changes_since
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(local_index, "changes_since", changes)
        yield read


def test_signatures_are_read_once_and_compared_exactly_until_there_is_an_index(
    node, places, whitened_model
):
    worker, service = node("worker"), node("service")
    for name, made in places.items():
        fill(worker.store.database, name, whitened_model, made)
    wanted = nearest(places, "hall-77")
    with rows_read(service) as read:
        first = ask(service, "hall-77", ["hall", "yard"])
        assert sum(read) == sum(SIZES.values())
        again = ask(service, "hall-77", ["hall", "yard"])
        assert sum(read) == sum(SIZES.values())
    assert found(first) == found(again) == wanted
    assert (first.exact, first.index_version) == (True, 0)
    assert first.counts.compared == sum(SIZES.values()) - 1
    assert worker.publish_due() == 2
    indexed = ask(worker, "hall-77", ["hall", "yard"])
    assert (found(indexed), indexed.exact) == (wanted, True)
    with rows_read(worker) as read:
        ask(worker, "hall-78", ["hall"])
        assert read == []  # it is all in the index


def test_a_node_that_is_far_behind_begins_with_the_newest_index(
    node, places, whitened_model, monkeypatch
):
    monkeypatch.setattr(local_index, "READ_MOST", 50)
    worker, service = node("shared"), node("shared")
    made = places["hall"]
    fill(worker.store.database, "hall", whitened_model, made[:100])
    ask(service, "hall-7", ["hall"])
    fill(worker.store.database, "hall", whitened_model, made[100:])
    assert worker.publish_due() == 1
    with rows_read(service) as read:
        answer = ask(service, "hall-7", ["hall"])
    assert sum(read) == 0
    assert (answer.index_version, answer.exact) == (1, True)
    assert found(answer) == nearest({"hall": made}, "hall-7")


def test_maps_of_psi_are_compared_whole_by_l1_without_an_index(node, small_model):
    engine = node("alone")
    made = drawn(100, small_model.signature_bytes, seed=4)
    fill(engine.store.database, "old", small_model, made)
    assert engine.publish_due() == 0
    answer = ask(engine, "old-8", ["old"])
    assert found(answer) == nearest({"old": made}, "old-8", "l1")
    assert (answer.exact, answer.index_version, answer.counts.compared) == (True, 0, 99)
