"""Tests of nodes that share a database and objects, and build, fetch and delete indexes."""

import os
import time

import pytest
from sqlalchemy import select

from sceneprint.engine.context import require_writable
from sceneprint.engine.search import index_place, local_index
from sceneprint.engine.search.index_place import IN_USE_S
from sceneprint.engine.search.local_index import index_folder
from sceneprint.engine.upkeep import index_upkeep
from sceneprint.errors import DamagedIndex, UnusableStore
from sceneprint.index.index_manifest import manifests
from sceneprint.store.blobs.object_client import open_objects
from sceneprint.store.tables import frames, signatures
from sceneprint_client.api import NewMap, Query

ALL = Query(stages=("retrieve",), k=50)


def await_fetches(engine):
    engine.indexes._fetches.submit(bool).result()


@pytest.fixture(autouse=True)
def _always_look(monkeypatch):
    monkeypatch.setattr(local_index, "_LOOK_S", 0.0)
    monkeypatch.setattr(index_place, "LOOK_S", 0.0)
    monkeypatch.setattr(index_upkeep, "ELSEWHERE_S", 0.0)


@pytest.fixture
def place(store_url, request, tmp_path):
    if store_url.startswith("sqlite"):
        return f"file://{tmp_path}/shared"
    return f"{request.getfixturevalue('bucket')}/fleet"


@pytest.fixture
def host(make_engine, store_url, place, tmp_path):
    """Another host of the fleet, with a folder of its own."""
    (tmp_path / "common" / "blobs").mkdir(parents=True)

    def make(name, **more):
        fields = {
            "database_url": store_url, "blob_url": f"file://{tmp_path}/common",
            "index_url": place, "unindexed_frames": 2, "undo_window_s": 0,
        }  # fmt: skip
        return make_engine(tmp_path / name, **{**fields, **more})

    return make


@pytest.fixture
def fill(uploads):
    """Index uploads in a map; returns their ids."""

    def add(engine, which, name="hall"):
        added = [engine.add(uploads[i], name)[0] for i in which]
        assert engine.work_off() == ["succeeded"] * len(which)
        return [frame.frame_id for frame in added]

    return add


@pytest.fixture
def built(host, fill):
    """A host that has built and shared an index of four frames."""
    engine = host("one")
    engine.create_map(NewMap(name="hall", model="depth"))
    fill(engine, range(4))
    assert engine.publish_due() == 1
    return engine


def folder_of(engine, name="hall"):
    return index_folder(engine.settings.indexes, engine.row(name))


def numbers(engine):
    return [number for number, _ in manifests(folder_of(engine))]


def ask(engine, uploads, which=1, name="hall"):
    return engine.queries.upload([name], uploads[which].data, uploads[which].meta, ALL)


def matches_of(answer):
    return [(match.frame_id, match.distance) for match in answer.matches]


def keys(objects):
    return sorted(entry.key.rpartition("/")[2] for entry in objects.list("index/"))


def test_one_host_builds_and_others_fetch_what_they_serve(built, host, fill, uploads, place):
    other, objects = host("two"), open_objects(place)
    assert other.publish_due() == 0  # it is built, and nobody has asked this host for the map
    assert numbers(other) == []
    own = {path.name: path.read_bytes() for path in folder_of(built).glob("[0-9a-f]*")}
    stored = {one.key.rpartition("/")[2]: objects.get(one.key) for one in objects.list("index/")}
    assert stored == own
    assert "0000000001.json" in own
    first = ask(other, uploads)  # it waits for nothing
    await_fetches(other)
    second = ask(other, uploads)
    assert second.index_version == 1
    assert matches_of(second) == matches_of(first) == matches_of(ask(built, uploads))
    fetched = {path.name: path.read_bytes() for path in folder_of(other).glob("[0-9a-f]*")}
    assert fetched == own
    fill(other, range(4, 8))
    assert (other.publish_due(), built.publish_due()) == (1, 0)
    ask(built, uploads)
    await_fetches(built)
    assert ask(built, uploads).index_version == 2
    assert matches_of(ask(built, uploads)) == matches_of(ask(other, uploads))
    assert ask(built, uploads).counts.map == 8


def test_a_number_is_given_once(built):
    row = built.row("hall")
    head = built.indexes.head(row)
    assert built.indexes.share(row, head)  # a try whose answer was lost
    assert not built.indexes.share(row, head.model_copy(update={"anchor": "another"}))
    assert built.indexes.head(row) == head


def signature(engine, frame_id):
    return bytes(
        engine.fetch(
            select(signatures.c.vector).join(frames).where(frames.c.id == frame_id)
        ).scalar_one()
    )


def test_no_byte_of_a_deleted_frame_is_left_in_any_copy(built, host, uploads, place, tmp_path):
    other, service = host("two"), host("three", purge_deadline_s=1)
    for engine in (other, service):
        ask(engine, uploads)
        await_fetches(engine)
        assert numbers(engine) == [1]
    objects, secret = open_objects(place), signature(built, built.ids()[0])

    def held():
        stored = (objects.get(entry.key) for entry in objects.list("index/"))
        files = {name: tmp_path.glob(f"{name}/index/*/*.*") for name in ("one", "two", "three")}
        return {
            *(["store"] if any(secret in data for data in stored) else []),
            *(name for name, of in files.items() if any(secret in p.read_bytes() for p in of)),
        }  # fmt: skip

    assert held() == {"store", "one", "two", "three"}
    built.delete_frame("hall", built.ids()[0])
    assert built.purging.now().indexes == 1
    assert held() == {"two", "three"}
    assert other.purging.now().indexes == 0  # it fetches the other's
    assert held() == {"three"}
    service.memory_purging._purged = time.monotonic() - 1
    service.memory_purging.run()
    assert held() == set()
    assert keys(objects)[:2] == [".swept", "0000000002.json"]
    assert [ask(engine, uploads).counts.map for engine in (built, other, service)] == [3, 3, 3]
    assert ask(other, uploads).index_version == 2


def test_a_service_does_not_wait_for_ever_for_an_index_without_the_frame(built, host, uploads):
    service = host("two", purge_deadline_s=1)
    ask(service, uploads)
    await_fetches(service)
    built.delete_frame("hall", built.ids()[0])
    left = []
    for _ in range(2):
        service.memory_purging._purged = time.monotonic() - 1
        service.memory_purging.run()
        left.append(numbers(service))
    assert left == [[1], []]
    assert ask(service, uploads).counts.map == 3


def test_nothing_is_shared_of_maps_that_are_gone(built, place, host, uploads):
    service = host("two", purge_deadline_s=1)
    ask(service, uploads)
    await_fetches(service)
    folder, objects = folder_of(service), open_objects(place)
    built.delete_map("hall")
    built.purging.now()
    assert {entry.key.split("/")[1] for entry in objects.list("index/")} == {".swept"}
    service.memory_purging._purged = time.monotonic() - 1
    service.memory_purging.run()
    assert not folder.exists()


def test_what_is_damaged_in_the_store_is_withdrawn_and_built_anew(built, host, uploads, place):
    objects, other = open_objects(place), host("two")
    (key,) = [entry.key for entry in objects.list("index/") if entry.key.endswith(".faiss")]
    data = bytearray(objects.get(key))
    data[-5] ^= 1
    objects.put(key, bytes(data))
    with pytest.raises(DamagedIndex, match="index 1 of map 'hall' is damaged"):
        other.indexes.sync(other.row("hall"))
    assert list(folder_of(other).glob("[0-9a-f]*.faiss")) == []
    assert host("three").publish_due() == 1
    other.indexes.sync(other.row("hall"))
    assert numbers(other) == [2]
    assert ask(other, uploads).index_version == 2


def test_a_file_that_is_damaged_here_is_fetched_again(built, host):
    (path,) = folder_of(built).glob("*.faiss")
    sound = path.read_bytes()
    path.write_bytes(b"x" + sound[1:])
    (built.settings.indexes / ".scrubbed").unlink(missing_ok=True)
    again = host("one")
    assert sum(again.publish_due() for _ in range(10)) == 0  # nothing is built
    assert path.read_bytes() == sound


def test_queries_go_on_without_the_store_and_workers_try_again(
    make_engine, postgres_url, bucket, object_server, fill, uploads, tmp_path, monkeypatch, caplog
):
    (tmp_path / "common" / "blobs").mkdir(parents=True)
    fields = {
        "database_url": postgres_url, "blob_url": f"file://{tmp_path}/common",
        "unindexed_frames": 2,
    }  # fmt: skip
    with monkeypatch.context() as away:
        away.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9")  # where nobody listens
        engine = make_engine(tmp_path / "one", index_url=f"{bucket}/x", **fields)
        engine.create_map(NewMap(name="hall", model="depth"))
        names = fill(engine, range(4))
        assert engine.publish_due() == 0
        answer = ask(engine, uploads)
        await_fetches(engine)
        assert (answer.matches[0].frame_id, answer.index_version) == (names[1], 0)
        assert numbers(engine) == []
    output = {record.message for record in caplog.records}
    assert output >= {"index publication failed", "index not fetched"}
    there = make_engine(tmp_path / "one", index_url=f"{bucket}/x", **fields)
    assert there.publish_due() == 1


@pytest.mark.parametrize(("idle_s", "left"), [(IN_USE_S + 60, False), (IN_USE_S - 60, True)])
def test_room_is_made_of_indexes_that_nobody_uses(built, host, fill, uploads, idle_s, left):
    built.create_map(NewMap(name="other", model="depth"))
    fill(built, range(4), "other")
    assert built.publish_due() == 1
    one = sum(path.stat().st_size for path in folder_of(built).glob("*.*"))
    node = host("two", index_cache_bytes=one + one // 2)
    ask(node, uploads)
    await_fetches(node)
    ago = time.time() - idle_s
    os.utime(folder_of(node) / ".used", (ago, ago))
    ask(node, uploads, name="other")
    await_fetches(node)
    assert bool(manifests(folder_of(node))) == left
    assert bool(manifests(folder_of(node, "other"))) != left
    for name in ("hall", "other"):
        assert ask(node, uploads, name=name).counts.map == 4


def test_another_database_is_refused(built, make_engine, place, tmp_path):
    stranger = make_engine(tmp_path / "stranger", index_url=place)
    stranger.create_map(NewMap(name="hall", model="depth"))
    with pytest.raises(UnusableStore, match="another database"):
        stranger.indexes.head(stranger.row("hall"))


@pytest.fixture
def nodes(make_engine, postgres_url, bucket, tmp_path):
    shared = {"database_url": postgres_url, "blob_url": f"{bucket}/fleet"}
    one, other = (make_engine(tmp_path / name, **shared) for name in ("one", "other"))
    return one, other


def keys_of(objects, prefix):
    return sorted(entry.key for entry in objects.list(prefix))


def test_what_one_node_takes_another_works_on(nodes, uploads, bucket):
    one, other = nodes
    objects = open_objects(f"{bucket}/fleet")
    one.create_map(NewMap(name="hall", model="depth"))
    added = [one.add(each)[0] for each in uploads[:2]]
    assert len(keys_of(objects, "blobs/")) == 2
    assert other.work_off() == ["succeeded"] * 2
    assert len(keys_of(objects, "blobs/")) == 4  # with the artifacts
    result = one.ask(uploads[0], Query(k=1))
    assert result.status == "found"
    assert result.matches[0].frame_id == added[0].frame_id
    assert one.query_log.flush(60)
    assert other.query_log.find(result.query_id).answer == result
    assert keys_of(objects, "queries/") == [f"queries/{result.query_id}"]
    assert not (one.settings.data_dir / "blobs").exists()
    assert not (one.settings.data_dir / "queries").exists()
    # what is deleted for good is gone from the bucket at once, and with the map so is everything
    other.delete_frame("hall", added[1].frame_id)
    assert len(keys_of(objects, "blobs/")) == 4  # it can be restored
    assert one.tombstones.purge(everything=True) == 1
    assert len(keys_of(objects, "blobs/")) == 2
    one.delete_map("hall")
    assert keys_of(objects, "blobs/") == []


def test_what_ends_with_a_process_is_for_one_process_alone(make_engine, uploads):
    engine = make_engine(blob_url="memory:///")
    engine.create_map(NewMap(name="hall", model="depth"))
    engine.add(uploads[0])
    assert engine.work_off() == ["succeeded"]
    with pytest.raises(UnusableStore, match=r"memory:///.*Client.embedded"):
        require_writable(engine.settings)
