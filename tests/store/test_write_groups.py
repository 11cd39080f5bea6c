"""Tests of writers that are committed together, and fail separately."""

import time
from concurrent.futures import ThreadPoolExecutor

import pytest
from sqlalchemy import event, func, select

from benchmarks.waiting import PATIENCE_S
from sceneprint.engine.ingest.write_groups import MOST_TOGETHER, Grouping
from sceneprint.errors import FrameConflict, LostLease, StoreFull
from sceneprint.process import of_request, request_id
from sceneprint.store.events import record_event
from sceneprint.store.tables import events


@pytest.fixture
def database(store):
    return store.database


def together(database, works, *, one_by_one=False):
    """What came of works that all waited for one writer, and how often was committed.

    With `one_by_one`, they come in their order, and the first of them writes for all.
    """
    group, commits = Grouping(database), [0]
    event.listen(database._engine, "commit", lambda _: commits.__setitem__(0, commits[0] + 1))
    with ThreadPoolExecutor(len(works)) as pool:
        with database.write():  # until this is over nobody else writes
            begun = []
            for work in works:
                begun.append(pool.submit(group.run, work))
                if one_by_one:
                    until_waiting(group, len(begun))
            until_waiting(group, len(works))
        outcomes = [future.exception() or future.result() for future in begun]
    return outcomes, commits[0] - 1


def until_waiting(group, count):
    end = time.monotonic() + PATIENCE_S
    while len(group._waiting) < count:
        assert time.monotonic() < end
        time.sleep(0.001)


def count(database, kind):
    with database.read() as connection:
        query = select(func.count()).where(events.c.kind == kind)
        return int(connection.execute(query).scalar_one())


def noting(kind, result):
    def work(connection):
        record_event(connection, kind, None, None)
        return result

    return work


def test_who_waits_together_is_committed_together(database):
    outcomes, commits = together(database, [noting("a", i) for i in range(MOST_TOGETHER + 3)])
    assert outcomes == list(range(MOST_TOGETHER + 3))
    assert count(database, "a") == MOST_TOGETHER + 3
    assert commits == 2  # at most MOST in one


def test_each_is_of_its_own_request_whoever_writes_it(database):
    group, seen = Grouping(database), dict[int, str | None]()

    def run(i):
        with of_request(f"request {i}"):
            seen[i] = group.run(lambda _: request_id())

    with ThreadPoolExecutor(4) as pool, database.write():
        begun = [pool.submit(run, i) for i in range(4)]
        until_waiting(group, len(begun))
    assert seen == {i: f"request {i}" for i in range(4)}


@pytest.mark.parametrize("kind", [FrameConflict, LostLease])
def test_a_refusal_costs_no_other(database, kind):
    def refuse(_):
        raise kind("no")

    outcomes, commits = together(database, [noting("a", 0), refuse, noting("a", 2)])
    assert (outcomes[0], outcomes[2], str(outcomes[1])) == (0, 2, "no")
    assert (count(database, "a"), commits) == (2, 1)


def test_what_breaks_a_transaction_leaves_no_trace_and_the_others_their_own(database):
    def break_down(connection):
        record_event(connection, "broken", None, None)
        raise ValueError("a mistake")

    outcomes, _ = together(database, [noting("a", 0), break_down, noting("a", 2)])
    assert (outcomes[0], outcomes[2]) == (0, 2)
    assert isinstance(outcomes[1], ValueError)
    assert (count(database, "a"), count(database, "broken")) == (2, 0)


def test_a_full_disk_is_told_to_all(database):
    def full(connection):
        record_event(connection, "full", None, None)
        raise StoreFull("no room")

    outcomes, _ = together(database, [noting("a", 0), full])
    assert [type(outcome) for outcome in outcomes] == [StoreFull, StoreFull]
    assert (count(database, "a"), count(database, "full")) == (0, 0)


def test_ctrl_c_in_a_second_try_forgets_nobody(database):
    """It ends the thread that writes for all: those that it has not written go on themselves."""
    errors = [ValueError, KeyboardInterrupt]

    def stop(_):
        if errors:
            raise errors.pop(0)

    outcomes, _ = together(
        database, [noting("a", 0), noting("a", 1), stop, noting("a", 3)], one_by_one=True
    )
    assert [type(outcomes[0]), *outcomes[1:]] == [KeyboardInterrupt, 1, None, 3]
    assert (errors, count(database, "a")) == ([], 3)
