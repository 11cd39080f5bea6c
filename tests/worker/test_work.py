"""Tests of worker processes, which sign each frame once after faults of disk and database."""

import re
import signal
import time

from benchmarks.waiting import PATIENCE_S, until
from sceneprint_client.api import NewMap


def test_two_workers_sign_each_frame_once(crew, frames):
    crew.engine.create_map(NewMap(name="many", model="depth"))
    added = []
    while len({crew.pid(one.job_id) for one in added}) < 2:  # on a busy machine one may sign some
        assert len(added) < 40
        added += [crew.engine.add_frame("many", *f)[0] for f in frames[len(added) : len(added) + 8]]
        crew.settled("many", len(added))
    jobs = [crew.engine.get_job(frame.job_id) for frame in added]
    assert {(job.state, job.error) for job in jobs} == {("succeeded", None)}
    assert {job.attempts for job in jobs} == {1}
    assert crew.signed("many") == [1] * len(added)
    assert crew.engine.get_map("many").revision == len(added)


def test_a_database_that_vanishes_for_a_moment_is_waited_for(crew, frames):
    crew.engine.create_map(NewMap(name="shaken", model="depth"))
    crew.change("ALTER TABLE jobs RENAME TO away")
    until(lambda: len(crew.log("store unreachable")) >= 2)
    crew.change("ALTER TABLE away RENAME TO jobs")
    for frame in frames[32:36]:
        crew.engine.add_frame("shaken", *frame)
    crew.settled("shaken", 4)
    output = crew.log("store unreachable")[0]["error"]  # in the words of either database
    assert re.search('no such table: jobs|relation "jobs" does not', output)
    assert len(crew.log("worker ready")) == 2  # the same two


def test_a_job_that_takes_many_leases_is_kept_by_its_worker(crew, slow):
    job = slow("patient", 40)
    holder, job_id = crew.pid(job.added.job_id), job.added.job_id
    (first,) = crew.job(job_id, "leased_until")
    until(
        lambda: crew.job(job_id, "leased_until")[0] > first + 2 * crew.engine.settings.job_lease_s
    )
    assert crew.job(job_id, "state, attempts, token") == ("running", 1, 1)
    job.give()
    crew.settled("patient", 1)
    assert crew.job(job_id, "state, attempts, token") == ("succeeded", 1, 1)
    assert crew.pid(job_id) == holder
    assert crew.signed("patient") == [1]
    assert [line for line in crew.log("lease lost") if line["job_id"] == job_id] == []


def test_told_to_stop_workers_give_back_what_they_have_not_begun(crew, frames):
    crew.engine.create_map(NewMap(name="stopped", model="depth"))
    crew.pause()
    added, _ = crew.engine.add_frame("stopped", *frames[44])
    # who would claim it waits for this to end
    with crew.engine.store.database.write() as connection:
        if not crew.engine.store.database.is_sqlite:  # where a claim waits for no turn
            connection.exec_driver_sql("LOCK TABLE jobs IN ACCESS EXCLUSIVE MODE")
        crew.send(signal.SIGCONT)
        time.sleep(1)
        crew.process.terminate()  # before they do: it replaces nobody from now on
        crew.send(signal.SIGTERM)
    assert crew.process.wait(PATIENCE_S) == 0
    assert crew.job(added.job_id, "state, attempts, leased_until") == ("queued", 0, None)
    assert crew.engine.get_frame("stopped", added.frame_id).state == "received"
