"""Tests that changes, events and audit entries stay consistent after kills and on a full disk."""

from __future__ import annotations

import random
import resource
import threading
from collections import Counter
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from sqlalchemy import select

from benchmarks.waiting import PATIENCE_S
from sceneprint.formats.dataset import write_depth_png
from sceneprint.store.database import Database, reach_database
from sceneprint.store.tables import audit, events, frames, pending_events

CAMERA = '{"intrinsics": {"width": 16, "height": 16, "fx": 16, "fy": 16, "cx": 8, "cy": 8}}'
#: Changes that are acknowledged between two faults, at least and at most.
CHANGES = 1, 12
ROBOTS = 3
#: Seconds after which a robot tries again to reach a service that is not there.
PAUSE_S = 0.02


@dataclass
class Ledger:
    """What the robots sent, and what was acknowledged.

    Parameters
    ----------
    url : of the service that runs now
    requests : ids of the requests that were sent for each change, until one was acknowledged
    done : changes that were acknowledged
    stop : set to end the robots
    faults : answers that no robot should get
    """

    url: str = ""
    requests: dict[str, list[str]] = field(default_factory=dict)
    done: set[str] = field(default_factory=set)
    stop: threading.Event = field(default_factory=threading.Event)
    faults: list[str] = field(default_factory=list)


class Robot(threading.Thread):
    """Uploads frames, edits each and deletes every other one, again until it is acknowledged."""

    def __init__(self, name: str, seed: int, folder: Path, ledger: Ledger) -> None:
        super().__init__(name=name, daemon=True)
        self._rng, self._file = np.random.default_rng(seed), folder / f"{name}.png"
        self._ledger = ledger
        self._client = httpx.Client(timeout=PATIENCE_S, trust_env=False)

    def run(self) -> None:
        number = 0
        while not self._ledger.stop.is_set():
            number += 1
            depth = 1 + self._rng.random((16, 16), dtype=np.float32)
            write_depth_png(self._file, depth, 1000.0)
            frame = f"{self.name}-{number}"
            upload = {"frame": ("frame.png", self._file.read_bytes())}
            self._change("PUT", frame, files=upload, data={"meta": CAMERA})
            self._change("PATCH", frame, json={"tags": ["seen"]})
            if number % 2:
                self._change("DELETE", frame)
        self._client.close()

    def _change(self, method: str, frame: str, **content: Any) -> None:
        change = f"{method} {frame}"
        sent = self._ledger.requests.setdefault(change, [])
        while True:
            sent.append(f"{method}-{frame}-{len(sent)}")
            try:
                answer = self._client.request(
                    method, f"{self._ledger.url}/v1/maps/hall/frames/{frame}",
                    headers={"X-Request-Id": sent[-1]}, **content,
                )  # fmt: skip
            except httpx.TransportError:
                if self._ledger.stop.wait(PAUSE_S) and self._ledger.faults:
                    return  # the test has failed, and there is no service
                continue
            # a deletion whose answer was lost is done
            if answer.is_success or (method == "DELETE" and answer.status_code == 404):
                self._ledger.done.add(change)
                return
            if answer.status_code not in (500, 503, 507):
                self._ledger.faults.append(f"{change}: {answer.text}")
                return


def check(database: Database, ledger: Ledger) -> None:
    """Compare changes, events and lines of the audit log one by one."""
    with database.read() as connection:
        lines = connection.execute(select(audit)).all()
        found = [
            (one.kind, one.map, one.frame_id)
            for table in (events, pending_events)
            for one in connection.execute(select(table))
        ]
        rows = connection.execute(select(frames.c.id, frames.c.state)).all()
    written = Counter(one.request_id for one in lines)
    assert Counter((one.action, one.map, one.target) for one in lines) == Counter(found)
    assert max(Counter(found).values()) == max(written.values()) == 1
    effects = {name: sum(written[one] for one in ids) for name, ids in ledger.requests.items()}
    assert {name: effects[name] for name in ledger.done} == dict.fromkeys(ledger.done, 1)
    assert {frame for kind, _, frame in found if kind == "frame.received"} == {
        row.id for row in rows
    }
    assert {frame for kind, _, frame in found if kind == "frame.deleted"} == {
        row.id for row in rows if row.state == "deleted"
    }


@pytest.fixture
def ledger(tmp_path: Path) -> Any:
    ledger = Ledger()
    robots = [Robot(f"robot{i}", i, tmp_path, ledger) for i in range(ROBOTS)]
    yield ledger, robots
    ledger.faults.append("the end")
    ledger.stop.set()
    for one in robots:
        one.join(PATIENCE_S)


def run_until_killed(
    server: Any, ledger: Ledger, robots: list[Robot], rng: random.Random, until: Callable[..., Any]
) -> None:
    """Kill a service in the middle of what it does, sometimes when its disk was full before."""
    ledger.url = server.url
    for one in robots:
        if not one.is_alive():
            one.start()
    wanted = len(ledger.done) + rng.randint(*CHANGES)
    until(lambda: len(ledger.done) >= wanted or ledger.faults)
    assert ledger.faults == []
    if rng.random() < 0.5:
        largest = rng.randrange(1, 200_000)
        resource.prlimit(server.process.pid, resource.RLIMIT_FSIZE, (largest, -1))
        before = sum(map(len, ledger.requests.values()))
        until(lambda: sum(map(len, ledger.requests.values())) >= before + 9)
        resource.prlimit(server.process.pid, resource.RLIMIT_FSIZE, (-1, -1))
        wanted = len(ledger.done) + 1
        until(lambda: len(ledger.done) >= wanted)
    server.kill()


@pytest.mark.thorough
@pytest.mark.parametrize("kills", [4, pytest.param(100, marks=pytest.mark.thorough)])
@pytest.mark.parametrize("kind", ["sqlite", "postgresql"])
def test_no_kill_separates_a_change_its_event_and_its_line(
    kind: str, kills: int, begin: Any, until: Any, tmp_path: Path, ledger: Any,
    request: pytest.FixtureRequest,
) -> None:  # fmt: skip
    data, rng = tmp_path / "data", random.Random(kills)
    url = f"sqlite:///{data}/sceneprint.db"
    settings: dict[str, Any] = {"tenant_requests_per_s": 0}
    if kind == "postgresql":
        url = settings["database_url"] = request.getfixturevalue("postgres_url")
        (data / "blobs").mkdir(parents=True)  # of a database that is there, they should be too
    book, robots = ledger
    server = begin("--workers", "0", folder=data, **settings)
    made = server.client.post("/v1/maps", json={"name": "hall", "model": "depth"})
    assert made.status_code == 201
    for _ in range(kills):
        run_until_killed(server, book, robots, rng, until)
        server = begin("--workers", "0", folder=data, **settings)
    book.url = server.url
    book.stop.set()
    for one in robots:
        one.join(PATIENCE_S)
    assert book.faults == []
    assert len(book.done) >= kills
    with closing(reach_database(url)) as database:
        check(database, book)
