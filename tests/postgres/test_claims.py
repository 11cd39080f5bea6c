"""Tests of claims of jobs without a lock, in competition with other changes."""

import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager

import pytest
from sqlalchemy import text, update

from benchmarks.waiting import PATIENCE_S
from sceneprint.errors import LostLease
from sceneprint.store import queue
from sceneprint.store.maps import add_map, store_model
from sceneprint.store.tables import jobs
from sceneprint_client.api import JobState
from tests.store.conftest import Hand

BLOCKED = text(
    "SELECT count(*) FROM pg_stat_activity WHERE datname = current_database() "
    "AND wait_event_type = 'Lock'"
)


@pytest.fixture
def store(server_store):
    """With three jobs of no frame that wait."""
    with server_store.database.write() as connection:
        store_model(connection, "ab" * 32, "toy", b"the file of a model")
        row = add_map(connection, "hall", None, "ab" * 32)
        for _ in range(3):
            queue.enqueue(connection, "import", None, map_number=row.number)
    return server_store


@pytest.fixture
def hand(store):
    return Hand(store)


def turned(store, job, **values):
    with store.database.write() as connection:
        connection.execute(update(jobs).where(jobs.c.number == job.number).values(**values))


@contextmanager
def uncommitted(store):
    """A transaction without a turn, and what commits it."""
    with ExitStack() as held:
        connection = held.enter_context(store.database.write(turn=False))
        yield connection, held.pop_all().close


def beside(store, until, what):
    """Begin something that has to wait for a lock; its future."""
    pool = ThreadPoolExecutor(1)
    begun = pool.submit(what)
    pool.shutdown(wait=False)

    def waits():
        assert not begun.done(), begun.result()
        with store.database.read() as connection:
            return bool(connection.execute(BLOCKED).scalar_one() == 1)

    until(waits)
    return begun


def test_a_claim_waits_for_no_turn_and_passes_over_what_another_has_in_hand(store, hand):
    with store.database.write(), uncommitted(store) as (connection, commit):
        first = queue.claim(connection, "a", 60.0)
        second, third = hand.taken("b"), hand.taken("c")
        assert hand.take("d") is None
        commit()
    assert first is not None
    assert [held.number for held in (first, second, third)] == [1, 2, 3]
    assert [hand.row(held).worker for held in (first, second, third)] == ["a", "b", "c"]


def test_what_fell_silent_is_locked_only_by_who_takes_it(store, hand):
    silent = hand.taken("dead", -1.0)
    with store.database.write(turn=False) as connection:
        held = queue.claim(connection, "a", 60.0)
        assert held.number == 2  # what was not tried yet goes first
        with store.database.write(turn=False) as other:
            other.execute(text("SET LOCAL lock_timeout = 1"))
            queue.renew(other, silent, 60.0)  # nobody has it locked
    turned(store, silent, leased_until=0.0)
    third, again = hand.taken("b"), hand.taken("c")
    assert (third.number, again.number, again.token) == (3, 1, 2)


@pytest.mark.parametrize("first", ["claim", "cancel"])
def test_a_claim_beside_a_cancellation(store, hand, until, first):
    with store.database.read() as connection:
        job = queue.find_job(connection, _id_of(connection, 1))

    def cancel():
        hand.do(queue.cancel, job)

    if first == "claim":
        with uncommitted(store) as (connection, commit):
            held = queue.claim(connection, "w", 60.0)
            done = beside(store, until, cancel)
            commit()
        assert done.result(PATIENCE_S) is None
        assert held is not None
        with pytest.raises(LostLease):
            hand.do(queue.finish, held, JobState.SUCCEEDED)
    else:
        with store.database.write() as connection:
            queue.cancel(connection, job)
            assert hand.taken().number == 2  # passed over, though not committed
    assert hand.row(job).state == JobState.CANCELLED


def _id_of(connection, number):
    statement = text("SELECT id FROM jobs WHERE number = :number")
    return str(connection.execute(statement, {"number": number}).scalar_one())


@pytest.mark.parametrize("what", ["finish", "check_held", "renew"])
def test_an_end_that_comes_late_and_a_claim_take_effect_once(store, hand, until, what):
    late = hand.taken("late", -1.0)
    hand.taken("b"), hand.taken("c")

    def end(connection):
        if what == "finish":
            queue.finish(connection, late, JobState.SUCCEEDED)
        elif what == "renew":
            queue.renew(connection, late, 60.0)
        else:
            queue.check_held(connection, late)

    with store.database.write() as connection:  # the end is first
        end(connection)
        assert hand.take("next") is None
    turned(store, late, state=JobState.RUNNING, leased_until=0.0)

    def ends():
        with store.database.write() as connection:
            end(connection)

    with uncommitted(store) as (connection, commit):  # the claim is
        held = queue.claim(connection, "next", 60.0)
        done = beside(store, until, ends)
        commit()
    with pytest.raises(LostLease):
        done.result(PATIENCE_S)
    assert hand.row(late).worker == "next"
    assert hand.row(late) == held


def test_a_death_that_is_told_while_another_takes_the_job_is_not_laid_to_it(store, hand, until):
    dead = hand.taken("dead", -1.0)
    hand.taken("b"), hand.taken("c")

    def tell():
        with store.database.write() as connection:
            arguments = (connection, dead.id, dead.token, "died", "trace")
            return queue.fail_dead_worker(*arguments, counts=False)

    with uncommitted(store) as (connection, commit):
        held = queue.claim(connection, "next", 60.0)
        done = beside(store, until, tell)
        commit()
    assert done.result(PATIENCE_S) is None
    assert hand.row(dead) == held  # which is not queued again under its worker


def test_a_job_renewed_while_it_is_buried_keeps_running(store, hand, until):
    held = hand.taken("w", -1.0)
    turned(store, held, attempts=queue.MAXIMUM_ATTEMPTS)

    def bury():
        return hand.do(queue.dead_letter)

    with uncommitted(store) as (connection, commit):
        queue.renew(connection, held, 60.0)
        done = beside(store, until, bury)
        commit()
    assert done.result(PATIENCE_S) == []
    assert hand.row(held).state == JobState.RUNNING


def test_a_token_that_a_promoted_standby_gave_out_again_is_anothers(store, hand):
    held = hand.taken("first")
    turned(store, held, worker="second")  # the same token: the standby lacked the first claim
    with pytest.raises(LostLease):
        hand.do(queue.finish, held, JobState.SUCCEEDED)


@pytest.mark.parametrize("hours", [-5, 5])
def test_the_clock_of_a_host_decides_nothing(store, hand, monkeypatch, hours):
    real = time.time
    monkeypatch.setattr(time, "time", lambda: real() + 3600 * hours)
    held = hand.taken("w", 60.0)
    assert held.started_at == pytest.approx(real(), abs=30)
    assert held.leased_until == pytest.approx(real() + 60, abs=30)
    hand.taken(), hand.taken()
    assert hand.take() is None  # no lease is over
    with store.database.read() as connection:
        assert not queue.has_due(connection)
        assert 0 < (queue.due_in_s(connection) or 0) <= 60
        assert queue.read_clock(connection) == pytest.approx(real(), abs=30)
    hand.do(queue.release_job, held)
    assert hand.taken().number == held.number  # at once
    assert hand.do(queue.dead_letter) == []
