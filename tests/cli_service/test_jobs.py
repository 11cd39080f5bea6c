"""Tests of `sceneprint jobs` with a service."""

import json

import pytest

from benchmarks.waiting import PATIENCE_S
from sceneprint.cli import main
from sceneprint.settings import Settings
from sceneprint_client import Client
from tests.whole_engine import Engine


@pytest.fixture
def dead(sceneprint, data_folder, rooms, service_url):
    """Jobs of a map of two frames: one as if it had broken down too often, and one done."""
    sceneprint("upload", "jobs", rooms / "room-0", "--every", 2, "--priority", -3)
    with Client(service_url) as client, Engine(Settings(data_dir=data_folder)) as engine:
        (job, other) = [job for job in client.jobs() if job.map == "jobs"][:2]
        with engine.store.database.write() as connection:
            connection.exec_driver_sql(
                "UPDATE jobs SET state = 'dead', error = 'it hung', traceback = 'Trace' "
                f"WHERE id = '{job.job_id}'"
            )
            connection.exec_driver_sql(
                "DELETE FROM signatures WHERE frame_number = "
                f"(SELECT number FROM frames WHERE id = '{job.frame_id}')"
            )
            connection.exec_driver_sql(
                f"UPDATE frames SET state = 'failed' WHERE id = '{job.frame_id}'"
            )
        yield job.job_id, other.job_id
        client.delete_map("jobs")


def test_dead_jobs_are_listed_and_tried_again(sceneprint, dead, service_url):
    (said, _) = sceneprint("jobs", "--state", "dead")
    head, line = said.splitlines()
    assert head.split() == ["job", "state", "prio", "tries", "created", "map", "error"]
    assert line.split()[:4] == [dead[0], "dead", "-3", "1"]
    assert line.endswith("  jobs  it hung")
    (said, _) = sceneprint("jobs", "--state", "dead", "--json")
    assert json.loads(said)["traceback"] == "Trace"
    (said, _) = sceneprint("jobs", "--retry-dead")
    first, last = said.splitlines()
    assert first.endswith(" of map jobs, queued")
    assert last == "1 jobs queued again, 0 cannot be retried"
    again = first.split()[1]
    with Client(service_url) as client:
        (job,) = client.wait([again], timeout_s=PATIENCE_S)
        assert job.state == "succeeded"
    (said, _) = sceneprint("jobs", "--retry-dead")  # it is history now
    assert said == "0 jobs queued again, 0 cannot be retried\n"


def test_a_priority_out_of_its_range_is_refused(capsys):
    for wrong in ("11", "-11", "x", "--5", "1.0"):
        with pytest.raises(SystemExit):
            main(["upload", "m", "path", f"--priority={wrong}"])
        assert "is not an integer from -10 to 10" in capsys.readouterr().err
