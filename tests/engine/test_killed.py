"""Tests of killed workers, whose jobs take effect once."""

import signal
import subprocess
import sys
import time

import pytest
from sqlalchemy import select

from benchmarks.waiting import PATIENCE_S
from sceneprint.store.tables import jobs, signatures
from sceneprint_client.api import FrameState, JobState, Query

#: Works as a worker does, and stands still at a step of which it tells.
WORKER = """
import sys, time
from pathlib import Path
from tests.whole_engine import Engine
from sceneprint.engine.jobs import signature_job
from sceneprint.settings import Settings

step = getattr(signature_job, sys.argv[2])

def stand_still(*given):
    if sys.argv[3] == "after":
        step(*given)
    print(sys.argv[2], flush=True)
    time.sleep(600)

setattr(signature_job, sys.argv[2], stand_still)
engine = Engine(Settings(data_dir=Path(sys.argv[1]), job_lease_s=2))
engine.run(engine.claim("doomed"))
"""


def lease(engine):
    with engine.store.database.read() as connection:
        until = connection.execute(select(jobs.c.leased_until)).scalar_one()
    assert until is not None
    return float(until)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("step", "when", "artifact"), [("write_geometry", "after", 0), ("_store", "before", 1)]
)
def test_what_a_killed_worker_had_in_hand_is_done_once_by_another(
    empty, uploads, told, step, when, artifact
):
    added, _ = empty.add_frame("hall", uploads[0].data, uploads[0].meta)
    folder = str(empty.settings.data_dir)
    with subprocess.Popen(
        [sys.executable, "-c", WORKER, folder, step, when], stdout=subprocess.PIPE, text=True
    ) as worker:
        try:
            assert worker.stdout.readline() == f"{step}\n"
            if step == "write_geometry":  # while it works it keeps the job
                renewed, begun = {lease(empty)}, time.monotonic()
                while len(renewed) < 3:
                    assert empty.claim("other") is None
                    renewed.add(lease(empty))
                    assert time.monotonic() - begun < PATIENCE_S
                    time.sleep(0.02)
        finally:
            worker.kill()
        assert worker.wait() == -signal.SIGKILL
    assert len(list(empty.store.blobs.digests())) == 1 + artifact
    begun = time.monotonic()
    while (claimed := empty.claim("other")) is None:
        assert time.monotonic() - begun < PATIENCE_S
        time.sleep(0.02)
    assert (claimed.job.token, claimed.job.attempts) == (2, 2)
    assert claimed.job.worker == "other"
    assert empty.run(claimed) == JobState.SUCCEEDED
    assert empty.claim("other") is None
    with empty.store.database.read() as connection:
        assert len(connection.execute(select(signatures)).all()) == 1
    assert len(list(empty.store.blobs.digests())) == 2
    assert empty.get_map("hall").revision == 1
    assert told(empty) == ["map.created", "frame.received", "frame.indexed"]
    assert empty.get_frame("hall", added.frame_id).state == FrameState.INDEXED
    answer = empty.queries.upload(["hall"], uploads[0].data, uploads[0].meta, Query(k=1))
    assert [(m.frame_id, m.distance) for m in answer.matches] == [(added.frame_id, 0)]
