"""Test of a failover to the standby under a working service and worker."""

import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import httpx
import pytest

from benchmarks.postgres import Server
from benchmarks.waiting import PATIENCE_S


@pytest.fixture
def fleet(tmp_path_factory, until):
    """`sceneprint serve`, started before its database, which has a synchronous standby."""
    folder = tmp_path_factory.mktemp("fleet")
    primary = Server(folder / "primary")
    primary.start()
    standby = primary.standby(folder / "standby", synchronous=True)
    primary.create("fleet")
    primary.stop()
    hosts = f"host=127.0.0.1:{primary.port}&host=127.0.0.1:{standby.port}"
    settings = {
        "SCENEPRINT_DATABASE_URL":
            f"postgresql+psycopg://postgres@/fleet?{hosts}&target_session_attrs=read-write",
        "SCENEPRINT_DATA_DIR": str(folder / "data"), "SCENEPRINT_PORT": "0",
        "SCENEPRINT_WORKERS": "1", "SCENEPRINT_JOB_LEASE_S": "4",
    }  # fmt: skip
    errors = folder / "errors"
    with errors.open("wb") as log:
        process = subprocess.Popen(
            [f"{Path(sys.executable).parent}/sceneprint", "serve"], stdout=subprocess.PIPE,
            stderr=log, text=True, start_new_session=True, env=os.environ | settings,
        )  # fmt: skip

    def logged(message):
        text = errors.read_text()
        lines = map(json.loads, text[: text.rfind("\n") + 1].splitlines())
        return [line for line in lines if line["message"] == message]

    try:
        until(lambda: logged("waiting for the database"))
        primary.start()
        address = re.match(r"sceneprint: serving (\S+)", process.stdout.readline())
        assert address is not None, errors.read_text()
        until(lambda: logged("worker ready"))
        with httpx.Client(base_url=address[1], timeout=PATIENCE_S, trust_env=False) as client:
            yield SimpleNamespace(primary=primary, standby=standby, logged=logged, client=client)
    finally:
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        primary.kill()
        standby.kill()


@pytest.mark.thorough
def test_nothing_acknowledged_is_lost_and_all_goes_on_by_itself(fleet, small, until):
    client, frame_ids = fleet.client, []
    assert client.post("/v1/maps", json={"name": "hall", "model": "depth"}).is_success
    views = [
        {"frame": ("a.png", one.png), "meta": (None, one.meta.model_dump_json(exclude_unset=True))}
        for one in small
    ]

    def upload(view):
        answer = client.post("/v1/maps/hall/frames", files=view)
        if answer.status_code == 202:
            frame_ids.append(answer.json()["frame_id"])
        return answer

    def query():
        return client.post("/v1/maps/hall/queries", files=views[0])

    def frames():
        return client.get("/readyz").json().get("frames")

    assert [upload(view).status_code for view in views[:3]] == [202] * 3
    until(lambda: frames() == {"indexed": 3})
    assert [upload(view).status_code for view in views[3:6]] == [202] * 3  # maybe being signed
    fleet.primary.kill()
    for refused in (upload(views[6]), query()):
        assert (refused.status_code, refused.json()["type"]) == (503, "/problems/store-away")
        assert int(refused.headers["retry-after"]) >= 1
        assert "127.0.0.1" not in refused.json()["detail"]
    until(lambda: fleet.logged("store unreachable"))
    fleet.standby.promote()
    answer = until(lambda: (answer := query()).status_code == 200 and answer)
    assert answer.json()["matches"][0]["frame_id"] == frame_ids[0]
    until(lambda: upload(views[7]).status_code == 202)
    until(lambda: frames() == {"indexed": 7})
    for frame_id in frame_ids:
        assert client.get(f"/v1/maps/hall/frames/{frame_id}").json()["state"] == "indexed"
    # the worker waited, and was not replaced
    assert (len(fleet.logged("worker ready")), fleet.logged("worker died")) == (1, [])
