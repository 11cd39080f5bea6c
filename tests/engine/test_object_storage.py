"""Tests of engines that share only PostgreSQL and an object store."""

import io
import json
import tarfile

import pytest

from benchmarks.s3 import ObjectServer
from sceneprint.engine.admin import statistics as measuring
from sceneprint.engine.context import require_writable
from sceneprint.errors import UnusableStore
from sceneprint.store.blobs.object_client import open_objects
from sceneprint_client.api import NewMap, Query
from sceneprint_client.api.frames import ImportOptions


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


def test_objects_are_removed_by_one_request_and_those_that_are_needed_stay(
    make_engine, postgres_url, uploads, tmp_path, work_off, monkeypatch
):
    """Writers wait meanwhile, and a store of objects may be far away."""
    with ObjectServer(log=tmp_path / "requests") as server:
        for name, value in server.env.items():
            monkeypatch.setenv(name, value)
        bucket = server.bucket("counted")
        engine = make_engine(tmp_path / "node", database_url=postgres_url, blob_url=bucket)
        for name in ("hall", "shop"):
            engine.create_map(NewMap(name=name, model="depth"))
        for each in uploads[:5]:
            engine.add_frame("hall", each.data, each.meta)
        engine.add_frame("shop", uploads[0].data, uploads[0].meta)
        assert work_off(engine) == ["succeeded"] * 6
        objects = open_objects(bucket)
        assert len(keys(objects, "blobs/")) == 10
        before = server.requests()
        engine.delete_map("hall")
        asked = server.requests() - before
        assert (asked["POST"], asked["DELETE"]) == (1, 0)
        assert len(keys(objects, "blobs/")) == 2
        told = engine.queries.upload(["shop"], uploads[0].data, uploads[0].meta, Query(k=1))
        assert told.status == "found"


def test_an_archive_is_read_where_it_lies(nodes, uploads, work_off, bucket):
    one, other = nodes
    one.create_map(NewMap(name="hall", model="depth"))
    made = io.BytesIO()
    camera = uploads[0].meta.intrinsics.model_dump(exclude={"distortion"})
    with tarfile.open(fileobj=made, mode="w:gz") as archive:
        members = {"run/intrinsics.json": json.dumps(camera).encode()}
        members |= {f"run/{i}.png": one.data for i, one in enumerate(uploads[:3])}
        for name, data in members.items():
            info = tarfile.TarInfo(name)
            info.size = len(data)
            archive.addfile(info, io.BytesIO(data))
    with one.imports.receive("hall", ImportOptions()) as receiver:
        receiver.write(made.getvalue())
        file = receiver.end()
    job = one.imports.begin("hall", file, ImportOptions())[0]
    assert work_off(other) == ["succeeded"] * 4
    told = one.get_job(job.job_id)
    assert told.result["received"] == 3
    names = {key.rpartition("/")[2] for key in keys(open_objects(f"{bucket}/fleet"), "blobs/")}
    assert len(names) == 6  # uploads and artifacts; the archive went with its job
    assert file.blob not in names


def test_what_ends_with_a_process_is_for_one_process_alone(make_engine, uploads, work_off):
    engine = make_engine(blob_url="memory:///")
    engine.create_map(NewMap(name="hall", model="depth"))
    engine.add_frame("hall", uploads[0].data, uploads[0].meta)
    assert work_off(engine) == ["succeeded"]
    with pytest.raises(UnusableStore, match=r"memory:///.*Client.embedded"):
        require_writable(engine.settings)
