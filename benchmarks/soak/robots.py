"""Clients of a run: robots that replay walks, readers that search, and listeners to events."""

from __future__ import annotations

import random
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, field
from heapq import heapify, heappop, heappush
from itertools import cycle
from pathlib import Path
from typing import Any

import httpx

from benchmarks.soak.failover_client import PAUSE_S, SILENCE_S, FailoverClient, RequestLog, bearer
from benchmarks.soak.recordings import Shot
from sceneprint.engine.upkeep.purge import REASON
from sceneprint_client import Client, Spool, errors
from sceneprint_client.api import Added
from sceneprint_client.http import StreamPosition, frame_form, read_events

#: Of so many uploads one is followed by a query, and one by the deletion of its frame.
QUERY_EVERY, DELETE_EVERY = 5, 10
#: Matches that an exact search lists.
K = 20
#: Seconds until a thread without a robot looks for one.
LOOK_S = 0.1
#: Seconds that a robot that was offline may take to send everything.
OFFLINE_PATIENCE_S = 600.0
_AWAY = (errors.Unreachable, errors.Busy, errors.RateLimited)


@dataclass(frozen=True)
class Acknowledged:
    """A frame whose upload was acknowledged.

    Parameters
    ----------
    frame_id, map_name : of the frame
    shot : that was sent
    begun : when it was sent for the first time, of `time.monotonic`
    """

    frame_id: str
    map_name: str
    shot: Shot
    begun: float


@dataclass(frozen=True)
class Search:
    """An exact search for the neighbours of a stored frame.

    Parameters
    ----------
    frame_id : of that frame
    matches : ids and distances, in the order of the answer
    begun, answered : when, of `time.monotonic`
    """

    frame_id: str
    matches: Sequence[tuple[str, int]]
    begun: float
    answered: float


@dataclass
class Ledger:
    """What the service acknowledged and answered; shared by all clients.

    Parameters
    ----------
    frames : acknowledged uploads
    deleted : when the deletion of a frame was sent and acknowledged
    searches : of the readers
    queries : how many were answered
    """

    lock: threading.Lock = field(default_factory=threading.Lock)
    frames: list[Acknowledged] = field(default_factory=list)
    deleted: dict[str, tuple[float, float]] = field(default_factory=dict)
    searches: list[Search] = field(default_factory=list)
    queries: int = 0


@dataclass(frozen=True, eq=False)
class Robot:
    """A robot that uploads a walk.

    Parameters
    ----------
    number, name, key : of the robot
    map_name : that it uploads to
    walk : its frames
    begins_s : seconds until its first frame
    """

    number: int
    name: str
    map_name: str
    key: str
    walk: Sequence[Shot]
    begins_s: float


def image_query(shot: Shot, **options: str) -> dict[str, Any]:
    """Return the arguments of a request that queries where a frame was taken."""
    sent = frame_form(shot.png, shot.meta.model_copy(update={"pose": None}))
    sent["data"].update(options)
    return sent


class RobotCrowd:
    """Robots that a few threads drive: each thread takes the robot whose turn is next.

    Parameters
    ----------
    robots : all of them
    rate : frames a second of each
    clients : of the service, one for each thread
    ledger, log : shared with others
    stop : ends the walks; a request that was sent is repeated until it is answered
    deletes, signed : whether robots delete frames, and wait until frames are signed
    """

    def __init__(
        self, robots: Sequence[Robot], rate: float, clients: Sequence[FailoverClient],
        ledger: Ledger, log: RequestLog, stop: threading.Event, *, deletes: bool, signed: bool,
    ) -> None:  # fmt: skip
        self._rate, self._ledger, self._log, self._stop = rate, ledger, log, stop
        self._robots, self._lock, self._deletes = robots, threading.Lock(), deletes
        self._wait = {"Prefer": "wait=50"} if signed else {}
        self._due: list[tuple[float, int, int]] = []  # when, robot, number of its frame
        self._threads = [
            threading.Thread(target=self._drive, args=(one,), name=f"robots-{i}", daemon=True)
            for i, one in enumerate(clients)
        ]

    def start(self) -> None:
        """Start all walks."""
        now = time.monotonic()
        self._due = [(now + one.begins_s, i, 0) for i, one in enumerate(self._robots)]
        heapify(self._due)
        for thread in self._threads:
            thread.start()

    def join(self, seconds: float) -> None:
        """Wait until all requests are answered; one that takes longer is a fault."""
        until = time.monotonic() + seconds
        for thread in self._threads:
            thread.join(max(until - time.monotonic(), 0.0))
            if thread.is_alive():
                self._log.fault(f"{thread.name} does not end")

    def _drive(self, client: FailoverClient) -> None:
        try:
            with client:
                while (turn := self._next()) is not None:
                    due, i, number = turn
                    robot = self._robots[i]
                    self._visit(client, robot, number)
                    if number + 1 < len(robot.walk):
                        again = max(due + 1 / self._rate, time.monotonic())
                        with self._lock:
                            heappush(self._due, (again, i, number + 1))
        except Exception as error:  # whatever it is, the robots of this thread stop
            self._log.fault(f"{type(error).__name__}: {error}")

    def _next(self) -> tuple[float, int, int] | None:
        """Return whose turn is next, once it is; None at the end."""
        while not self._stop.is_set():
            with self._lock:
                turn = self._due[0] if self._due else None
                if turn is not None and turn[0] <= time.monotonic():
                    return heappop(self._due)
            # another thread may bring one that is due sooner
            wait_s = LOOK_S if turn is None else min(turn[0] - time.monotonic(), LOOK_S)
            self._stop.wait(max(wait_s, 0.0))
        return None

    def _visit(self, client: FailoverClient, robot: Robot, number: int) -> None:
        """Upload a frame, and now and then query or delete it."""
        shot, key, begun = robot.walk[number], bearer(robot.key), time.monotonic()
        meta = shot.meta.model_copy(update={"robot": robot.name, "session": robot.name})
        path = f"/v1/maps/{robot.map_name}"
        response = client.send(
            "upload", "POST", f"{path}/frames", **frame_form(shot.png, meta),
            headers=key | {"Idempotency-Key": f"{robot.name}-{number}"} | self._wait,
        )  # fmt: skip
        if not response.is_success:
            return
        frame_id = Added.model_validate_json(response.content).frame_id
        with self._ledger.lock:
            self._ledger.frames.append(Acknowledged(frame_id, robot.map_name, shot, begun))
        place = robot.number + number
        if place % QUERY_EVERY == QUERY_EVERY - 1:
            sent = image_query(shot, k="1")
            response = client.send("query", "POST", f"{path}/queries", headers=key, **sent)
            with self._ledger.lock:
                self._ledger.queries += response.is_success
        if self._deletes and place % DELETE_EVERY == 3:
            begun = time.monotonic()
            client.send("delete", "DELETE", f"{path}/frames/{frame_id}", headers=key)
            with self._ledger.lock:
                self._ledger.deleted[frame_id] = begun, time.monotonic()


class OfflineRobot(threading.Thread):
    """A robot that spools its frames while it has no network, and then sends all of them.

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
        #: Frames that were sent twice, as an answer did not come.
        self.repeated = 0

    def run(self) -> None:
        """Spool, wait, send, and note under which ids the frames are stored."""
        begun = time.monotonic()
        try:
            with Spool(self._file) as spool:
                for number, shot in enumerate(self._robot.walk):
                    spool.add(shot.png, shot.meta.model_copy(update=self._names(number)))
                time.sleep(max(begun + self._offline_s - time.monotonic(), 0.0))
                self._try_each(lambda client: self._sync(spool, client))
                left, refused = spool.status().waiting, spool.refusals()
            if left or refused:
                self._log.fault(f"{self.name}: {left} frames wait, refused: {refused[:3]}")
            self._try_each(self._note_ids)
        except Exception as error:  # whatever it is, the spool was not sent
            self._log.fault(f"{self.name}: {type(error).__name__}: {error}")

    def _names(self, number: int) -> dict[str, str]:
        return {"robot": self.name, "session": self.name, "name": f"{self.name}-{number}"}

    def _try_each(self, do: Callable[[Client], bool]) -> None:
        """Do something at one address after the other, until it is done."""
        until = time.monotonic() + OFFLINE_PATIENCE_S
        for url in cycle(self._urls):
            with Client(url, self._robot.key, timeout_s=SILENCE_S) as client, suppress(*_AWAY):
                if do(client) or time.monotonic() > until:
                    return
            time.sleep(PAUSE_S)

    def _sync(self, spool: Spool, client: Client) -> bool:
        self.repeated += spool.sync(client, self._robot.map_name).there
        return not spool.status().waiting

    def _note_ids(self, client: Client) -> bool:
        """Note what is stored; a frame that was spooled and is not stored is missing for good."""
        found = {one.name: one.frame_id for one in client.frames(self._robot.map_name)}
        now = time.monotonic()
        with self._ledger.lock:
            self._ledger.frames += [
                Acknowledged(
                    found.get(f"{self.name}-{number}", f"never-came-{number}"),
                    self._robot.map_name, shot, now,
                )
                for number, shot in enumerate(self._robot.walk)
            ]  # fmt: skip
        return True


class Reader(threading.Thread):
    """A client that repeats exact searches for the neighbours of frames that stay.

    Parameters
    ----------
    key, map_name : of the reader
    stable : ids of the frames that stay
    client : of the service
    ledger, stop : shared with others
    """

    def __init__(
        self, key: str, map_name: str, stable: Sequence[str], client: FailoverClient,
        ledger: Ledger, stop: threading.Event, seed: int,
    ) -> None:  # fmt: skip
        super().__init__(name="reader", daemon=True)
        self._key, self._map, self._stable, self._client = key, map_name, stable, client
        self._ledger, self._stop_event, self._rng = ledger, stop, random.Random(seed)

    def run(self) -> None:
        """Search until the run ends; a request that fails is in the log."""
        with self._client as client:
            while not self._stop_event.wait(LOOK_S):
                frame_id, begun = self._rng.choice(self._stable), time.monotonic()
                query = {"frame_id": frame_id, "stages": ["retrieve"], "exact": True, "k": K}
                response = client.send(
                    "search", "POST", f"/v1/maps/{self._map}/queries", headers=bearer(self._key),
                    json=query | {"keep": False},
                )  # fmt: skip
                if response.is_success:
                    found = [(m["frame_id"], m["distance"]) for m in response.json()["matches"]]
                    search = Search(frame_id, found, begun, time.monotonic())
                    with self._ledger.lock:
                        self._ledger.searches.append(search)


class Listener(threading.Thread):
    """A listener to all events of a map, who takes up the stream elsewhere when it breaks.

    Parameters
    ----------
    map_name : whose events
    key : of the listener
    client : of the service
    """

    def __init__(self, map_name: str, key: str, client: FailoverClient) -> None:
        super().__init__(name=f"listener of {map_name}", daemon=True)
        self.map_name = map_name
        self._key, self._client = key, client
        self._ending = threading.Event()
        #: How often each event was heard, by kind and frame.
        self.heard: Counter[tuple[str, str | None]] = Counter()
        #: When retention was heard to have deleted a frame, of `time.monotonic`.
        self.retired: dict[str | None, float] = {}

    def stop(self) -> None:
        """Stop listening."""
        self._ending.set()

    def run(self) -> None:
        """Listen until `stop`."""
        place = StreamPosition("0")  # all that is stored
        with self._client:
            for client in cycle(self._client.clients):
                with suppress(httpx.TransportError):  # it was killed, or is not ready yet
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
