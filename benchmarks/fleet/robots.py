"""Robots of the fleet, each of which replays a walk and asks where it is; and who hears of it.

Crowd of Robots, OfflineRobot  --acknowledged-->  Ledger  <--heard--  Listener
"""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, field
from heapq import heapify, heappop, heappush
from itertools import cycle
from pathlib import Path
from typing import Any

import httpx

from benchmarks.fleet.failover_client import (
    PAUSE_S,
    FailoverClient,
    RequestLog,
    bearer,
)
from benchmarks.fleet.recordings import Shot
from sceneprint.engine.upkeep.purge import REASON
from sceneprint_client import Client, Spool, errors
from sceneprint_client.api import Added, Answer
from sceneprint_client.http import StreamPosition, frame_form, read_events

#: Of so many uploads one is followed by a query.
ASK_EVERY = 5
#: Seconds until a thread without a robot looks again.
LOOK_S = 0.1
#: Seconds that a robot that was offline may take to send everything.
OFFLINE_PATIENCE_S = 600.0
#: Seconds of silence after which a stream of events is taken to be dead.
SILENCE_S = 20.0


@dataclass(frozen=True)
class Kept:
    """A frame that was acknowledged.

    Parameters
    ----------
    frame_id : of it
    map_name : of its map
    shot : that was sent
    begun : when it was sent for the first time, of `time.monotonic`
    """

    frame_id: str
    map_name: str
    shot: Shot
    begun: float


@dataclass
class Ledger:
    """What the robots were told; shared by all.

    Parameters
    ----------
    kept : all that was acknowledged
    answers : queries by status
    """

    lock: threading.Lock = field(default_factory=threading.Lock)
    kept: list[Kept] = field(default_factory=list)
    answers: Counter[str] = field(default_factory=Counter)


@dataclass(frozen=True, eq=False)
class Robot:
    """One that uploads a walk at a rate.

    Parameters
    ----------
    number, name : of the robot
    map_name : that it uploads to
    key : that it has
    walk : its frames
    begins_s : seconds until its first one
    """

    number: int
    name: str
    map_name: str
    key: str
    walk: Sequence[Shot]
    begins_s: float


class Crowd:
    """Robots that a few threads drive: each takes the robot whose turn is next.

    Parameters
    ----------
    robots : all of them
    rate : frames a second of each
    clients : of the service, one for each thread
    ledger, log : shared with others
    stop : ends the walks; what was begun is sent until it is answered
    """

    def __init__(
        self, robots: Sequence[Robot], rate: float, clients: Sequence[FailoverClient],
        ledger: Ledger, log: RequestLog, stop: threading.Event,
    ) -> None:  # fmt: skip
        self._rate, self._ledger, self._log, self._stop = rate, ledger, log, stop
        self._robots, self._lock = robots, threading.Lock()
        self._due: list[tuple[float, int, int]] = []  # when, robot, number of its frame
        self._threads = [
            threading.Thread(target=self._drive, args=(one,), name=f"robots-{i}", daemon=True)
            for i, one in enumerate(clients)
        ]

    def start(self) -> None:
        """Let them walk."""
        now = time.monotonic()
        self._due = [(now + one.begins_s, i, 0) for i, one in enumerate(self._robots)]
        heapify(self._due)
        for thread in self._threads:
            thread.start()

    def join(self, seconds: float) -> None:
        """Wait for the end of what was begun; a robot that does not come to it is a fault."""
        until = time.monotonic() + seconds
        for thread in self._threads:
            thread.join(max(until - time.monotonic(), 0.0))
            if thread.is_alive():
                self._log.fault(f"{thread.name} does not come to its end")

    def _drive(self, client: FailoverClient) -> None:
        try:
            with client:
                while (turn := self._next()) is not None:
                    due, i, number = turn
                    robot = self._robots[i]
                    self._upload(client, robot, number)
                    if (robot.number + number) % ASK_EVERY == ASK_EVERY - 1:
                        self._query(client, robot, number)
                    if number + 1 < len(robot.walk):
                        again = max(due + 1 / self._rate, time.monotonic())
                        with self._lock:
                            heappush(self._due, (again, i, number + 1))
        except Exception as error:  # whatever it is, its robots walk no more
            self._log.fault(f"{type(error).__name__}: {error}")

    def _next(self) -> tuple[float, int, int] | None:
        """Whose turn is next, once it is; None where nobody walks any more."""
        while not self._stop.is_set():
            with self._lock:
                turn = self._due[0] if self._due else None
                if turn is not None and turn[0] <= time.monotonic():
                    return heappop(self._due)
            # another thread may bring one that is due sooner
            wait_s = LOOK_S if turn is None else min(turn[0] - time.monotonic(), LOOK_S)
            self._stop.wait(max(wait_s, 0.0))
        return None

    def _upload(self, client: FailoverClient, robot: Robot, number: int) -> None:
        shot = robot.walk[number]
        meta = shot.meta.model_copy(update={"robot": robot.name, "session": robot.name})
        sent, begun = frame_form(shot.png, meta), time.monotonic()
        response = client.ask(
            "upload", "POST", f"/v1/maps/{robot.map_name}/frames",
            headers=bearer(robot.key) | {"Idempotency-Key": f"{robot.name}-{number}"}, **sent,
        )  # fmt: skip
        if not response.is_success:
            self._log.fault(f"upload: {response.status_code} {response.text:.300}")
            return
        added = Added.model_validate_json(response.content)
        kept = Kept(added.frame_id, robot.map_name, shot, begun)
        with self._ledger.lock:
            self._ledger.kept.append(kept)

    def _query(self, client: FailoverClient, robot: Robot, number: int) -> None:
        response = client.ask(
            "query", "POST", f"/v1/maps/{robot.map_name}/queries", headers=bearer(robot.key),
            **asked(robot.walk[number], k="1"),
        )  # fmt: skip
        if not response.is_success:
            self._log.fault(f"query: {response.status_code} {response.text:.300}")
            return
        with self._ledger.lock:
            self._ledger.answers[Answer.model_validate_json(response.content).status] += 1


class OfflineRobot(threading.Thread):
    """One that has no network at first, and spools its frames; then it sends all of them.

    Parameters
    ----------
    robot : whose walk is spooled at once, as if its time had passed
    file : of the spool
    offline_s : seconds without network
    urls : of the services
    ledger, log : shared with others
    """

    def __init__(
        self, robot: Robot, file: Path, offline_s: float, urls: Sequence[str], ledger: Ledger,
        log: RequestLog,
    ) -> None:  # fmt: skip
        super().__init__(name=robot.name, daemon=True)
        self._robot, self._file, self._offline_s, self._urls = robot, file, offline_s, urls
        self._ledger, self._log = ledger, log
        #: Frames that the service was told twice, as an answer did not come.
        self.there = 0

    def run(self) -> None:
        """Spool, wait, send, and note under which ids the frames are there."""
        begun = time.monotonic()
        try:
            with Spool(self._file) as spool:
                for number, shot in enumerate(self._robot.walk):
                    spool.add(shot.png, shot.meta.model_copy(update=self._named(number)))
                time.sleep(max(begun + self._offline_s - time.monotonic(), 0.0))
                self._send(spool)
                left, refused = spool.status().waiting, spool.refusals()
            if left or refused:
                self._log.fault(f"{self.name}: {left} frames wait, refused: {refused[:3]}")
            self._learn()
        except Exception as error:  # whatever it is, nothing of its spool is looked for
            self._log.fault(f"{self.name}: {type(error).__name__}: {error}")

    def _named(self, number: int) -> dict[str, str]:
        return {"robot": self.name, "session": self.name, "name": f"{self.name}-{number}"}

    def _send(self, spool: Spool) -> None:
        """Send all of it, by one address after the other."""
        until = time.monotonic() + OFFLINE_PATIENCE_S
        for url in cycle(self._urls):
            if time.monotonic() > until or not spool.status().waiting:
                return
            with Client(url, self._robot.key, timeout_s=SILENCE_S) as client:
                try:
                    self.there += spool.sync(client, self._robot.map_name).there
                except (errors.Unreachable, errors.Busy, errors.RateLimited):
                    time.sleep(PAUSE_S)

    def _learn(self) -> None:
        """Note what is there; a frame that was spooled and is not is missing for good."""
        for url in cycle(self._urls):
            with Client(url, self._robot.key, timeout_s=SILENCE_S) as client:
                try:
                    found = {one.name: one.frame_id for one in client.frames(self._robot.map_name)}
                    break
                except (errors.Unreachable, errors.Busy, errors.RateLimited):
                    time.sleep(PAUSE_S)
        now = time.monotonic()
        for number, shot in enumerate(self._robot.walk):
            frame_id = found.get(f"{self.name}-{number}", f"never-came-{number}")
            with self._ledger.lock:
                self._ledger.kept.append(Kept(frame_id, self._robot.map_name, shot, now))


def asked(shot: Shot, **options: str) -> dict[str, Any]:
    """Arguments of a request that asks where a frame was taken."""
    sent = frame_form(shot.png, shot.meta.model_copy(update={"pose": None}))
    sent["data"].update(options)
    return sent


class Listener(threading.Thread):
    """One that hears all events of a map, taking up the stream elsewhere when it breaks.

    Parameters
    ----------
    map_name : whose events
    key : that it has
    client : the service
    """

    def __init__(self, map_name: str, key: str, client: FailoverClient) -> None:
        super().__init__(name=f"listener of {map_name}", daemon=True)
        self.map_name = map_name
        self._key, self._client = key, client
        self._ending = threading.Event()
        #: How often each was heard, by kind and frame.
        self.heard: Counter[tuple[str, str | None]] = Counter()
        #: When retention was heard to have deleted a frame, of `time.monotonic`.
        self.retired: dict[str | None, float] = {}

    def stop(self) -> None:
        """Hear no more."""
        self._ending.set()

    def run(self) -> None:
        """Listen until told to stop."""
        place = StreamPosition("0")  # all that is kept
        with self._client:
            for client in cycle(self._client.clients):
                with suppress(httpx.TransportError):  # it was killed, or is not there yet
                    self._listen(client, place)
                if self._ending.wait(PAUSE_S):
                    return

    def _listen(self, client: httpx.Client, place: StreamPosition) -> None:
        request = client.build_request(
            "GET", "/v1/events", params={"map": self.map_name}, timeout=SILENCE_S,
            headers=bearer(self._key)
            | {"Accept": "text/event-stream", "Last-Event-ID": place.last or "0"},
        )  # fmt: skip
        with closing(client.send(request, stream=True)) as response:
            if not response.is_success:
                return
            for event in read_events(response.iter_lines(), place):
                self.heard[event.kind, event.frame_id] += 1
                if event.kind == "frame.deleted" and event.data.get("reason") == REASON:
                    self.retired.setdefault(event.frame_id, time.monotonic())
                if self._ending.is_set():
                    return
