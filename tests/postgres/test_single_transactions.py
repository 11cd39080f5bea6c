"""Tests of transactions of one statement: one round trip, in order, and atomic."""

from __future__ import annotations

import socket
import threading
from contextlib import contextmanager, suppress

import pytest
from sqlalchemy import event, func, insert, literal_column, select, text, update

from benchmarks.waiting import PATIENCE_S
from sceneprint.engine.ingest.uploads import Upload
from sceneprint.engine.ingest.write_groups import NewFrames
from sceneprint.engine.jobs import signature_job
from sceneprint.engine.upkeep.garbage_collection import collect_blobs
from sceneprint.errors import IdempotencyConflict, LostLease, NewerSchema, StoreLocked
from sceneprint.settings import Settings
from sceneprint.store import open_database, queue
from sceneprint.store.keys import IdempotentRequest
from sceneprint.store.maps import add_map, find_map, frame_of, store_model
from sceneprint.store.new_frames import NewFrame, receive_frames
from sceneprint.store.postgres import connection as postgres
from sceneprint.store.signatures import StoredSignature, index_claimed_frame
from sceneprint.store.tables import frames, idempotency, jobs, maps, pending_events, signatures
from sceneprint_client.api import JobState, NewMap
from tests.whole_engine import Engine

MODEL = "ab" * 32
#: What is known of a frame beside its content.
KNOWN = {
    "blob": "00" * 32, "bytes": 3, "intrinsics": {"width": 1}, "depth_scale": 1000.0,
    "depth_along_ray": False, "robot": None, "session": None, "captured_at": None, "tags": ["a"],
    "pose_parent": None, "pose": None, "name": None, "sequence": None,
}  # fmt: skip
LOCKS_HELD = text(
    "SELECT count(*) FROM pg_locks WHERE locktype = 'advisory' AND granted "
    "AND database = (SELECT oid FROM pg_database WHERE datname = current_database())"
)
WAITING = text(str(LOCKS_HELD).replace("AND granted", "AND NOT granted"))


class TripCounter:
    """A server's port that counts round trips: how often one asks after the other has answered."""

    def __init__(self, port):
        self._to, self._asks, self.trips = port, False, 0
        self._lock = threading.Lock()
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listener.getsockname()[1]
        self._open: list[socket.socket] = []
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self):
        with suppress(OSError):
            while True:
                near, _ = self._listener.accept()
                far = socket.create_connection(("127.0.0.1", self._to))
                self._open += [near, far]
                for pair in ((near, far, True), (far, near, False)):
                    threading.Thread(target=self._pump, args=pair, daemon=True).start()

    def _pump(self, source, to, asks):
        with suppress(OSError):
            while data := source.recv(1 << 16):
                with self._lock:
                    self.trips += asks and not self._asks
                    self._asks = asks
                to.sendall(data)
            to.shutdown(socket.SHUT_WR)

    def close(self):
        for one in (self._listener, *self._open):
            one.close()


@pytest.fixture
def row(server_store):
    with server_store.database.write() as connection:
        store_model(connection, MODEL, "toy", b"a model")
        return add_map(connection, "hall", None, MODEL)


@pytest.fixture
def counted(server_store, row):
    """The same database by way of one who counts."""
    url = server_store.database._engine.url
    assert url.port is not None
    counter = TripCounter(url.port)
    database = open_database(url.set(port=counter.port).render_as_string(hide_password=False))
    yield database, counter
    database.close()
    counter.close()


def upload(database, row, number):
    with database.write(map_number=row.number, single=True) as connection:
        values = {**KNOWN, "content_id": f"{number:064x}"}
        assert receive_frames(connection, [NewFrame(row, values)])


def claimed(database):
    with database.write(turn=False) as connection:
        job = queue.claim(connection, "worker", 60.0)
        return job, frame_of(connection, job.frame)


def sign(database, job, frame):
    made = StoredSignature(MODEL, bytes(400), "00" * 32, [1], [1])
    with database.write(map_number=frame.map_number, single=True) as connection:
        assert index_claimed_frame(connection, job, frame, "hall", made)


def edit(database, row, note, *, single=True):
    with database.write(map_number=row.number, single=single) as connection:
        connection.execute(update(maps).where(maps.c.number == row.number).values(name=note))


def named(store):
    with store.database.read() as connection:
        return str(connection.execute(select(maps.c.name)).scalar_one())


def locks(store, which=LOCKS_HELD):
    with store.database.read() as connection:
        return int(connection.execute(which).scalar_one())


@contextmanager
def held(store, row):
    """The map's turn, of another process; None: that of all maps."""
    with store.database._writers.begin() as other:
        postgres.take_turn(other, 10.0, None, None if row is None else row.number)
        yield other


def test_an_upload_and_a_signature_take_one_round_trip_each(counted, row):
    database, counter = counted
    for number in range(8):  # what is asked often is prepared, which has its own messages
        upload(database, row, number)
        sign(database, *claimed(database))
    begun = counter.trips
    upload(database, row, 90)
    assert counter.trips - begun == 1
    work = claimed(database)
    begun = counter.trips
    sign(database, *work)
    assert counter.trips - begun == 1
    begun = counter.trips
    edit(database, row, "later", single=False)
    assert counter.trips - begun == 3  # the turn takes its own
    with database.read() as connection:
        counts = select(frames.c.state, func.count()).group_by(frames.c.state)
        assert [tuple(one) for one in connection.execute(counts)] == [("indexed", 9)]


def test_it_is_committed_with_its_answer_and_keeps_no_turn(server_store, row):
    database = server_store.database
    asked = text(str(LOCKS_HELD).replace("count(*)", "mode") + " AND pid = pg_backend_pid()")
    with database.write(map_number=row.number, single=True) as connection:
        found = connection.execute(asked).scalars().all()  # it had its turn, and its map alone
        assert sorted(found) == ["ExclusiveLock", "ShareLock"]
        assert locks(server_store) == 0
    with database.write(map_number=row.number, single=True) as connection:
        connection.execute(update(maps).values(name="at once"))
        assert named(server_store) == "at once"


def test_nothing_cuts_its_commit_off(server_store, row):
    """A commit may wait for a standby for longer than any statement may take."""
    asked = text("SELECT current_setting('statement_timeout'), current_setting('lock_timeout')")
    with server_store.database.write(map_number=row.number, single=True) as connection:
        assert tuple(connection.execute(asked).one()) == ("0", "10s")
    with server_store.database.read() as connection:  # and it is of that transaction alone
        assert connection.exec_driver_sql("SHOW statement_timeout").scalar_one() == "1min"


def test_it_sees_what_was_committed_while_its_turn_was_waited_for(server_store, row, until):
    found = list[str]()

    def late():
        with server_store.database.write(map_number=row.number, single=True) as connection:
            found.append(connection.execute(select(maps.c.name)).scalar_one())

    writer = threading.Thread(target=late)
    with held(server_store, row) as other:
        writer.start()
        until(lambda: locks(server_store, WAITING) == 1)
        other.execute(update(maps).values(name="renamed"))
    writer.join(PATIENCE_S)
    assert found == ["renamed"]


def test_who_waited_for_a_migration_writes_nothing(server_store, row, until):
    raised = list[Exception]()

    def late():
        try:
            edit(server_store.database, row, "late")
        except NewerSchema as error:
            raised.append(error)

    writer = threading.Thread(target=late)
    with held(server_store, None) as other:
        writer.start()
        until(lambda: locks(server_store, WAITING) == 1)
        other.exec_driver_sql("UPDATE alembic_version SET version_num = '9999'")
        other.exec_driver_sql("UPDATE schema_range SET least_revision = '9999'")
        other.exec_driver_sql("ALTER TABLE maps RENAME COLUMN name TO gone")  # it would fail, too
    writer.join(PATIENCE_S)
    assert [str(one).partition("schema ")[2][:4] for one in raised] == ["9999"]


def test_a_schema_that_went_on_and_may_be_written_to_is_noted(server_store, row):
    database = server_store.database
    edit(database, row, "before")
    with database.write() as connection:
        connection.exec_driver_sql("UPDATE alembic_version SET version_num = '9999'")
    for name in ("after", "later"):
        edit(database, row, name)
        assert named(server_store) == name
    with database.write() as connection:
        connection.exec_driver_sql("UPDATE schema_range SET least_revision = '9998'")
    with pytest.raises(NewerSchema, match="Nothing was stored"):
        edit(database, row, "too late")
    assert named(server_store) == "later"


def test_a_turn_that_does_not_come_in_time_is_said(server_store, row, monkeypatch):
    monkeypatch.setattr("sceneprint.store.database.BUSY_S", 0.1)
    with held(server_store, row), pytest.raises(StoreLocked):
        edit(server_store.database, row, "late")
    assert named(server_store) == "hall"
    assert server_store.database._held  # who comes after that waits for less
    edit(server_store.database, row, "later")
    assert named(server_store) == "later"
    assert not server_store.database._held


def test_a_warning_of_before_is_not_one_of_its_commit(server_store, row):
    """One of its commit says that it is not on the standby."""
    with server_store.database.read() as connection:
        warned = connection.execute(text("SELECT pg_cancel_backend(2147483647)")).scalar()
    assert warned is False
    edit(server_store.database, row, "after")
    assert named(server_store) == "after"


def test_what_fails_leaves_nothing(server_store, row):
    database = server_store.database
    with (
        pytest.raises(Exception, match="division by zero"),
        database.write(map_number=row.number, single=True) as connection,
    ):
        connection.execute(update(maps).values(name="half", revision=literal_column("1 / 0")))
    assert named(server_store) == "hall"
    assert locks(server_store) == 0
    with database.write(map_number=row.number, single=True):
        pass  # nothing was asked: nothing has begun
    edit(database, row, "after")
    assert named(server_store) == "after"


def test_it_has_one_statement(server_store, row):
    rows = [{"at": 0.0, "kind": "late", "map": "hall", "data": {}}] * 2
    database, many = server_store.database, insert(pending_events)
    with (
        pytest.raises(ValueError, match="one set of parameters"),
        database.write(map_number=row.number, single=True) as connection,
    ):
        connection.execute(many, rows)
    with database.write(map_number=row.number, single=True) as connection:
        connection.execute(many, rows[0])
        with pytest.raises(ValueError, match="second"):
            connection.execute(many, rows[0])
    with database.read() as connection:
        assert connection.execute(select(func.count()).select_from(pending_events)).scalar() == 1


def test_a_connection_that_was_ended_a_moment_ago_is_not_used(server_store, row):
    database = server_store.database
    with database.read() as connection:
        mine = connection.exec_driver_sql("SELECT pg_backend_pid()").scalar_one()
    other = open_database(database._engine.url.render_as_string(hide_password=False))
    with other.read() as connection:
        connection.execute(text("SELECT pg_terminate_backend(:pid, 60000)"), {"pid": mine})
    other.close()
    edit(database, row, "after")
    assert named(server_store) == "after"


@pytest.fixture
def engine(postgres_url, tmp_path):
    (tmp_path / "blobs").mkdir()
    given = {"database_url": postgres_url, "data_dir": tmp_path}
    with Engine(Settings.model_validate(given)) as opened:
        opened.create_map(NewMap(name="hall"))
        yield opened


def removed_before(engine, monkeypatch, then):
    """Have a deletion remove an upload just before its commit, and something done after that."""
    once = NewFrames.receive

    def run(group, frame):
        monkeypatch.undo()
        collect_blobs(engine.store, list(engine.store.blobs.digests()))
        found = once(group, frame)
        assert list(engine.store.blobs.digests()) == []
        then()
        return found

    monkeypatch.setattr(NewFrames, "receive", run)


def test_an_upload_that_a_deletion_removed_before_its_commit_is_put_again(
    engine, small, monkeypatch
):
    removed_before(engine, monkeypatch, lambda: None)
    added, new = engine.add_frame("hall", *small[0])
    assert new
    work = engine.claim("w")
    assert work.job.id == added.job_id
    assert engine.run(work) == JobState.SUCCEEDED
    assert engine.get_map("hall").frames == {"indexed": 1}


def test_a_worker_that_missed_an_upload_tries_again(engine, small, monkeypatch):
    """It had come between the commit and the upload's being put again."""
    missed = list[str]()

    def work_in_between():
        work = engine.claim("w")
        assert engine.run(work) == JobState.QUEUED
        missed.append(work.job.id)

    removed_before(engine, monkeypatch, work_in_between)
    added, new = engine.add_frame("hall", *small[0])
    assert (new, missed) == (True, [added.job_id])
    with engine.store.database.write() as connection:
        connection.execute(update(jobs).values(run_after=0.0))
    work = engine.claim("w")
    assert work is not None
    assert engine.run(work) == JobState.SUCCEEDED
    assert engine.get_map("hall").frames == {"indexed": 1}


def test_an_upload_to_a_map_in_use_waits_for_it_and_others_go_on(engine, small, until, monkeypatch):
    """Those for the same map wait behind it, and nobody with them."""
    engine.create_map(NewMap(name="other"))
    tried, receive = list[str](), NewFrames.receive

    def noted(group, frame):
        tried.append(frame.row.name)
        return receive(group, frame)

    monkeypatch.setattr(NewFrames, "receive", noted)
    with engine.store.database.read() as connection:
        row = find_map(connection, "hall")
    done = list[bool]()

    def late(number):
        done.append(engine.add_frame("hall", *small[number])[1])

    first, second = (threading.Thread(target=late, args=(i,)) for i in (0, 1))
    with held(engine.store, row):
        first.start()
        until(lambda: row.number in engine.uploads._writes)  # it was not waited for any longer
        second.start()
        until(lambda: len(engine.uploads._writes[row.number]._waiting) == 2)
        assert engine.add_frame("other", *small[2])[1]
        assert done == []
    first.join(PATIENCE_S)
    second.join(PATIENCE_S)
    assert (done, tried) == ([True, True], ["hall", "other"])
    assert engine.get_map("hall").frames == {"received": 2}


def test_a_frame_has_the_id_that_it_is_put_under(engine, small):
    mine, other, no = (
        Upload(*small[i], frame_id=frame_id) for i, frame_id in enumerate(("mine", "other", None))
    )
    assert engine.uploads.add("hall", mine)[0].accepted.frame_id == "mine"
    outcomes, _ = engine.uploads.add_all("hall", [other, no])
    own, given = (one.accepted.frame_id for one in outcomes)
    assert (own, len(given)) == ("other", 32)
    assert engine.get_map("hall").frames == {"received": 3}


def test_an_artifact_that_a_deletion_removed_before_its_commit_is_put_again(
    engine, small, monkeypatch
):
    engine.add_frame("hall", *small[0])
    work = engine.claim("w")
    assert work is not None
    (upload,) = engine.store.blobs.digests()
    index = signature_job.index_claimed_frame

    def late(*given, **how):
        monkeypatch.undo()
        collect_blobs(engine.store, [one for one in engine.store.blobs.digests() if one != upload])
        assert list(engine.store.blobs.digests()) == [upload]
        return index(*given, **how)

    monkeypatch.setattr(signature_job, "index_claimed_frame", late)
    assert engine.run(work) == JobState.SUCCEEDED
    with engine.store.database.read() as connection:
        artifact = connection.execute(select(signatures.c.geometry)).scalar_one()
    assert engine.store.geometries.read(artifact).patches


def once_of(what):
    return IdempotentRequest("robot", "a key", what * 64)


def add(engine, frame, once, map_name="hall"):
    return engine.uploads.add(map_name, Upload(*frame), once)


def test_what_a_request_came_to_is_remembered_with_its_frame(engine, small):
    said = list[str]()
    event.listen(
        engine.store.database._engine, "before_cursor_execute",
        lambda connection, _cursor, statement, *_: said.append(statement)
        if {"sceneprint_write", "sceneprint_single"} & connection.get_execution_options().keys()
        else None,
    )  # fmt: skip
    first, replayed = add(engine, small[0], once_of("a"))
    assert (first.new, replayed, len(said)) == (True, False, 1)
    again, replayed = add(engine, small[0], once_of("a"))
    assert replayed
    assert (again.new, again.added) == (True, first.added)
    with pytest.raises(IdempotencyConflict):
        add(engine, small[1], once_of("b"))
    with engine.store.database.write() as connection:  # a day later it is forgotten
        connection.execute(update(idempotency).values(created_at=0.0))
    other, replayed = add(engine, small[1], once_of("b"))
    assert (other.new, replayed) == (True, False)
    assert add(engine, small[1], once_of("b"))[1]
    assert engine.get_map("hall").frames == {"received": 2}


def test_a_request_whose_key_is_used_meanwhile_takes_nothing(engine, small, monkeypatch):
    """By another request, for another map, whose turn is another."""
    engine.create_map(NewMap(name="other"))
    run = NewFrames.receive

    def overtaken(group, frame):
        monkeypatch.undo()
        add(engine, small[1], once_of("b"), "other")
        return run(group, frame)

    monkeypatch.setattr(NewFrames, "receive", overtaken)
    with pytest.raises(IdempotencyConflict):
        add(engine, small[0], once_of("a"))
    assert (engine.get_map("hall").frames, engine.get_map("other").frames) == ({}, {"received": 1})
    with engine.store.database.read() as connection:
        assert connection.execute(select(func.sum(maps.c.used_frames))).scalar() == 1
    assert len(list(engine.store.blobs.digests())) == 1


def test_what_has_a_fence_is_taken_behind_it(engine, small):
    def lost(_):
        raise LostLease("another worker has it")

    with pytest.raises(LostLease):
        engine.uploads.add_all("hall", [Upload(*small[0])], fence=lost)
    assert engine.get_map("hall").frames == {}
    assert list(engine.store.blobs.digests()) == []
