"""Clients of a soak: robots that replay walks, readers that search, and event listeners."""

from __future__ import annotations

import random
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, field
from itertools import cycle
from pathlib import Path
from typing import Any

import httpx

from benchmarks.soak.failover_client import PAUSE_S, SILENCE_S, FailoverClient, RequestLog, bearer
from benchmarks.soak.recordings import Shot
from sceneprint.engine.upkeep.purge import REASON
from sceneprint_client import Client, Spool, errors
from sceneprint_client.api import Added
from sceneprint_client.http import StreamPosition, frame_form

#: Intervals of uploads that are followed by a query, and by the deletion of the frame.
QUERY_EVERY, DELETE_EVERY = 5, 10
#: Number of matches of an exact search, and pause between two searches of a reader, seconds.
K, SEARCH_S = 20, 0.1
#: Time limit of a robot that was offline to send all its frames, seconds.
OFFLINE_PATIENCE_S = 600.0
_AWAY = (errors.Unreachable, errors.Busy, errors.RateLimited)


@dataclass(frozen=True)
class Acknowledged:
    """An acknowledged frame, and the time of its first upload by `time.monotonic`."""

    frame_id: str
    map_name: str
    shot: Shot
    begun: float


@dataclass(frozen=True)
class Search:
    """An exact search for the neighbours of a stored frame.

    Parameters
    ----------
    matches : ids and distances in the order of the answer
    begun, answered : times by `time.monotonic`
    """

    frame_id: str
    matches: Sequence[tuple[str, int]]
    begun: float
    answered: float


@dataclass
class Ledger:
    """Acknowledgements and answers of the service; shared by all clients.

    Parameters
    ----------
    frames : acknowledged uploads
    deleted : times at which the deletion of a frame was sent and acknowledged
    queries : number of answered queries
    """

    lock: threading.Lock = field(default_factory=threading.Lock)
    frames: list[Acknowledged] = field(default_factory=list)
    deleted: dict[str, tuple[float, float]] = field(default_factory=dict)
    searches: list[Search] = field(default_factory=list)
    queries: int = 0


@dataclass(frozen=True, eq=False)
class Robot:
    """A robot that uploads a walk with its key, starting `begins_s` seconds after the run."""

    number: int
    name: str
    map_name: str
    key: str
    walk: Sequence[Shot]
    begins_s: float


class SoakThread(threading.Thread):
    """A client in its own thread; its failure counts as a fault of the run."""

    def __init__(self, name: str, log: RequestLog) -> None:
        super().__init__(name=name, daemon=True)
        self._log = log

    def run(self) -> None:
        """Work until the run ends."""
        try:
            self.work()
        except Exception as error:  # the failure of a client does not stop the others
            self._log.faults.append(f"{self.name}: {type(error).__name__}: {error}")

    def work(self) -> None:
        """Do the work of the client."""
        raise NotImplementedError

    def finish(self, seconds: float) -> None:
        """Wait for the end of the thread; a timeout is a fault."""
        self.join(max(seconds, 0.0))
        if self.is_alive():
            self._log.faults.append(f"{self.name} does not end")


def image_query(shot: Shot, **options: str) -> dict[str, Any]:
    """Return the arguments of a request that queries the place of a frame."""
    sent = frame_form(shot.png, shot.meta.model_copy(update={"pose": None}))
    sent["data"].update(options)
    return sent


class Driver(SoakThread):
    """A thread that drives several robots in turn.

    Parameters
    ----------
    robots : robots in the order in which they start
    rate : frames per second of each robot
    ledger, log : records that clients share
    stop : event that ends the walks; a sent request is repeated until it is answered
    deletes, signed : whether robots delete frames, and wait until frames are signed
    """

    def __init__(
        self, robots: Sequence[Robot], rate: float, client: FailoverClient, ledger: Ledger,
        log: RequestLog, stop: threading.Event, *, deletes: bool, signed: bool,
    ) -> None:  # fmt: skip
        super().__init__(f"driver of {robots[0].name}", log)
        self._robots, self._rate, self._client = robots, rate, client
        self._ledger, self._stop_walks, self._deletes = ledger, stop, deletes
        self._wait = {"Prefer": "wait=50"} if signed else {}

    def work(self) -> None:
        """Send the frames of all robots at their times."""
        begun = time.monotonic()
        with self._client:
            for number in range(max(len(robot.walk) for robot in self._robots)):
                for robot in self._robots:
                    after, now = robot.begins_s + number / self._rate, time.monotonic()
                    begun = max(begun, now - after)  # late robots keep their rate
                    if self._stop_walks.wait(begun + after - now):
                        return
                    if number < len(robot.walk):
                        self._visit(robot, number)

    def _visit(self, robot: Robot, number: int) -> None:
        """Upload a frame, and at intervals query or delete it."""
        client, ledger = self._client, self._ledger
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
        ledger.frames.append(Acknowledged(frame_id, robot.map_name, shot, begun))
        place = robot.number + number
        if place % QUERY_EVERY == QUERY_EVERY - 1:
            query = image_query(shot, k="1")
            response = client.send("query", "POST", f"{path}/queries", headers=key, **query)
            with ledger.lock:
                ledger.queries += response.is_success
        if self._deletes and place % DELETE_EVERY == 3:
            begun = time.monotonic()
            client.send("delete", "DELETE", f"{path}/frames/{frame_id}", headers=key)
            ledger.deleted[frame_id] = begun, time.monotonic()


class OfflineRobot(SoakThread):
    """A robot that spools its frames while it is offline, and then uploads them.

    Parameters
    ----------
    file : path of the spool
    offline_s : duration without a network, seconds
    urls : addresses of the services
    ledger, log : records that clients share
    """

    def __init__(
        self, robot: Robot, file: Path, offline_s: float, urls: Sequence[str], ledger: Ledger,
        log: RequestLog,
    ) -> None:  # fmt: skip
        super().__init__(robot.name, log)
        self._robot, self._file, self._offline_s, self._urls = robot, file, offline_s, urls
        self._ledger = ledger
        #: Number of frames that were sent again because no answer arrived.
        self.repeated = 0

    def work(self) -> None:
        """Spool, wait, send, and record the ids of the stored frames."""
        begun = time.monotonic()
        with Spool(self._file) as spool:
            for number, shot in enumerate(self._robot.walk):
                own = {"robot": self.name, "session": self.name, "name": f"{self.name}-{number}"}
                spool.add(shot.png, shot.meta.model_copy(update=own))
            time.sleep(max(begun + self._offline_s - time.monotonic(), 0.0))
            self._try_each(lambda client: self._sync(spool, client))
            left, refused = spool.status().waiting, spool.refusals()
        if left or refused:
            self._log.faults.append(f"{self.name}: {left} frames wait, refused: {refused[:3]}")
        self._try_each(self._note_ids)

    def _try_each(self, do: Callable[[Client], bool]) -> None:
        """Try an action at one address after the other until it succeeds."""
        end = time.monotonic() + OFFLINE_PATIENCE_S
        for url in cycle(self._urls):
            with Client(url, self._robot.key, timeout_s=SILENCE_S) as client, suppress(*_AWAY):
                if do(client) or time.monotonic() > end:
                    return
            time.sleep(PAUSE_S)

    def _sync(self, spool: Spool, client: Client) -> bool:
        self.repeated += spool.sync(client, self._robot.map_name).there
        return not spool.status().waiting

    def _note_ids(self, client: Client) -> bool:
        """Record the ids of stored frames; a frame that is not stored gets an unknown id."""
        robot = self._robot
        ids = {frame.name: frame.frame_id for frame in client.frames(robot.map_name)}
        for number, shot in enumerate(robot.walk):
            frame_id = ids.get(f"{self.name}-{number}", f"never-came-{number}")
            frame = Acknowledged(frame_id, robot.map_name, shot, time.monotonic())
            self._ledger.frames.append(frame)
        return True


class Reader(SoakThread):
    """A client that repeats exact searches for the neighbours of permanent frames.

    Parameters
    ----------
    key, map_name : key of the reader, and name of the map
    stable : ids of the permanent frames
    ledger, log, stop : records that clients share, and event that ends the searches
    """

    def __init__(
        self, key: str, map_name: str, stable: Sequence[str], client: FailoverClient,
        ledger: Ledger, log: RequestLog, stop: threading.Event, seed: int,
    ) -> None:  # fmt: skip
        super().__init__(f"reader-{seed}", log)
        self._key, self._map, self._stable, self._client = key, map_name, stable, client
        self._ledger, self._stop_event, self._rng = ledger, stop, random.Random(seed)

    def work(self) -> None:
        """Search until the run ends."""
        with self._client:
            while not self._stop_event.wait(SEARCH_S):
                frame_id, begun = self._rng.choice(self._stable), time.monotonic()
                query = {"frame_id": frame_id, "stages": ["retrieve"], "exact": True, "k": K}
                response = self._client.send(
                    "search", "POST", f"/v1/maps/{self._map}/queries", headers=bearer(self._key),
                    json=query | {"keep": False},
                )  # fmt: skip
                if response.is_success:
                    matches = [(m["frame_id"], m["distance"]) for m in response.json()["matches"]]
                    search = Search(frame_id, matches, begun, time.monotonic())
                    self._ledger.searches.append(search)


class Listener(SoakThread):
    """A listener to all events of a map; after a broken stream it continues at another address.

    `log`: log that clients share.
    """

    def __init__(self, map_name: str, key: str, client: FailoverClient, log: RequestLog) -> None:
        super().__init__(f"listener of {map_name}", log)
        self.map_name = map_name
        self._key, self._client = key, client
        self._ending = threading.Event()
        #: Number of times that each event was received, by kind and frame.
        self.heard: Counter[tuple[str, str | None]] = Counter()
        #: Time by `time.monotonic` at which the event of a deletion by retention was received.
        self.retired: dict[str | None, float] = {}

    def stop(self) -> None:
        """Stop listening."""
        self._ending.set()

    def work(self) -> None:
        """Listen until `stop` is called."""
        place = StreamPosition("0")  # starts with the oldest stored event
        with self._client:
            for client in cycle(self._client.clients):
                with suppress(httpx.TransportError):  # the service was killed, or is not ready yet
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
            for line in response.iter_lines():
                if (event := place.read(line)) is None:
                    continue
                self.heard[event.kind, event.frame_id] += 1
                if event.kind == "frame.deleted" and event.data.get("reason") == REASON:
                    self.retired.setdefault(event.frame_id, time.monotonic())
                if self._ending.is_set():
                    return
