"""Tests of many workers at one queue, as threads and as processes."""

import threading

from sceneprint.store import queue
from sceneprint.store.maps import find_map, next_revision
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


def test_threads_at_one_queue_get_each_job_once(store, hall, queued):
    wanted = [queued(str(i)).number for i in range(30)]
    start, done, raised = threading.Barrier(8), [], []

    def work(name):
        try:
            start.wait()
            while True:
                with store.database.write(turn=False) as connection:
                    held = queue.claim(connection, name, 60.0)
                if held is None:
                    return
                with store.database.write() as connection:
                    queue.finish(connection, held, JobState.SUCCEEDED)
                    next_revision(connection, hall.number)
                done.append(held.number)
        except BaseException as error:
            raised.append(error)

    threads = [threading.Thread(target=work, args=(str(i),)) for i in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert raised == []
    assert sorted(done) == wanted
    with store.database.read() as connection:
        assert queue.count_jobs(connection) == {"succeeded": 30}
        assert find_map(connection, "hall").revision == 30


def test_processes_at_one_queue_get_each_job_once(url, store, hall, queued, race):
    wanted = [queued(str(i)).number for i in range(30)]
    found = race(WORKS, 3, url, hall.number)
    assert all(isinstance(each, list) for each in found), found  # else what was raised
    assert sorted(number for each in found for number in each) == wanted
    with store.database.read() as connection:
        assert queue.count_jobs(connection) == {"succeeded": 30}
        assert find_map(connection, "hall").revision == 30


def test_threads_that_outlive_their_leases_take_effect_once(store, hall, queued, turned):
    """Every lease is over at once, so that each job is in several hands: one of them counts."""
    jobs = [queued(str(i)) for i in range(12)]
    start, effects, lost, raised = threading.Barrier(4), [], [], []

    def work(name):
        try:
            start.wait()
            while True:
                with store.database.write(turn=False) as connection:
                    held = queue.claim(connection, name, -1.0)
                if held is None:
                    return
                try:
                    with store.database.write() as connection:
                        queue.finish(connection, held, JobState.SUCCEEDED)
                        next_revision(connection, hall.number)
                    effects.append(held.number)
                except queue.LostLease:
                    lost.append(held.number)
        except BaseException as error:
            raised.append(error)

    threads = [threading.Thread(target=work, args=(str(i),)) for i in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert raised == []
    assert sorted(effects) == sorted(set(effects))
    with store.database.write() as connection:
        dead = [job.number for job in queue.dead_letter(connection)]
        assert sorted(effects + dead) == [job.number for job in jobs]
        assert find_map(connection, "hall").revision == len(effects)
