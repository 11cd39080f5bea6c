"""Tests of the ends of jobs: success, retries, failure and return to the queue."""

import time

import pytest

from sceneprint.errors import LostLease
from sceneprint.store import queue
from sceneprint.store.tables import jobs
from sceneprint_client.api import JobState


@pytest.mark.parametrize("state", [JobState.SUCCEEDED, JobState.FAILED])
def test_what_is_finished_stays_so(store, hand, queued, state):
    job = queued("a")
    held = hand.taken()
    before = time.time()
    hand.do(queue.finish, held, state, "why")
    now = hand.row(job)
    assert (now.state, now.error, now.leased_until) == (state, "why", None)
    assert now.finished_at is not None
    assert before <= now.finished_at <= time.time()
    with pytest.raises(LostLease):
        hand.do(queue.finish, held, JobState.SUCCEEDED)
    assert hand.row(job) == now
    assert not hand.due()


def test_a_job_that_breaks_waits_longer_each_time_and_is_dead_after_three(
    store, hand, queued, turned
):
    job = queued("a")
    for attempt, wait in ((1, 2.0), (2, 8.0)):
        held = hand.taken()
        assert held.attempts == attempt
        before = time.time()
        assert hand.fail(held, f"error {attempt}", f"trace {attempt}") == JobState.QUEUED
        now = hand.row(job)
        assert before + wait <= now.run_after <= time.time() + wait
        assert (now.state, now.leased_until, now.finished_at) == (JobState.QUEUED, None, None)
        assert (now.error, now.traceback) == (f"error {attempt}", f"trace {attempt}")
        assert hand.take() is None
        turned(job, run_after=0.0)
    assert hand.fail(hand.taken(), "error 3", "trace 3") == JobState.DEAD
    dead = hand.row(job)
    assert (dead.state, dead.attempts, dead.token) == (JobState.DEAD, 3, 3)
    assert (dead.error, dead.traceback) == ("error 3", "trace 3")
    assert dead.finished_at is not None
    turned(job, run_after=0.0)
    assert not hand.due()
    assert hand.take() is None


def test_success_forgets_the_errors_of_earlier_tries(store, hand, queued, turned):
    job = queued("a")
    hand.fail(hand.taken())
    turned(job, run_after=0.0)
    with store.database.write() as connection:
        held = queue.claim(connection, "w", 60.0)
        assert held is not None
        queue.finish(connection, held, JobState.SUCCEEDED)
    now = hand.row(job)
    assert (now.state, now.attempts, now.error, now.traceback) == (
        JobState.SUCCEEDED, 2, None, None,
    )  # fmt: skip


def test_a_job_whose_workers_all_fell_silent_is_buried(store, hand, queued, turned):
    silent = queued("a")
    for attempt in range(1, 11):
        held = hand.taken()
        assert (held.number, held.attempts) == (silent.number, attempt)
        assert hand.do(queue.dead_letter) == []  # its last lease still runs
        turned(silent, leased_until=time.time() - 1)
        if attempt < 10:
            assert hand.do(queue.dead_letter) == []  # another may try
    lively = queued("b")
    assert hand.taken().number == lively.number  # and the other not an eleventh time
    assert hand.due()  # to be buried
    (buried,) = hand.do(queue.dead_letter)
    assert buried == hand.row(silent)
    assert (buried.state, buried.leased_until) == (JobState.DEAD, None)
    assert buried.error == "its worker stopped responding in the last of 10 attempts"
    assert buried.finished_at is not None
    assert not hand.due()
    with pytest.raises(LostLease):
        hand.do(queue.finish, held, JobState.SUCCEEDED)


def test_silence_is_not_counted_as_breaking_down(hand, queued, turned):
    """A machine restarted eight times must not cost a frame that then breaks down once."""
    job = queued("a")
    for _ in range(8):
        hand.taken()
        turned(job, leased_until=time.time() - 1)
    assert hand.fail(hand.taken()) == JobState.QUEUED
    assert (hand.row(job).attempts, hand.row(job).failures) == (9, 1)
    turned(job, run_after=0.0)
    assert hand.fail(hand.taken()) == JobState.DEAD  # the tenth try is the last, whatever ended it


def test_cancelling_takes_a_job_from_whoever_has_it(store, hand, queued):
    running, waiting, over, other = (queued(name) for name in "abcd")
    held = hand.taken()
    hand.do(queue.cancel_jobs, jobs.c.frame_number == waiting.frame_number)
    assert hand.row(waiting).state == JobState.CANCELLED
    done = hand.taken()
    assert done.number == over.number  # not the cancelled one
    with store.database.write() as connection:
        queue.finish(connection, done, JobState.SUCCEEDED)
        queue.cancel_jobs(connection, jobs.c.frame_number == over.frame_number)
        queue.cancel_jobs(connection, jobs.c.frame_number == running.frame_number)
    assert hand.row(over).state == JobState.SUCCEEDED
    with pytest.raises(LostLease):
        hand.do(queue.finish, held, JobState.SUCCEEDED)
    now = hand.row(running)
    assert (now.state, now.leased_until) == (JobState.CANCELLED, None)
    assert now.finished_at is not None
    assert hand.row(other) == other


def test_what_is_given_back_was_never_tried(store, hand, queued):
    job = queued("a")
    for token in (1, 2, 3, 4, 5):  # as often as workers are stopped
        held = hand.taken()
        assert (held.token, held.attempts) == (token, 1)
        hand.do(queue.release_job, held)
        now = hand.row(job)
        assert (now.state, now.attempts, now.worker, now.leased_until) == (
            JobState.QUEUED, 0, None, None,
        )  # fmt: skip
        assert now.run_after <= time.time()
