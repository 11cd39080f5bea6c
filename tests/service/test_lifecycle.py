"""Tests of the serve command from start to end: signals, crashes and errors."""

import os
import signal
import socket
import sys
from datetime import datetime

import pytest


@pytest.fixture(scope="module")
def signing(rows):
    return lambda server: bool(rows(server.folder, "SELECT 1 FROM jobs WHERE state = 'running'"))


@pytest.mark.parametrize(
    "number", [signal.SIGTERM, pytest.param(signal.SIGINT, marks=pytest.mark.thorough)]
)
def test_told_to_stop_it_finishes_the_frame_in_hand(begin, make_map, shots, until, number, rows):
    server = begin()
    server.ready()
    path = make_map(server, "hall", model="paper")
    for shot in shots[:4]:
        assert server.client.post(f"{path}/frames", **shot.form()).status_code == 202
    # the first frame loads the kernels, which may take longer on a busy machine than a worker has
    until(lambda: rows(server.folder, "SELECT 1 FROM frames WHERE state = 'indexed'"))
    assert server.end(number) == 0
    server.gone()
    states = rows(server.folder, "SELECT f.state, j.state, j.attempts FROM frames f JOIN jobs j"
                                 " ON j.frame_number = f.number ORDER BY f.number")  # fmt: skip
    done = [state for state in states if state == ("indexed", "succeeded", 1)]
    assert len(done) >= 1
    assert states == done + [("received", "queued", 0)] * (4 - len(done))
    for line in server.log():  # each line is JSON, to the last
        assert datetime.fromisoformat(line["time"]).utcoffset() is not None
        assert line["level"] in ("info", "warning")
        assert line["message"]
    assert len(server.log("worker stopped")) == 1
    assert server.log("worker died") == []


@pytest.mark.thorough
def test_workers_whose_service_was_killed_leave_by_themselves(begin):
    server = begin("--workers", "2")
    server.ready(2)
    assert len(server.workers) == 2
    assert server.end(signal.SIGKILL) == -signal.SIGKILL
    server.gone()


@pytest.mark.thorough
def test_a_worker_that_dies_is_replaced_and_its_frame_signed(
    begin, make_map, shots, until, signing
):
    server = begin(job_lease_s=1)
    server.ready()
    path = make_map(server, "hall", model="paper")
    sent = server.client.post(f"{path}/frames", **shots[0].form()).json()
    until(lambda: signing(server))
    (killed,) = server.workers
    os.kill(killed, signal.SIGKILL)
    until(
        lambda: server.client.get(f"{path}/frames/{sent['frame_id']}").json()["state"] == "indexed"
    )
    job = server.client.get(f"/v1/jobs/{sent['job_id']}").json()
    assert (job["state"], job["attempts"]) == ("succeeded", 2)
    (died,) = server.log("worker died")
    assert (died["pid"], died["code"]) == (killed, -signal.SIGKILL)
    assert len(server.workers) == 1
    assert server.workers != [killed]
    assert server.end(signal.SIGTERM) == 0
    server.gone()


def test_a_port_that_is_taken_is_refused_in_one_line(begin, tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
        server = begin("--port", str(port), folder=tmp_path / "new", wait=False)
        assert server.end() == 2
    assert not (tmp_path / "new").exists()
    assert server.errors.read_text() == (
        f"sceneprint serve: 127.0.0.1:{port} is not available (Address already in use). "
        "Choose another --port (0 selects a free port), or stop the process that uses this "
        "port.\n"
    )
    assert server.process.stdout.read() == ""
    server.gone()


@pytest.mark.thorough
def test_service_and_worker_alone_do_the_job_together(begin, make_map, small_shots, tmp_path):
    settings = {"data_dir": tmp_path, "port": 0, "workers": 1}
    service = begin(command=(sys.executable, "-m", "service"), **settings)
    path = make_map(service, "hall")
    sent = service.client.post(f"{path}/frames", **small_shots[0].form())
    assert (sent.status_code, service.workers) == (202, [])
    worker = begin(command=(sys.executable, "-m", "worker"), wait=False, **settings)
    waited = service.client.post(
        f"{path}/frames", **small_shots[1].form(), headers={"Prefer": "wait=200"}
    )
    assert (waited.status_code, waited.json()["state"]) == (201, "indexed")
    answer = service.client.post(f"{path}/queries", **small_shots[0].form()).json()
    assert answer["matches"][0]["frame_id"] == sent.json()["frame_id"]
    assert worker.end(signal.SIGTERM) == 0
    worker.gone()
    assert service.end(signal.SIGTERM) == 0
    service.gone()
    for server in (service, worker):
        assert {line["level"] for line in server.log()} == {"info"}
