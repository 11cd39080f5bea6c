"""The addresses of a fleet's service, of which one answers unless none does.

FailoverClient.ask  --each address in turn-->  the first answer that is not "come back"
"""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, field
from itertools import cycle
from types import TracebackType
from typing import Any

import httpx

from sceneprint_client.http import retry_after_s

#: Seconds before the addresses are asked again, once each has refused.
PAUSE_S = 0.25
#: Seconds after which a silent address is taken to be dead.
SILENCE_S = 20.0
#: Seconds after which nobody is believed to come back.
PATIENCE_S = 180.0
#: Answers that ask to come back.
_LATER = (429, 503)


class Unreachable(Exception):
    """No address answered, for very long."""


@dataclass(frozen=True)
class Wait:
    """A request that had to be sent more than once; times of `time.monotonic`."""

    kind: str
    begun: float
    answered: float

    @property
    def seconds(self) -> float:
        """For how long the robot had no answer."""
        return self.answered - self.begun


@dataclass
class RequestLog:
    """What the robots met with; shared by all."""

    lock: threading.Lock = field(default_factory=threading.Lock)
    waits: list[Wait] = field(default_factory=list)
    answered: list[tuple[float, str]] = field(default_factory=list)
    repeated: int = 0
    seconds: dict[str, list[float]] = field(default_factory=dict)
    faults: list[str] = field(default_factory=list)

    def note(self, kind: str, begun: float, *, tries: int) -> None:
        """A request is answered."""
        now = time.monotonic()
        with self.lock:
            self.answered.append((now, kind))
            self.seconds.setdefault(kind, []).append(now - begun)
            self.repeated += tries - 1
            if tries > 1:
                self.waits.append(Wait(kind, begun, now))

    def fault(self, text: str) -> None:
        """Something that should not be."""
        with self.lock:
            self.faults.append(text)


def bearer(key: str) -> dict[str, str]:
    """Headers of a request with a key."""
    return {"Authorization": f"Bearer {key}"}


class FailoverClient:
    """A service at several addresses.

    Parameters
    ----------
    urls : of the service processes
    log : where waits are noted
    first : number of the address that is asked first
    """

    def __init__(self, urls: list[str], log: RequestLog, first: int = 0) -> None:
        self._log = log
        self.clients = [
            httpx.Client(base_url=url, timeout=SILENCE_S, trust_env=False)
            for url in urls[first % len(urls) :] + urls[: first % len(urls)]
        ]
        self._order = cycle(self.clients)
        self._open = next(self._order)

    def __enter__(self) -> FailoverClient:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:  # fmt: skip
        for client in self.clients:
            client.close()

    def ask(self, kind: str, method: str, path: str, **request: Any) -> httpx.Response:
        """Send what may be sent twice until it is answered, whoever of them answers.

        Parameters
        ----------
        kind : of the request, for the log
        method, path, request : as for httpx

        Raises
        ------
        Unreachable : nobody did, for very long.
        """
        begun, tries = time.monotonic(), 0
        while time.monotonic() < begun + PATIENCE_S:
            tries += 1
            pause = 0.0
            try:
                response = self._open.request(method, path, **request)
            except httpx.TransportError:
                pass  # killed, or not begun yet
            else:
                if response.status_code < 500 and response.status_code not in _LATER:
                    self._log.note(kind, begun, tries=tries)
                    return response
                if response.status_code not in _LATER:
                    self._log.fault(f"{kind}: {response.status_code} {response.text:.300}")
                pause = min(retry_after_s(response.headers.get("Retry-After", "")), 1.0)
            self._open = next(self._order)
            if tries % len(self.clients) == 0:
                time.sleep(max(PAUSE_S, pause))
        raise Unreachable(f"{kind}: nobody answered for {PATIENCE_S:g} s")
