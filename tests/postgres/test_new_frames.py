"""Tests of new frames of several maps in one statement, from many threads."""

from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager, suppress

import pytest
from sqlalchemy import select, text, update
from sqlalchemy.exc import IntegrityError

from sceneprint.engine.ingest import write_groups
from sceneprint.engine.ingest.write_groups import NewFrames
from sceneprint.errors import StoreLocked
from sceneprint.store import open_database
from sceneprint.store.keys import IdempotentRequest
from sceneprint.store.maps import add_map
from sceneprint.store.new_frames import NewFrame, receive_frames
from sceneprint.store.postgres.connection import MapsInUse, take_turn
from sceneprint.store.tables import frames, idempotency, jobs, maps, pending_events
from tests.store.frame_rows import frame_values


def new(row, content, **fields):
    own = {name: fields.pop(name) for name in ("priority", "result") if name in fields}
    return NewFrame(row, frame_values(f"{content:064x}", **fields), **own)


def receive(database, *args, wait_s=10.0):
    with database.write_maps({argument.row.number for argument in args}, wait_s) as connection:
        ids = receive_frames(connection, args)
    return [argument.frame_id in ids for argument in args]


def counted(database):
    with database.read() as connection:
        query = select(maps.c.name, maps.c.used_frames, maps.c.used_bytes).order_by(maps.c.name)
        return [tuple(row) for row in connection.execute(query)]


def content_of(database):
    with database.read() as connection:
        query = (
            select(frames.c.map_number, frames.c.content_id, jobs.c.id)
            .join(jobs, jobs.c.frame_number == frames.c.number)
            .order_by(frames.c.number)
        )
        return [tuple(row) for row in connection.execute(query)]


def test_frames_of_several_maps_are_taken_in_their_order(server_store, rows):
    database, (a, b, c) = server_store.database, rows
    incoming = [new(c, 5), new(a, 9), new(b, 9, bytes=77), new(a, 1), new(c, 4)]
    assert receive(database, *incoming) == [True] * 5
    assert content_of(database) == [
        (frame.row.number, frame.values["content_id"], frame.job_id) for frame in incoming
    ]
    assert counted(database) == [("a", 2, 6), ("b", 1, 77), ("c", 2, 6)]
    with database.read() as connection:
        pending = connection.execute(select(pending_events).order_by(pending_events.c.number))
        assert [(event.map, event.frame_id, event.job_id) for event in pending] == [
            (frame.row.name, frame.frame_id, frame.job_id) for frame in incoming
        ]


def test_a_cloud_has_no_intrinsics(server_store, rows):
    """They are null as JSON has it: the column takes no other."""
    incoming = [new(rows[0], 1), new(rows[0], 2, intrinsics=None)]
    assert receive(server_store.database, *incoming) == [True, True]
    with server_store.database.read() as connection:
        query = text("SELECT CAST(intrinsics AS text), pose IS NULL FROM frames ORDER BY number")
        assert [tuple(row) for row in connection.execute(query)] == [
            ('{"width": 1}', True), ("null", True),
        ]  # fmt: skip


def test_what_is_there_or_comes_twice_is_taken_once(server_store, rows):
    database, (a, b, _) = server_store.database, rows
    assert receive(database, new(a, 1)) == [True]
    incoming = [new(a, 2), new(a, 1), new(b, 1), new(a, 2), new(a, 3)]
    assert receive(database, *incoming) == [True, False, True, False, True]
    assert counted(database)[:2] == [("a", 3, 9), ("b", 1, 3)]
    assert receive(database, *incoming) == [False] * 5


@pytest.mark.parametrize(
    ("change", "taken"),
    [
        ({"quota_frames": 2}, True), ({"quota_frames": 1}, False), ({"quota_bytes": 6}, True),
        ({"quota_bytes": 5}, False), ({"name": "renamed"}, False),
    ],
)  # fmt: skip
def test_a_map_without_room_for_all_takes_none_and_others_take_theirs(
    server_store, rows, change, taken
):
    database, (a, b, _) = server_store.database, rows
    with database.write() as connection:
        connection.execute(update(maps).where(maps.c.number == a.number).values(**change))
    assert receive(database, new(a, 1), new(b, 1), new(a, 2)) == [taken, True, taken]
    assert {row[0]: row[1] for row in counted(database)} == {
        change.get("name", "a"): 2 * taken, "b": 1, "c": 0,
    }  # fmt: skip


def test_what_was_done_under_its_key_is_not_done_again(server_store, rows):
    database, (a, b, _) = server_store.database, rows
    requests = [IdempotentRequest("robot", key, "0" * 64) for key in ("old", "new")]

    def kept(request):
        return request.columns({"frames": request.key})

    assert receive(database, new(a, 1, result=kept(requests[0]))) == [True]
    incoming = [new(b, 2, result=kept(request)) for request in requests[:1]]
    incoming += [new(b, 3), new(a, 3, result=kept(requests[1]))]
    assert receive(database, *incoming) == [False, True, True]
    with database.read() as connection:
        assert requests[1].stored_result(connection) == {"frames": "new"}
        assert len(connection.execute(select(idempotency.c.key)).all()) == 2
    both = IdempotentRequest("robot", "both", "0" * 64)
    with pytest.raises(IntegrityError, match="pk_idempotency"):
        receive(database, new(a, 8, result=kept(both)), new(b, 8, result=kept(both)))
    assert counted(database) == [("a", 2, 6), ("b", 1, 3), ("c", 0, 0)]


@contextmanager
def in_use(database, row):
    """The map's turn, of another process."""
    with database._writers.begin() as other:
        take_turn(other, 10.0, None, row.number)
        yield other


def test_a_map_that_is_in_use_is_waited_for_shortly(server_store, rows):
    database, (a, b, _) = server_store.database, rows
    with in_use(database, b):
        with pytest.raises(MapsInUse):
            receive(database, new(a, 1), new(b, 1), wait_s=0.05)
        assert receive(database, new(a, 1), wait_s=0.05) == [True]
    assert not database._held  # others need not hurry
    assert receive(database, new(b, 1), wait_s=0.05) == [True]


def test_maps_are_locked_in_one_order(server_store, rows, until, waiting):
    """Who waits for a map has none that comes after it: nobody waits for one who waits for him."""
    database = server_store.database
    with database.write() as connection:
        rows += [add_map(connection, f"map-{i}", None, rows[0].model_id) for i in range(5)]
    first, last = rows[0], rows[7]  # a set of their numbers has the greater one first
    assert list({last.number, first.number}) == [8, 1]
    others = text("SELECT count(*) FROM pg_locks WHERE locktype = 'advisory' AND objid = 8")
    with ThreadPoolExecutor(1) as pool, in_use(database, first) as other:
        writer = pool.submit(receive, database, new(last, 1), new(first, 1))
        until(lambda: waiting(server_store) == 1)
        assert other.execute(others).scalar_one() == 0
    writer.result()
    assert {name: n for name, n, _ in counted(database) if n} == {"a": 1, last.name: 1}


def together(group, incoming, until):
    """What came of frames that all waited for one statement."""
    group._led = True  # somebody writes
    with ThreadPoolExecutor(len(incoming)) as pool:
        begun = [pool.submit(group.receive, frame) for frame in incoming]
        until(lambda: len(group._waiting) == len(incoming))
        leader = group._waiting[0]
        leader.leads = True
        leader.ready.set()
        outcomes = [future.exception() or future.result() for future in begun]
    assert (group._waiting, group._led) == ([], False)
    return outcomes


def test_frames_of_many_threads_are_taken_once(server_store, rows, until, monkeypatch):
    database = server_store.database
    monkeypatch.setattr(write_groups, "MOST_TOGETHER", 5)  # two transactions
    incoming = [new(rows[i % 3], i // 2) for i in range(8)] + [new(rows[0], 0)]
    outcomes = together(NewFrames(database), incoming, until)
    assert sum(outcomes) == sum(row[1] for row in counted(database)) == 8
    with database.read() as connection:
        assert set(connection.execute(select(frames.c.id)).scalars()) == {
            one.frame_id for one, taken in zip(incoming, outcomes, strict=True) if taken
        }


def test_one_that_cannot_be_written_sends_all_on_alone(server_store, rows, until):
    incoming = [new(rows[0], 1), new(rows[1], 2, sequence=2**80), new(rows[2], 3)]
    assert together(NewFrames(server_store.database), incoming, until) == [False] * 3
    assert [row[1] for row in counted(server_store.database)] == [0, 0, 0]


def test_a_map_in_use_sends_all_on_alone(server_store, rows, until, monkeypatch):
    monkeypatch.setattr(write_groups, "MAPS_WAIT_S", 0.05)
    incoming = [new(rows[0], 1), new(rows[1], 2)]
    with in_use(server_store.database, rows[1]):
        outcomes = together(NewFrames(server_store.database), incoming, until)
    assert outcomes == [False, False]


def test_a_store_that_cannot_be_used_is_told_to_all(server_store, rows, until, monkeypatch):
    monkeypatch.setattr("sceneprint.store.database.BUSY_S", 0.1)
    incoming = [new(rows[0], 1), new(rows[1], 2)]
    with server_store.database._writers.begin() as other:
        take_turn(other, 10.0)
        outcomes = together(NewFrames(server_store.database), incoming, until)
    assert [type(outcome) for outcome in outcomes] == [StoreLocked, StoreLocked]


def test_a_statement_that_was_prepared_in_vain_is_prepared_again(server_store, rows):
    """The driver takes a statement for prepared that an error before it kept from being so."""
    database, (a, b, _) = server_store.database, rows
    for content in range(5):  # it prepares what comes for the sixth time
        assert receive(database, new(a, content)) == [True]
    # another process: of one pool, the connection would be another
    url = database._engine.url.render_as_string(hide_password=False)
    with closing(open_database(url)) as other, in_use(other, b), pytest.raises(MapsInUse):
        receive(database, new(a, 90), new(b, 91), wait_s=0.05)
    with suppress(StoreLocked):
        receive(database, new(a, 100))
    assert [receive(database, new(a, content)) for content in range(101, 104)] == [[True]] * 3
