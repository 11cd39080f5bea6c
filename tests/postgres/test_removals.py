"""Tests of the removal of blobs, which blocks no writer and keeps acknowledged data."""

import hashlib
import socket
import threading
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import closing, suppress
from socketserver import BaseRequestHandler, ThreadingTCPServer

import pytest
from sqlalchemy import select, text, update

from benchmarks.postgres import Server
from benchmarks.waiting import PATIENCE_S
from sceneprint.engine.ingest.uploads import Upload
from sceneprint.engine.upkeep.garbage_collection import collect_blobs, collect_doomed_blobs
from sceneprint.errors import StoreAway, StoreLocked, UnusableStore
from sceneprint.settings import Settings
from sceneprint.store import open_store
from sceneprint.store.blobs.folder import LONGEST_S, FolderBlobs
from sceneprint.store.blobs.object_client import open_objects
from sceneprint.store.deletion import doom, remove_map
from sceneprint.store.keys import IdempotentRequest
from sceneprint.store.maps import find_map
from sceneprint.store.postgres.connection import LOCKS
from sceneprint.store.tables import doomed, signatures
from sceneprint_client.api import JobState, NewMap
from tests.whole_engine import Engine

SESSIONS = (
    f"SELECT count(pg_terminate_backend(pid)) FROM pg_locks WHERE granted AND classid = {LOCKS} "
    "AND locktype = 'advisory' "
    "AND database = (SELECT oid FROM pg_database WHERE datname = current_database())"
)


class HeldDeletes(ThreadingTCPServer):
    """A proxy of an object server that holds requests to delete until `release` or `drop`."""

    daemon_threads = True

    def __init__(self, target):
        super().__init__(("127.0.0.1", 0), _Relay)
        self.target, self.port, self.is_dropped = target, self.server_address[1], False
        self.arrived, self.passes = threading.Event(), threading.Event()
        threading.Thread(target=self.serve_forever, args=(0.02,), daemon=True).start()

    def release(self):
        self.passes.set()

    def drop(self):
        """Break the connections of held requests, and of later ones."""
        self.is_dropped = True
        self.passes.set()

    def close(self):
        self.drop()
        self.shutdown()
        self.server_close()


class _Relay(BaseRequestHandler):
    def handle(self):
        with socket.create_connection(("127.0.0.1", self.server.target)) as far:
            back = threading.Thread(target=self._pump, args=(far, self.request), daemon=True)
            back.start()
            self._pump(self.request, far, holds=True)
            back.join()

    def _pump(self, source, to, *, holds=False):
        with suppress(OSError):
            while data := source.recv(1 << 16):
                method, _, rest = data.partition(b"\r\n")[0].partition(b" ")
                if holds and (method == b"DELETE" or (method == b"POST" and b"?delete" in rest)):
                    self.server.arrived.set()
                    self.server.passes.wait()
                    if self.server.is_dropped:
                        break
                to.sendall(data)
        for one in (source, to):
            with suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)


def background(do):
    """Call it in a thread of its own; its future."""
    with_one = ThreadPoolExecutor(1)
    future = with_one.submit(do)
    with_one.shutdown(wait=False)
    return future


@pytest.fixture
def held(object_server):
    proxy = HeldDeletes(object_server.port)
    yield proxy
    proxy.close()


@pytest.fixture
def engine(postgres_url, bucket, tmp_path):
    """A service of the fleet; it has its own way to the object store."""
    settings = {"database_url": postgres_url, "blob_url": bucket, "data_dir": tmp_path}
    with Engine(Settings.model_validate(settings)) as opened:
        opened.create_map(NewMap(name="hall"))
        yield opened


@pytest.fixture
def remover(engine, postgres_url, bucket, held, monkeypatch):
    """The store in another process: its requests to delete are held."""
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{held.port}")
    for name, seconds in (("TRIED_S", 0.1), ("SMALL_S", 90)):
        monkeypatch.setattr(f"sceneprint.store.blobs.object_client.{name}", seconds)
    opened = open_store(postgres_url, bucket)
    yield opened
    held.release()
    opened.close()


@pytest.fixture
def removal(remover, held):
    """Begin to remove blobs, and come back when the request to delete them is held."""
    begun = []

    def begin(*blobs):
        begun.append(background(lambda: collect_blobs(remover, blobs)))
        assert held.arrived.wait(PATIENCE_S)
        return begun[-1]

    yield begin
    held.release()
    wait(begun, PATIENCE_S)


def doomed_in(engine):
    with engine.store.database.read() as connection:
        return list(connection.execute(select(doomed.c.blob).order_by(doomed.c.blob)).scalars())


def end_sessions(engine, which):
    with engine.store.database.read() as connection:
        ended = connection.execute(text(f"{SESSIONS} AND {which}")).scalar_one()
    assert ended == 1


def grow_old(engine):
    """Let the time pass after which no removal of before goes on."""
    with engine.store.database.write() as connection:
        connection.execute(update(doomed).values(at=doomed.c.at - LONGEST_S))


def alone(engine, small):
    return engine.add_frame("hall", *small[0])


def in_a_group(engine, small):
    result, _ = engine.uploads.add_all("hall", [Upload(*shot) for shot in small[:2]])
    return result


def test_an_upload_does_not_wait_for_a_removal(engine, small, held, removal):
    digest = engine.store.blobs.put(b"of another frame")
    removing = removal(digest)
    for add in (alone, in_a_group):
        add(engine, small)
    assert engine.get_map("hall").frames == {"received": 2}
    assert doomed_in(engine) == [digest]
    assert not removing.done()
    held.release()
    removing.result()
    assert not engine.store.blobs.holds(digest)
    assert doomed_in(engine) == []
    assert engine.store.blobs.get(hashlib.sha256(small[0].png).hexdigest()) == small[0].png


@pytest.mark.parametrize(("add", "turn_s"), [(alone, 0.001), (in_a_group, 60.0)])
def test_the_same_content_is_there_after_its_removal(
    engine, small, held, removal, until, waiting, add, turn_s, monkeypatch
):
    """Who has committed its frame has no turn, and waits for longer."""
    monkeypatch.setattr("sceneprint.store.blobs.object_store.TURN_S", turn_s)
    digest = engine.store.blobs.put(small[0].png)
    removing = removal(digest)
    adding = background(lambda: add(engine, small))
    until(lambda: waiting(engine.store) == 1 or adding.done())
    held.release()
    removing.result()
    adding.result()
    assert engine.store.blobs.get(digest) == small[0].png
    work = engine.claim("w")
    assert engine.run(work) == JobState.SUCCEEDED


def test_an_artifact_is_there_after_its_removal(engine, small, held, removal, until, waiting):
    engine.create_map(NewMap(name="yard"))
    for name in ("hall", "yard"):
        engine.add_frame(name, *small[0])
    work = engine.claim("w")
    assert engine.run(work) == JobState.SUCCEEDED
    with engine.store.database.write() as connection:
        artifact = connection.execute(select(signatures.c.geometry)).scalar_one()
        blobs = remove_map(connection, find_map(connection, "hall"))
    data = engine.store.blobs.get(artifact)
    removing = removal(*blobs)
    # the upload is the other map's, too, and stays noted until no earlier removal can take it
    assert doomed_in(engine) == sorted(blobs)
    work = engine.claim("w")
    signing = background(lambda: engine.run(work))
    until(lambda: waiting(engine.store) == 1 or signing.done())
    held.release()
    removing.result()
    assert signing.result() == JobState.SUCCEEDED
    assert engine.store.blobs.get(artifact) == data


def test_a_removal_that_takes_too_long_stores_nothing(engine, small, held, removal, monkeypatch):
    monkeypatch.setattr("sceneprint.store.blobs.object_store.TURN_S", 0.1)
    monkeypatch.setattr("sceneprint.engine.upkeep.garbage_collection._PATIENCE_S", 0.1)
    digest = engine.store.blobs.put(small[0].png)
    removing = removal(digest)
    with pytest.raises(StoreLocked, match="Try again later"):
        in_a_group(engine, small)
    assert engine.get_map("hall").frames == {}
    held.release()
    removing.result()
    in_a_group(engine, small)
    assert engine.store.blobs.get(digest) == small[0].png


def test_an_upload_that_waited_in_vain_has_its_blob_when_it_is_sent_again(
    engine, small, held, removal, monkeypatch
):
    monkeypatch.setattr("sceneprint.engine.upkeep.garbage_collection._PATIENCE_S", 0.1)
    once = IdempotentRequest("robot", "a key", "a" * 64)
    digest = engine.store.blobs.put(small[0].png)
    removing = removal(digest)
    with monkeypatch.context() as patch:
        patch.setattr("sceneprint.store.blobs.object_store.REMOVAL_S", 0.1)
        with pytest.raises(StoreLocked):
            engine.uploads.add("hall", Upload(*small[0]), once)
    held.release()
    removing.result()
    assert not engine.store.blobs.holds(digest)
    outcome, again = engine.uploads.add("hall", Upload(*small[0]), once)
    assert (outcome.new, again) == (True, True)
    assert engine.store.blobs.get(digest) == small[0].png


def test_a_second_upload_waits_for_a_removal_too(
    engine, small, held, removal, until, waiting, monkeypatch
):
    """The first upload may die before it has stored its blob again."""
    monkeypatch.setattr("sceneprint.engine.upkeep.garbage_collection._PATIENCE_S", 0.1)
    digest = engine.store.blobs.put(small[0].png)
    removing = removal(digest)
    with monkeypatch.context() as patch:
        patch.setattr("sceneprint.store.blobs.object_store.REMOVAL_S", 0.1)
        with pytest.raises(StoreLocked):
            alone(engine, small)
    second = background(lambda: alone(engine, small))
    until(lambda: waiting(engine.store) == 1 or second.done())
    held.release()
    removing.result()
    _, is_new = second.result()
    assert not is_new
    assert engine.store.blobs.get(digest) == small[0].png


def test_a_blob_that_is_being_removed_stays_doomed(
    engine, small, held, removal, until, waiting, monkeypatch
):
    monkeypatch.setattr("sceneprint.engine.upkeep.garbage_collection._PATIENCE_S", 0.1)
    digest = engine.store.blobs.put(small[0].png)
    removing = removal(digest)
    adding = background(lambda: alone(engine, small))  # committed, and waits
    until(lambda: waiting(engine.store) == 1 or adding.done())
    collect_blobs(engine.store, [digest])
    assert doomed_in(engine) == [digest]
    held.release()
    removing.result()
    adding.result()
    assert engine.store.blobs.get(digest) == small[0].png


def test_a_server_that_fell_tells_of_the_removal_that_was_under_way(tmp_path, bucket):
    server = Server(tmp_path / "server")
    server.start()
    try:
        server.create("fleet")
        with closing(open_store(server.url("fleet"), bucket)) as store:
            digest = store.blobs.put(b"a frame")
            with store.database.write() as connection:
                doom(connection, [digest])
            for _ in range(17):  # past 33, which is how far `nextval` would be logged ahead
                with store.blobs.locks.removing() as allowed:
                    assert allowed
            assert store.blobs.locks.removals() == 34
            with store.blobs.locks.removing():
                server.kill()
                server.start()
                assert store.blobs.locks.removals() is None
                # the lock went with the server, and the request to remove may still come
                with pytest.raises(StoreLocked):
                    store.blobs.holds(digest)
    finally:
        server.kill()


def test_what_is_removed_one_by_one_ends_in_time(tmp_path):
    objects = open_objects(f"file://{tmp_path}")
    for key in ("a", "c"):
        objects.put(key, b"x")
    with pytest.raises(StoreAway, match="too slow"):
        objects.delete("missing", "a", "c", seconds=-1.0)
    objects.delete("missing", "a", "c", seconds=60.0)
    assert [entry.key for entry in objects.list("")] == []


def test_blobs_stay_doomed_where_the_object_store_is_away(engine, held, removal, monkeypatch):
    digest = engine.store.blobs.put(b"of another frame")
    removing = removal(digest)
    held.drop()
    with pytest.raises(UnusableStore, match="cannot be removed"):
        removing.result()
    assert doomed_in(engine) == [digest]
    assert digest in engine.store.blobs.digests()
    collect_blobs(engine.store, [digest])  # what was asked for may still come
    assert digest in engine.store.blobs.digests()
    monkeypatch.setattr("sceneprint.store.postgres.session_locks.LONGEST_S", 0.0)
    assert collect_doomed_blobs(engine.store) == 1
    assert not engine.store.blobs.holds(digest)
    assert doomed_in(engine) == []


def test_another_removal_does_not_hide_that_of_who_was_cut_off(engine, small, held, removal):
    """What it had asked for is carried out later, and not after an upload that is acknowledged."""
    digest, other = (engine.store.blobs.put(data) for data in (small[0].png, b"of another frame"))
    removing = removal(digest)
    end_sessions(engine, "objid = 2 AND mode = 'ExclusiveLock'")
    for _ in range(2):
        with pytest.raises(StoreLocked, match="lost its connection, and may still remove the blob"):
            alone(engine, small)
        collect_blobs(engine.store, [other])
    assert doomed_in(engine) == sorted([digest, other])
    held.release()
    removing.result()
    grow_old(engine)
    alone(engine, small)
    assert engine.store.blobs.get(digest) == small[0].png


def test_a_request_without_an_answer_may_be_carried_out_later(
    engine, small, held, postgres_url, bucket, monkeypatch, until
):
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{held.port}")
    monkeypatch.setattr("sceneprint.store.blobs.object_client.SMALL_S", 1)
    digest = engine.store.blobs.put(small[0].png)
    with closing(open_store(postgres_url, bucket)) as remover:
        with pytest.raises(UnusableStore, match="cannot be removed"):
            collect_blobs(remover, [digest])
        with pytest.raises(StoreLocked, match="may still remove the blob"):
            alone(engine, small)
        held.release()
        until(lambda: digest not in engine.store.blobs.digests())
    grow_old(engine)
    alone(engine, small)
    assert engine.store.blobs.get(digest) == small[0].png


def test_an_upload_waits_for_a_removal_of_files(small, postgres_url, tmp_path, until, monkeypatch):
    """The removal continues after its transaction, and its disk may stall."""
    settings = Settings.model_validate({"database_url": postgres_url, "data_dir": tmp_path})
    settings.blobs.mkdir()
    arrived, passes = threading.Event(), threading.Event()
    remove = FolderBlobs.remove

    def stall(self, *digests):
        arrived.set()
        passes.wait(PATIENCE_S)
        remove(self, *digests)

    with Engine(settings) as engine, closing(open_store(postgres_url, settings.blobs)) as remover:
        engine.create_map(NewMap(name="hall"))
        digest = engine.store.blobs.put(small[0].png)
        monkeypatch.setattr(FolderBlobs, "remove", stall)
        removing = background(lambda: collect_blobs(remover, [digest]))
        assert arrived.wait(PATIENCE_S)
        adding = background(lambda: alone(engine, small))
        until(lambda: adding.done() or engine.get_map("hall").frames == {"received": 1})
        assert not adding.done()
        passes.set()
        removing.result()
        adding.result()
        assert engine.store.blobs.get(digest) == small[0].png


def test_what_is_doomed_again_meanwhile_is_not_settled(engine, held, removal):
    """An upload may have stored the blob again, and died after its frame was deleted."""
    first, second = (engine.store.blobs.put(data) for data in (b"of another frame", b"of a third"))
    removing = removal(first, second)
    with engine.store.database.write() as connection:
        doom(connection, [first])
    held.release()
    removing.result()
    assert doomed_in(engine) == [first]


def test_one_removal_waits_for_another(engine, held, removal, until, waiting, monkeypatch):
    blobs = [engine.store.blobs.put(data) for data in (b"a", b"b", b"c")]
    removing = removal(blobs[0])
    with monkeypatch.context() as patch:
        patch.setattr("sceneprint.engine.upkeep.garbage_collection._PATIENCE_S", 0.1)
        collect_blobs(engine.store, [blobs[1]])  # not for long
    assert doomed_in(engine) == sorted(blobs[:2])
    also = background(lambda: collect_blobs(engine.store, [blobs[2]]))
    until(lambda: waiting(engine.store) == 1 or also.done())
    held.release()
    removing.result()
    also.result()
    assert doomed_in(engine) == [blobs[1]]
    assert list(engine.store.blobs.digests()) == [blobs[1]]
