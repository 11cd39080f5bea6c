"""Client that sends requests to alternative addresses of a service."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from itertools import cycle
from typing import Any

import httpx

from sceneprint_client.http import retry_after_s

#: Delay before the next round of addresses after all have refused, seconds.
PAUSE_S = 0.25
#: Timeout of an address, and of a request at all addresses, seconds.
SILENCE_S, PATIENCE_S = 20.0, 180.0
#: Statuses after which a client retries.
LATER = (429, 503, 507)


class NoAnswer(Exception):
    """No address has answered for too long."""


@dataclass(frozen=True)
class Exchange:
    """An answered request, its number of attempts, and its times by `time.monotonic`."""

    kind: str
    begun: float
    answered: float
    tries: int


@dataclass
class RequestLog:
    """Answered requests, and descriptions of failures; shared by all clients."""

    lock: threading.Lock = field(default_factory=threading.Lock)
    exchanges: list[Exchange] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)


def bearer(key: str) -> dict[str, str]:
    """Return the headers for a request with a key."""
    return {"Authorization": f"Bearer {key}"}


class FailoverClient(ExitStack):
    """A client that tries the next address if an address does not answer or is busy.

    Parameters
    ----------
    urls : addresses of the services
    log : log that clients share
    first : index of the first address to try
    """

    def __init__(self, urls: Sequence[str], log: RequestLog, first: int = 0) -> None:
        super().__init__()
        self._log, first = log, first % len(urls)
        self.clients = [
            self.enter_context(httpx.Client(base_url=url, timeout=SILENCE_S, trust_env=False))
            for url in (*urls[first:], *urls[:first])
        ]
        self._order = cycle(self.clients)
        self._current = next(self._order)

    def send(self, kind: str, method: str, path: str, **request: Any) -> httpx.Response:
        """Send an idempotent request to the addresses until one of them answers.

        Raise NoAnswer if no address has answered for too long.

        Parameters
        ----------
        kind : kind of the request, for the log
        method, path, request : arguments of httpx
        """
        begun, tries = time.monotonic(), 0
        while time.monotonic() < begun + PATIENCE_S:
            tries += 1
            pause = 0.0
            try:
                response = self._current.request(method, path, **request)
            except httpx.TransportError:
                pass  # the service was killed, or has not started yet
            else:
                if response.status_code not in LATER:
                    with self._log.lock:
                        self._log.exchanges.append(Exchange(kind, begun, time.monotonic(), tries))
                    # A repeated deletion whose first answer was lost receives 404.
                    if not response.is_success and (kind, response.status_code) != ("delete", 404):
                        fault = f"{kind}: {response.status_code} {response.text:.300}"
                        self._log.faults.append(fault)
                    return response
                pause = min(retry_after_s(response.headers.get("Retry-After", "")), 1.0)
            self._current = next(self._order)
            if tries % len(self.clients) == 0:
                time.sleep(max(PAUSE_S, pause))
        raise NoAnswer(f"{kind}: no answer for {PATIENCE_S:g} s")
