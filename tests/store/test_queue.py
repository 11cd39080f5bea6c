"""Tests of claims and leases of jobs."""

import time

import pytest
from sqlalchemy import select, update

from sceneprint.errors import LostLease, UnknownJob
from sceneprint.process import work_of
from sceneprint.store import queue
from sceneprint.store.maps import find_map
from sceneprint.store.signatures import StoredSignature, index_frame
from sceneprint.store.tables import jobs, signatures
from sceneprint.store.tenants import create_tenant
from sceneprint_client.api import JobState

WORKS = """
from sceneprint_client.api import JobState
from sceneprint.store import open_database, queue
from sceneprint.store.maps import next_revision

def work(i):
    database, done = open_database(ARGS[0]), []
    while True:
        with database.write(turn=False) as connection:  # as workers do
            held = queue.claim(connection, f"process {i}", 60.0)
        if held is None:
            return done
        with database.write() as connection:
            queue.finish(connection, held, JobState.SUCCEEDED)
            next_revision(connection, int(ARGS[1]))
        done.append(held.number)
"""


def test_a_job_is_queued_as_it_should_be(store, hall, hand, queued):
    before = time.time()
    job = queued("a", 3)
    assert (job.kind, job.state, job.priority, job.attempts, job.token) == (
        "sign", JobState.QUEUED, 3, 0, 0,
    )  # fmt: skip
    assert before <= job.run_after == job.created_at <= time.time()
    assert (job.leased_until, job.worker, job.error, job.traceback) == (None,) * 4
    assert (job.started_at, job.finished_at) == (None, None)
    assert hand.row(job) == job
    with store.database.read() as connection:
        assert queue.signing_jobs(connection, [job.frame_number]) == {job.frame_number: job.id}
        assert queue.count_jobs(connection) == {"queued": 1}
        with pytest.raises(UnknownJob, match="no job 'nobody'"):
            queue.find_job(connection, "nobody")
        # a page of jobs is read by the places of the columns
        [listed] = queue.list_jobs(connection, None, 9, None)
        assert (listed.job, listed.map_name, listed.followed_by) == (job, hall.name, None)


def test_what_matters_more_comes_first_and_of_equals_what_came_first(store, hand, queued, turned):
    jobs = [queued(str(i), priority) for i, priority in enumerate([0, 5, 0, 5, -1, 9])]
    turned(jobs[2], run_after=1.0)  # waits longest, but came later than the first
    order = [hand.taken().number - jobs[0].number for _ in jobs]
    assert order == [5, 1, 3, 0, 2, 4]
    assert hand.take() is None


def test_a_claim_is_a_lease_with_a_token(store, hand, queued):
    job = queued("a")
    assert hand.due()
    before = time.time()
    held = hand.taken("host:7", 45.0)
    after = time.time()
    assert held == hand.row(job)
    assert (held.state, held.worker, held.attempts) == (JobState.RUNNING, "host:7", 1)
    assert (held.token, held.token) == (1, 1)
    assert before <= held.started_at <= after
    assert held.leased_until == held.started_at + 45.0
    assert not hand.due()
    assert hand.take() is None


def test_a_job_waits_for_its_time(store, hand, queued, turned):
    job = queued("a")
    turned(job, run_after=time.time() + 30)
    assert not hand.due()
    assert hand.take() is None
    turned(job, run_after=time.time() - 0.001)
    assert hand.due()
    assert hand.taken().number == job.number


def test_a_lease_that_is_over_is_given_to_another_with_a_greater_token(store, hand, queued, turned):
    job = queued("a")
    first = hand.taken("first")
    turned(job, leased_until=time.time() + 100)
    assert hand.take("second") is None
    turned(job, leased_until=time.time() - 0.001)
    assert hand.due()
    second = hand.taken("second")
    assert (second.token, second.attempts, second.worker) == (2, 2, "second")
    assert second.token > first.token
    for late in (
        lambda c: queue.finish(c, first, JobState.SUCCEEDED),
        lambda c: queue.fail(c, first, "late", "late"),
        lambda c: queue.renew(c, first, 9.0),
        lambda c: queue.release_job(c, first),
    ):
        lost = pytest.raises(LostLease, match=f"no longer holds job {job.id}")
        with lost, store.database.write() as connection:
            late(connection)
        assert hand.row(job) == second


def test_what_comes_late_leaves_nothing(store, hand, hall, received, turned):
    frame = received("a")
    job = hand.do(queue.enqueue, "sign", frame.number)
    signature = StoredSignature(hall.model_id, b"\1\2\3", "cd" * 32, [4, 2], [12, 2])
    first = hand.taken("w")
    turned(job, leased_until=1.0)
    second = hand.taken("w")  # of the same name, so that the token alone tells them apart
    for order in (1, -1):  # the effect before the end of the job, and after it
        steps = (
            lambda c: index_frame(c, frame, signature),
            lambda c: queue.finish(c, first, JobState.SUCCEEDED),
        )
        with pytest.raises(LostLease), store.database.write() as connection:
            [step(connection) for step in steps[::order]]
        with store.database.read() as connection:
            assert connection.execute(select(signatures)).all() == []
    with store.database.write() as connection:
        queue.finish(connection, second, JobState.SUCCEEDED)
        assert index_frame(connection, frame, signature) == 1
    assert hand.row(job).state == JobState.SUCCEEDED


def test_renewing_extends_the_lease_and_nothing_else(store, hand, queued, turned):
    queued("a")
    held = hand.taken("w", 10.0)
    turned(held, leased_until=time.time() - 1)  # late, but nobody else came
    before = time.time()
    hand.do(queue.renew, held, 30.0)
    now = hand.row(held)
    assert now.leased_until is not None
    assert before + 30.0 <= now.leased_until <= time.time() + 30.0
    assert (now.token, now.attempts, now.state) == (1, 1, JobState.RUNNING)
    assert hand.take() is None


@pytest.mark.sqlite_only("its query plans")
def test_a_claim_is_looked_up_and_not_sorted(store, hall, plans):
    """100,000 jobs wait while a map is signed again, and a claim holds all writers up."""
    queue_jobs(store, hall, "many", 50)
    with store.database.write() as connection, plans(connection) as said:
        assert queue.claim(connection, "w", 60) is not None
    of_jobs = [text for text in said if "jobs" in text and text.startswith(("SEARCH", "SCAN"))]
    assert len(of_jobs) >= 8  # names, the next, best and turn of each; first; silent, turn; last
    indexes = ("INDEX ix_jobs_", "INTEGER PRIMARY KEY")
    assert all(line.startswith("SEARCH") and any(i in line for i in indexes) for line in of_jobs)
    assert not any("TEMP B-TREE" in text for text in said)


# Tenants take turns.


def queue_jobs(store, hall, tenant, count, priority=0):
    with store.database.write() as connection, work_of(tenant):
        for _ in range(count):
            queue.enqueue(connection, "import", None, priority, map_number=hall.number)


def test_between_two_turns_of_a_tenant_each_other_has_at_most_one(store, hand, hall):
    for tenant, count in (("a", 6), ("b", 4), ("c", 2)):
        queue_jobs(store, hall, tenant, count, priority={"a": 10, "b": 0, "c": -10}[tenant])
    order = "".join(hand.taken().tenant for _ in range(12))
    assert order == "abcabcababaa"
    queue_jobs(store, hall, "c", 3)  # who was away for long has saved nothing up
    queue_jobs(store, hall, "a", 3)
    assert "".join(hand.taken().tenant for _ in range(6)) == "cacaca"


def test_a_long_job_makes_way_for_other_tenants_and_for_higher_priorities(store, hand, hall):
    queue_jobs(store, hall, "long", 1)
    held = hand.taken()

    def makes_way():
        with store.database.read() as connection:
            return queue.has_waiting_before(connection, held)

    assert not makes_way()
    queue_jobs(store, hall, "long", 1, priority=0)  # an equal comes when this has ended
    queue_jobs(store, hall, "", 1, queue.UPKEEP)
    assert not makes_way()
    queue_jobs(store, hall, "long", 1, priority=1)
    assert makes_way()
    assert hand.taken().priority == 1
    assert not makes_way()
    queue_jobs(store, hall, "other", 1, priority=-10)
    assert makes_way()
    with store.database.write() as connection:  # it is not due yet
        later = update(jobs).where(jobs.c.tenant == "other")
        connection.execute(later.values(run_after=time.time() + 60))
    assert not makes_way()


def test_upkeep_waits_for_what_was_asked_and_what_no_key_asked_takes_turns(store, hand, hall):
    queue_jobs(store, hall, "", 2, queue.UPKEEP)
    queue_jobs(store, hall, "", 1, queue.UPKEEP + 1)
    queue_jobs(store, hall, "a", 2, queue.UPKEEP)
    claims = [hand.taken() for _ in range(5)]
    assert [(job.tenant, job.priority) for job in claims] == [
        ("", -9), ("a", -10), ("a", -10), ("", -10), ("", -10),
    ]  # fmt: skip


def test_what_fell_silent_has_its_tenants_turn(store, hand, hall, turned):
    queue_jobs(store, hall, "a", 2)
    silent = hand.taken("dead", -1.0)
    queue_jobs(store, hall, "b", 1)
    claims = [hand.taken() for _ in range(3)]
    assert [job.tenant for job in claims] == ["b", "a", "a"]
    assert silent.number == claims[2].number  # tried before: behind the tenant's other


def test_deleted_jobs_give_no_turn_back(store, hand, hall):
    with store.database.write() as connection:
        for name in ("a", "b"):
            create_tenant(connection, name)
    queue_jobs(store, hall, "b", 3)
    queue_jobs(store, hall, "a", 2)
    first = hand.taken()
    hand.do(queue.remove_job, first)
    assert (first.tenant, hand.taken().tenant, hand.taken().tenant) == ("a", "b", "a")


def test_a_clock_set_back_changes_no_turn(store, hand, hall, monkeypatch):
    queue_jobs(store, hall, "b", 2)
    queue_jobs(store, hall, "a", 2)
    with store.database.write() as connection:
        connection.execute(update(jobs).values(run_after=0.0))
    assert hand.taken().tenant == "a"
    if store.database.is_sqlite:
        monkeypatch.setattr(time, "time", lambda: 1e9)
    assert [hand.taken().tenant for _ in range(3)] == ["b", "a", "b"]


def test_jobs_and_leases_written_before_the_clock_was_set_back_are_taken(
    store, hand, queued, turned
):
    """A year back: what was due then is due now, and no lease was ever that long."""
    year, job = 365 * 86_400.0, queued("a")
    turned(job, run_after=time.time() + year)
    assert hand.due()
    first = hand.taken("first")
    assert first.number == job.number
    turned(job, leased_until=time.time() + year)
    assert hand.due()
    second = hand.taken("second")
    assert (second.worker, second.token) == ("second", 2)


def test_processes_at_one_queue_get_each_job_once(url, store, hall, queued, race):
    wanted = [queued(str(i)).number for i in range(30)]
    result = race(WORKS, 3, url, hall.number)
    assert all(isinstance(each, list) for each in result), result  # else what was raised
    assert sorted(number for each in result for number in each) == wanted
    with store.database.read() as connection:
        assert queue.count_jobs(connection) == {"succeeded": 30}
        assert find_map(connection, "hall").revision == 30
