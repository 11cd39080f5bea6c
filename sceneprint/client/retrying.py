"""Trying again where that may help: a busy service, a broken connection.

send  --persist-->  the last response, or Unreachable
"""

from __future__ import annotations

import email.utils
import random
import time
from collections.abc import Callable
from datetime import UTC, datetime
from http import HTTPStatus

import httpx

from sceneprint.errors import Unreachable

#: Tries of one call, and seconds after which none is begun: time for a service to start anew.
TRIES, LIMIT_S = 8, 30.0
#: Tries where nobody listens and nobody ever did: an address that is wrong is said soon.
TRIES_UNMET = 2
#: Seconds before the second try; each further one waits about twice as long, up to the longest.
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.25, 5.0

_BUSY = (HTTPStatus.TOO_MANY_REQUESTS, HTTPStatus.SERVICE_UNAVAILABLE)
#: What will not be otherwise the next time.
_HOPELESS = (httpx.UnsupportedProtocol, httpx.LocalProtocolError, httpx.ProxyError)


def persist(
    send: Callable[[], httpx.Response], url: str, *, met: bool
) -> tuple[httpx.Response, int]:
    """Send a request that may be sent twice, until it is answered.

    Parameters
    ----------
    send : does it
    url : of the service, for the message
    met : whether it has answered before

    Returns
    -------
    response : the first that does not ask to come back, or the last
    lost : tries that may have been carried out although no answer came

    Raises
    ------
    Unreachable : no answer came.
    """
    until, lost = time.monotonic() + LIMIT_S, 0
    for tried in range(1, TRIES + 1):
        pause = min(FIRST_PAUSE_S * 2 ** (tried - 1), LONGEST_PAUSE_S) * random.uniform(0.5, 1.5)
        error: httpx.TransportError | None = None
        response: httpx.Response | None = None
        hopeless = tried == TRIES
        try:
            response = send()
        except httpx.TransportError as caught:
            error = caught
            nobody = isinstance(caught, httpx.ConnectError | httpx.ConnectTimeout)
            lost += not nobody
            hopeless |= isinstance(caught, _HOPELESS)
            hopeless |= nobody and not met and tried >= TRIES_UNMET
        if response is not None:
            if response.status_code not in _BUSY:
                return response, lost
            pause = max(pause, retry_after_s(response.headers.get("Retry-After", "")))
        if hopeless or time.monotonic() + pause > until:
            if response is not None:
                return response, lost
            raise unreachable(url, error) from error
        time.sleep(pause)
    raise AssertionError("the last try returns or raises")


def unreachable(url: str, error: Exception | None) -> Unreachable:
    """No answer came, in our words."""
    if isinstance(error, httpx.TimeoutException):
        return Unreachable(
            f"{url} did not answer in time ({type(error).__name__}). Look into the service's log, "
            "or give it longer."
        )
    return Unreachable(
        f"{url} cannot be reached ({error}). Check the address and that the service runs; "
        "`sceneprint serve` starts one here."
    )


def retry_after_s(text: str) -> float:
    """Seconds that a header `Retry-After` asks to wait; 0 where it says nothing understood."""
    text = text.strip()
    if text.isascii() and text.isdigit():
        return float(text[:9])
    try:
        when = email.utils.parsedate_to_datetime(text)
    except ValueError:
        return 0.0
    if when.tzinfo is None:
        when = when.replace(tzinfo=UTC)
    return max((when - datetime.now(UTC)).total_seconds(), 0.0)
