"""Robots of the fleet: each replays a walk, asks where it is, and listens to what becomes of it.

Robot  --acknowledged-->  Ledger  <--heard--  Listener
"""

from __future__ import annotations

import threading
import time
from collections import Counter
from contextlib import closing, suppress
from dataclasses import dataclass, field
from itertools import cycle
from typing import Any

import httpx

from benchmarks.fleet.failover_client import PAUSE_S, FailoverClient, RequestLog, Unreachable
from benchmarks.fleet.recordings import Shot
from sceneprint_client.api import Added, Answer
from sceneprint_client.http import StreamPosition, frame_form, read_events

#: Of so many uploads one is followed by a query.
ASK_EVERY = 5
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
    at : when, time of `time.monotonic`
    """

    frame_id: str
    map_name: str
    shot: Shot
    at: float


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


class Robot(threading.Thread):
    """One that uploads a walk at a rate.

    Parameters
    ----------
    name : of the robot
    map_name : that it uploads to
    walk : its frames
    rate : frames a second
    client : the service
    ledger, log : shared with the others
    stop : ends the walk
    """

    def __init__(
        self, name: str, map_name: str, walk: list[Shot], rate: float, client: FailoverClient,
        ledger: Ledger, log: RequestLog, stop: threading.Event,
    ) -> None:  # fmt: skip
        super().__init__(name=name, daemon=True)
        self._map, self._walk, self._rate = map_name, walk, rate
        self._client, self._ledger, self._log = client, ledger, log
        self._ending = stop

    def run(self) -> None:
        """Walk to the end, or until told to stop; what was begun is sent until it is answered."""
        due = time.monotonic()
        try:
            with self._client:
                for number, shot in enumerate(self._walk):
                    if self._ending.wait(max(due - time.monotonic(), 0.0)):
                        return
                    self._upload(number, shot)
                    if number % ASK_EVERY == ASK_EVERY - 1:
                        self._query(shot)
                    due = max(due + 1 / self._rate, time.monotonic())
        except Unreachable as error:
            self._log.fault(str(error))

    def _upload(self, number: int, shot: Shot) -> None:
        meta = shot.meta.model_copy(update={"robot": self.name, "session": self.name})
        response = self._client.ask(
            "upload", "POST", f"/v1/maps/{self._map}/frames",
            headers={"Idempotency-Key": f"{self.name}-{number}"}, **frame_form(shot.png, meta),
        )  # fmt: skip
        if not response.is_success:
            self._log.fault(f"upload: {response.status_code} {response.text:.300}")
            return
        added = Added.model_validate_json(response.content)
        kept = Kept(added.frame_id, self._map, shot, time.monotonic())
        with self._ledger.lock:
            self._ledger.kept.append(kept)

    def _query(self, shot: Shot) -> None:
        response = self._client.ask(
            "query", "POST", f"/v1/maps/{self._map}/queries", **asked(shot, k="1")
        )
        if not response.is_success:
            self._log.fault(f"query: {response.status_code} {response.text:.300}")
            return
        with self._ledger.lock:
            self._ledger.answers[Answer.model_validate_json(response.content).status] += 1


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
    client : the service
    """

    def __init__(self, map_name: str, client: FailoverClient) -> None:
        super().__init__(name=f"listener of {map_name}", daemon=True)
        self.map_name = map_name
        self._client = client
        self._ending = threading.Event()
        #: How often each was heard, by kind and frame.
        self.heard: Counter[tuple[str, str | None]] = Counter()

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
            headers={"Accept": "text/event-stream", "Last-Event-ID": place.last or "0"},
        )  # fmt: skip
        with closing(client.send(request, stream=True)) as response:
            if not response.is_success:
                return
            for event in read_events(response.iter_lines(), place):
                self.heard[event.kind, event.frame_id] += 1
                if self._ending.is_set():
                    return
