"""Tests of a failover to the standby under a working service and worker."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path

import httpx
import pytest

from benchmarks.postgres import Server
from benchmarks.waiting import PATIENCE_S


@dataclass
class Fleet:
    """A primary, its synchronous standby, and a process of ours that knows both."""

    primary: Server
    standby: Server
    process: subprocess.Popen[str]
    errors: Path
    url: str = ""
    client: httpx.Client = field(
        default_factory=lambda: httpx.Client(timeout=PATIENCE_S, trust_env=False)
    )

    def log(self, message):
        text = self.errors.read_text()
        try:
            lines = [json.loads(line) for line in text[: text.rfind("\n") + 1].splitlines()]
        except json.JSONDecodeError as error:
            raise AssertionError(f"not JSON in the log: {text[-3000:]}") from error
        return [line for line in lines if line["message"] == message]

    def ask(self, method, path, **given):
        return self.client.request(method, self.url + path, **given)


@pytest.fixture
def fleet(tmp_path_factory, until):
    """`sceneprint serve`, started before its database is there."""
    folder = tmp_path_factory.mktemp("fleet")
    primary = Server(folder / "primary")
    primary.start()
    standby = primary.standby(folder / "standby", synchronous=True)
    primary.create("fleet")
    primary.stop()
    hosts = f"host=127.0.0.1:{primary.port}&host=127.0.0.1:{standby.port}"
    url = f"postgresql+psycopg://postgres@/fleet?{hosts}&target_session_attrs=read-write"
    settings = {"DATABASE_URL": url, "DATA_DIR": str(folder / "data"), "PORT": "0", "WORKERS": "1",
                "JOB_LEASE_S": "4"}  # fmt: skip
    errors = folder / "errors"
    with errors.open("wb") as log:
        process = subprocess.Popen(
            [f"{Path(sys.executable).parent}/sceneprint", "serve"], stdout=subprocess.PIPE,
            stderr=log, text=True, start_new_session=True,
            env=os.environ | {f"SCENEPRINT_{name}": value for name, value in settings.items()},
        )  # fmt: skip
    made = Fleet(primary, standby, process, errors)
    try:
        until(lambda: made.log("waiting for the database"))
        primary.start()
        told = re.match(r"sceneprint: serving (\S+)", process.stdout.readline())
        assert told is not None, errors.read_text()
        made.url = told[1]
        until(lambda: made.log("worker ready"))
        yield made
    finally:
        made.client.close()
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        if process.stdout is not None:
            process.stdout.close()
        primary.kill()
        standby.kill()


@pytest.mark.thorough
def test_nothing_acknowledged_is_lost_and_all_goes_on_by_itself(fleet, small, until):
    assert fleet.ask("POST", "/v1/maps", json={"name": "hall", "model": "depth"}).is_success
    kept = []
    views = [
        {"frame": ("a.png", one.png), "meta": (None, one.meta.model_dump_json(exclude_unset=True))}
        for one in small
    ]

    def upload(view):
        answer = fleet.ask("POST", "/v1/maps/hall/frames", files=view)
        if answer.status_code == 202:
            kept.append(answer.json()["frame_id"])
        return answer

    def query(view):
        return fleet.ask("POST", "/v1/maps/hall/queries", files=view)

    for view in views[:3]:
        assert upload(view).status_code == 202
    until(lambda: fleet.ask("GET", "/readyz").json().get("frames") == {"indexed": 3})
    assert query(views[0]).json()["matches"][0]["frame_id"] == kept[0]
    for view in views[3:6]:  # which the worker may have in hand
        assert upload(view).status_code == 202
    fleet.primary.kill()
    refusals = [upload(views[6]), query(views[0])]
    # readiness may be a second old
    refusals.append(
        until(lambda: (answer := fleet.ask("GET", "/readyz")).status_code == 503 and answer)
    )
    for refused in refusals:
        assert refused.status_code == 503
        assert refused.headers["content-type"] == "application/problem+json"
        assert int(refused.headers["retry-after"]) >= 1
        assert refused.json()["type"] == "/problems/store-away"
        assert "127.0.0.1" not in refused.json()["detail"]
    assert fleet.ask("GET", "/healthz").status_code == 200
    until(lambda: fleet.log("store unreachable"))
    fleet.standby.promote()
    found = until(lambda: (answer := query(views[0])).status_code == 200 and answer)
    assert found.json()["matches"][0]["frame_id"] == kept[0]
    until(lambda: upload(views[7]).status_code == 202)
    until(lambda: fleet.ask("GET", "/readyz").json().get("frames") == {"indexed": len(kept)})
    assert len(kept) == 7
    for frame_id in kept:
        assert fleet.ask("GET", f"/v1/maps/hall/frames/{frame_id}").json()["state"] == "indexed"
    assert len(fleet.log("worker ready")) == 1  # it waited, and was not replaced
    assert fleet.log("worker died") == []
    assert fleet.process.poll() is None
