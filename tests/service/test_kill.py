"""Tests that kills of service and worker during uploads lose no data."""

from __future__ import annotations

import hashlib
import os
import random
import signal
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import httpx
import pytest
from sqlalchemy.exc import OperationalError

from benchmarks.waiting import PATIENCE_S
from sceneprint.settings import Settings
from sceneprint_client.api import NewMap
from tests.whole_engine import Engine

#: Frames that a robot may send for each kill.
FRAMES_A_KILL = 4


class Uploader(threading.Thread):
    """A robot that sends its frames one after the other, each until it is acknowledged.

    It sends as many as it has leave for, so that the run lasts as long as the kills do.
    """

    def __init__(self, forms: list[dict[str, Any]]) -> None:
        super().__init__(name="uploader", daemon=True)
        self.forms, self.url, self.retries = forms, "", 0
        self.leave = threading.Semaphore(0)
        self.acknowledged: dict[str, int] = {}
        self.statuses: list[int] = []

    def run(self) -> None:
        with httpx.Client(timeout=PATIENCE_S, trust_env=False) as client:
            for number, form in enumerate(self.forms):
                self.leave.acquire()
                while not self.sent(client, number, form):
                    self.retries += 1
                    time.sleep(0.02)

    def sent(self, client: httpx.Client, number: int, form: dict[str, Any]) -> bool:
        try:
            answer = client.post(f"{self.url}/v1/maps/hall/frames", **form)
        except (httpx.TransportError, httpx.UnsupportedProtocol):
            return False
        self.statuses.append(answer.status_code)
        if answer.status_code not in (200, 202):
            return False
        self.acknowledged[answer.json()["frame_id"]] = number
        return True


@pytest.fixture
def done(rows: Callable[..., list[tuple[Any, ...]]], tmp_path: Path) -> Callable[[], int]:
    def count() -> int:
        with suppress(OperationalError):  # locked, or not there yet
            return int(rows(tmp_path, "SELECT count(*) FROM jobs WHERE state = 'succeeded'")[0][0])
        return 0

    return count


@pytest.mark.parametrize("kills", [3, pytest.param(9, marks=pytest.mark.thorough)])
def test_no_kill_loses_what_was_acknowledged(
    kills, begin, small_shots, tmp_path, capsys, until, rows, done
):
    rng, n_frames = random.Random(20), FRAMES_A_KILL * kills
    uploader = Uploader([shot.form(robot="r1") for shot in small_shots[:n_frames]])
    with Engine(Settings(data_dir=tmp_path, database_url=None)) as engine:
        engine.create_map(NewMap(name="hall", model="depth"))
    # a third each: while it starts, while it receives, while it signs
    moments = [("starts", "receives", "signs")[i % 3] for i in range(kills)]
    rng.shuffle(moments)
    uploader.start()
    in_hand = 0
    for moment in moments:
        for _ in range(FRAMES_A_KILL):
            uploader.leave.release()
        server = begin(folder=tmp_path, wait=moment != "starts", job_lease_s=1)
        uploader.url = server.url
        if moment == "starts":
            time.sleep(rng.uniform(0.2, 3))
        elif moment == "receives":
            known = len(uploader.acknowledged)
            wanted = rng.randint(0, 3)
            until(lambda n=known + wanted: len(uploader.acknowledged) >= min(n, n_frames))
            time.sleep(rng.uniform(0, 0.03))
        else:  # some progress, however little, or the run would never end
            before = done()
            received = int(rows(tmp_path, "SELECT count(*) FROM jobs")[0][0])
            goal = min(before + rng.randint(1, 8), received)
            until(lambda n=goal: done() >= n)
            time.sleep(rng.uniform(0, 0.15))
        os.killpg(server.process.pid, signal.SIGKILL)
        server.process.wait()
        server.gone()
        in_hand += len(rows(tmp_path, "SELECT 1 FROM jobs WHERE state = 'running'"))

    server = begin(folder=tmp_path, job_lease_s=1)
    uploader.url = server.url
    until(lambda: not uploader.is_alive())
    pending = "SELECT 1 FROM jobs WHERE state IN ('queued', 'running') LIMIT 1"
    until(lambda: not rows(tmp_path, pending))

    acknowledged = uploader.acknowledged
    told = server.client.get("/v1/maps/hall/frames", params={"limit": 1000}).json()["items"]
    attempts = [row[0] for row in rows(tmp_path, "SELECT attempts FROM jobs")]
    files = {path.name: path for path in (tmp_path / "blobs").rglob("*") if path.is_file()}
    referred = {row[0] for row in rows(
        tmp_path, "SELECT blob FROM frames UNION SELECT geometry FROM signatures"
    )}  # fmt: skip
    with capsys.disabled():
        print(  # noqa: T201
            f"\n{kills} kills: {len(acknowledged)} acknowledged, {len(told)} stored, "
            f"{uploader.retries} retries, {uploader.statuses.count(200)} were there already, "
            f"{in_hand} were in hand when killed, at most {max(attempts)} tries, "
            f"{len(set(files) - referred)} files that nothing refers to"
        )

    assert {one["frame_id"]: one["state"] for one in told} == dict.fromkeys(acknowledged, "indexed")
    assert sorted(acknowledged.values()) == list(range(n_frames))
    assert len({one["content_id"] for one in told}) == n_frames
    assert set(uploader.statuses) <= {200, 202}
    signed = rows(tmp_path, "SELECT frame_number, count(*) FROM signatures GROUP BY frame_number")
    numbers = [row[0] for row in rows(tmp_path, "SELECT number FROM frames")]
    assert sorted(signed) == [(number, 1) for number in sorted(numbers)]
    assert rows(tmp_path, "SELECT DISTINCT state FROM jobs") == [("succeeded",)]
    assert len(attempts) == n_frames
    assert max(attempts) <= 3
    revisions = [row[0] for row in rows(tmp_path, "SELECT revision FROM frames ORDER BY 1")]
    assert revisions == list(range(1, n_frames + 1))
    for blob in referred:
        assert hashlib.sha256(files[blob].read_bytes()).hexdigest() == blob

    near = 0
    for frame_id, number in acknowledged.items():
        asked = {"frame_id": frame_id, "exact": True, "stages": ["retrieve"], "k": 5}
        answer = server.client.post("/v1/maps/hall/queries", json=asked).json()
        assert answer["counts"]["compared"] == n_frames - 1
        found = [acknowledged[match["frame_id"]] // 16 for match in answer["matches"]]
        near += number // 16 in found  # another sampling of the same view
    assert near == n_frames
