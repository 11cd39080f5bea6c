"""Tests of engines that share only PostgreSQL and an object store."""

import pytest

from sceneprint.engine.admin import statistics as measuring
from sceneprint.engine.context import require_writable
from sceneprint.errors import UnusableStore
from sceneprint.store.blobs.object_client import open_objects
from sceneprint_client.api import NewMap, Query


@pytest.fixture
def nodes(make_engine, postgres_url, bucket, tmp_path):
    """Two, each with a data folder of its own."""
    shared = {"database_url": postgres_url, "blob_url": f"{bucket}/fleet"}
    one, other = (make_engine(tmp_path / name, **shared) for name in ("one", "other"))
    return one, other


def keys(objects, prefix):
    return sorted(one.key for one in objects.list(prefix))


def test_what_one_node_takes_another_works_on(nodes, uploads, work_off, bucket):
    one, other = nodes
    objects = open_objects(f"{bucket}/fleet")
    one.create_map(NewMap(name="hall", model="depth"))
    added = [one.add_frame("hall", each.data, each.meta)[0] for each in uploads[:2]]
    assert len(keys(objects, "blobs/")) == 2
    assert work_off(other) == ["succeeded"] * 2
    assert len(keys(objects, "blobs/")) == 4  # with the artifacts
    told = one.queries.upload(["hall"], uploads[0].data, uploads[0].meta, Query(k=1))
    assert told.status == "found"
    assert told.matches[0].frame_id == added[0].frame_id
    assert one.query_log.flush(60)
    assert other.query_log.find(told.query_id).answer == told
    assert keys(objects, "queries/") == [f"queries/{told.query_id}"]
    assert not (one.settings.data_dir / "blobs").exists()
    assert not (one.settings.data_dir / "queries").exists()
    size = measuring.sizes(one.settings, one.store)
    assert size.blobs == sum(each.size for each in objects.list("blobs/"))
    assert size.database is not None
    assert size.database > 1 << 20
    row_of = {each.digest: each.place for each in one.store.blobs.entries()}
    assert all(place.startswith(f"{bucket}/fleet/blobs/") for place in row_of.values())
    # what is deleted for good is gone from the bucket at once, and with the map so is everything
    other.delete_frame("hall", added[1].frame_id)
    assert len(keys(objects, "blobs/")) == 4  # it can be restored
    assert one.tombstones.purge(everything=True) == 1
    assert len(keys(objects, "blobs/")) == 2
    one.delete_map("hall")
    assert keys(objects, "blobs/") == []


def test_what_ends_with_a_process_is_for_one_process_alone(make_engine, uploads, work_off):
    engine = make_engine(blob_url="memory:///")
    engine.create_map(NewMap(name="hall", model="depth"))
    engine.add_frame("hall", uploads[0].data, uploads[0].meta)
    assert work_off(engine) == ["succeeded"]
    with pytest.raises(UnusableStore, match=r"memory:///.*Client.embedded"):
        require_writable(engine.settings)
