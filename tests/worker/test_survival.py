"""Tests that workers survive frames that crash, hang, or exhaust memory."""

import sys

import pytest

from benchmarks.waiting import PATIENCE_S, until
from sceneprint_client.api import NewMap

#: The workers as they are, but for what they do with frames of some focal lengths. Nothing but
#: the bell, and the time of the next try, wakes those that wait.
SCRIPT = """
import ctypes, logging, sys
import numpy as np
import sceneprint.engine.jobs.signature_job as work
import sceneprint.store.queue as queue
import worker.loop, worker.supervisor

queue.BACKOFF_S = 0.05
queue.MAXIMUM_FAILURES = 1  # each takes a worker, and to replace one takes two seconds
worker.loop.LONGEST_S = worker.loop.UPKEEP_S = 1e6
worker.supervisor.GRACE_S = 1.0
prepare = work.prepare

def crashing(): ctypes.string_at(0)
def hanging():
    logging.getLogger("spoilt").info("hanging")
    while True:  # a signal ends one sleep
        ctypes.PyDLL(None).sleep(600)  # never gives the interpreter back
def hungry(): return np.ones(1 << 30, np.uint8)
def broken(): raise ZeroDivisionError("a bug")

def spoilt(frame, signer):
    for what, fx in ((crashing, 101), (hanging, 102), (hungry, 103), (broken, 104)):
        if frame.intrinsics.fx == fx:
            what()
    return prepare(frame, signer)

work.prepare = spoilt
if __name__ == "__main__":
    from worker.__main__ import main
    sys.exit(main())
"""
MARKS = {"crashing": 101, "hanging": 102, "hungry": 103, "broken": 104}


@pytest.fixture(scope="module")
def script(tmp_path_factory):
    path = tmp_path_factory.mktemp("script") / "spoilt.py"
    path.write_text(SCRIPT)
    return [sys.executable, str(path)]


@pytest.fixture(scope="module")
def crew(hire, script):
    with hire(script, job_timeout_s=6, worker_memory_bytes=512 << 20) as crew:
        crew.engine.create_map(NewMap(name="hall", model="depth"))
        yield crew


def add_marked(engine, frame, what):
    """Upload a frame whose focal length says what becomes of its worker; id of its job."""
    data, meta = frame
    lens = meta.intrinsics.model_copy(update={"fx": float(MARKS[what])})
    own_meta = meta.model_copy(update={"intrinsics": lens})
    return engine.add_frame("hall", data, own_meta)[0].job_id


def test_a_frame_that_ends_its_worker_is_given_up_and_costs_no_other(crew, frames):
    bad = {what: add_marked(crew.engine, frames[i], what) for i, what in enumerate(MARKS)}
    good = [crew.engine.add_frame("hall", *frame)[0].job_id for frame in frames[8:12]]
    ended = {"failed": 4, "indexed": 4}  # four workers later, on a machine that is busy
    until(lambda: crew.engine.get_map("hall").frames == ended, 2 * PATIENCE_S)
    jobs = {what: crew.engine.get_job(job) for what, job in bad.items()}
    assert {(job.state, job.attempts) for job in jobs.values()} == {("dead", 1)}
    for what, job in jobs.items():
        assert f"in {what}" in job.traceback
        assert "spoilt.py" in job.traceback
        assert crew.engine.get_frame("hall", job.frame_id).reason == job.error
    assert jobs["crashing"].error == "its worker was killed by signal 11 (Segmentation fault)"
    assert jobs["hanging"].error.startswith("its worker exceeded 6 s and was stopped. If ")
    assert jobs["hungry"].error.startswith("MemoryError: Unable to allocate 1.00 GiB")
    assert jobs["broken"].error == "ZeroDivisionError: a bug"
    # the others did not notice: none was tried twice, and nobody died but of the frames at fault
    assert {crew.job(job, "state, attempts, failures") for job in good} == {("succeeded", 1, 0)}
    until(lambda: len(crew.log("worker replaced")) == 2)
    died = [line["job_id"] for line in crew.log("worker died")]
    assert sorted(died) == sorted([bad["crashing"], bad["hanging"]])
    assert crew.log("lease lost") == []
    assert crew.rows("SELECT count(*) FROM events WHERE kind = 'frame.failed'") == [(4,)]


def test_a_worker_that_does_not_stop_gives_its_job_back(crew, frames):
    before = len(crew.log("hanging"))
    job = add_marked(crew.engine, frames[20], "hanging")
    until(lambda: len(crew.log("hanging")) > before)  # claimed alone, it would be put back
    crew.process.terminate()
    assert crew.process.wait(PATIENCE_S) == 0
    assert crew.pid(job) in [line["pid"] for line in crew.log("worker does not stop")]
    assert crew.job(job, "state, attempts, failures, leased_until") == ("queued", 1, 0, None)
    assert crew.engine.get_frame("hall", crew.engine.get_job(job).frame_id).state == "received"
