"""A client of several addresses of a service, of which one answers unless none does."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, field
from itertools import cycle
from types import TracebackType
from typing import Any

import httpx

from sceneprint_client.http import retry_after_s

#: Seconds before the addresses are tried again, once each has refused.
PAUSE_S = 0.25
#: Seconds after which a silent address counts as dead.
SILENCE_S = 20.0
#: Seconds after which a request is given up.
PATIENCE_S = 180.0
#: Statuses after which a client tries again.
LATER = (429, 503, 507)


class NoAnswer(Exception):
    """No address answered, for very long."""


@dataclass(frozen=True)
class Exchange:
    """A request that was answered; times of `time.monotonic`.

    Parameters
    ----------
    kind : of the request
    begun, answered : when
    tries : how often it was sent
    """

    kind: str
    begun: float
    answered: float
    tries: int


@dataclass
class RequestLog:
    """What the robots met with; shared by all."""

    lock: threading.Lock = field(default_factory=threading.Lock)
    exchanges: list[Exchange] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)

    def add(self, exchange: Exchange) -> None:
        """Add a request that was answered."""
        with self.lock:
            self.exchanges.append(exchange)

    def fault(self, text: str) -> None:
        """Add something that must not happen."""
        with self.lock:
            self.faults.append(text)


def bearer(key: str) -> dict[str, str]:
    """Return the headers of a request with a key."""
    return {"Authorization": f"Bearer {key}"}


class FailoverClient:
    """A client that turns to the next address where one is silent or refuses.

    Parameters
    ----------
    urls : of the service processes
    log : shared with others
    first : number of the address that is tried first
    """

    def __init__(self, urls: list[str], log: RequestLog, first: int = 0) -> None:
        self._log = log
        self.clients = [
            httpx.Client(base_url=url, timeout=SILENCE_S, trust_env=False)
            for url in urls[first % len(urls) :] + urls[: first % len(urls)]
        ]
        self._order = cycle(self.clients)
        self._current = next(self._order)

    def __enter__(self) -> FailoverClient:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:  # fmt: skip
        for client in self.clients:
            client.close()

    def send(self, kind: str, method: str, path: str, **request: Any) -> httpx.Response:
        """Send a request that may be repeated, until any address answers it.

        Parameters
        ----------
        kind : of the request, for the log
        method, path, request : as for httpx

        Raises
        ------
        NoAnswer : no address answered, for very long.
        """
        begun, tries = time.monotonic(), 0
        while time.monotonic() < begun + PATIENCE_S:
            tries += 1
            pause = 0.0
            try:
                response = self._current.request(method, path, **request)
            except httpx.TransportError:
                pass  # killed, or not started yet
            else:
                if response.status_code not in LATER:
                    self._log.add(Exchange(kind, begun, time.monotonic(), tries))
                    # 404 answers a deletion whose first answer was lost
                    if not response.is_success and (kind, response.status_code) != ("delete", 404):
                        self._log.fault(f"{kind}: {response.status_code} {response.text:.300}")
                    return response
                pause = min(retry_after_s(response.headers.get("Retry-After", "")), 1.0)
            self._current = next(self._order)
            if tries % len(self.clients) == 0:
                time.sleep(max(PAUSE_S, pause))
        raise NoAnswer(f"{kind}: no answer for {PATIENCE_S:g} s")
