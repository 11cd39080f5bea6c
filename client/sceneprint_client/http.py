"""Requests to one service: sent until they are answered, and read as records or as errors.

send  --persist-->  the last response, or Unreachable
response  --error_of-->  the error that its problem document names
lines  --read_events-->  events, each with the id to go on from  --follow_stream-->  events for ever
"""

from __future__ import annotations

import email.utils
import logging
import os
import random
import ssl
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from dataclasses import dataclass
from datetime import datetime, timezone
from http import HTTPStatus
from typing import Any, Protocol, TypeVar

import httpx
from pydantic import BaseModel, ValidationError

from sceneprint_client import __version__, errors
from sceneprint_client.api import Page, Problem
from sceneprint_client.api.admin import Event
from sceneprint_client.requests import given, is_loopback

Record = TypeVar("Record", bound=BaseModel)
Item = TypeVar("Item")

#: Records a page.
PAGE = 500
#: Tries of one call, and seconds after which none is begun: time for a service to start anew.
TRIES, LIMIT_S = 8, 30.0
#: Tries where nobody listens and nobody ever did: an address that is wrong is said soon.
TRIES_UNMET = 2
#: Seconds before the second try; each further one waits about twice as long, up to the longest.
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.25, 5.0
#: Seconds of silence after which a stream is taken to be dead: it says three times that it lives.
SILENCE_S = 50.0
#: Seconds before a stream that ended is asked for again, unless it said otherwise.
STREAM_PAUSE_S = 1.0

_BUSY = (HTTPStatus.TOO_MANY_REQUESTS, HTTPStatus.SERVICE_UNAVAILABLE)
#: What will not be otherwise the next time.
_HOPELESS = (httpx.UnsupportedProtocol, httpx.LocalProtocolError, httpx.ProxyError)


class LocalWorker(Protocol):
    """Who does the jobs where no other process does."""

    def work(self, pause_s: float) -> None:
        """Do a job, or wait so long where there is none to do."""


class ServiceConnection:
    """A service, and how to ask it; the base of every topic of the client.

    Parameters
    ----------
    url : of it, with http:// or https://
    key : where it asks for one
    timeout_s : longest silence of the service
    transport : what carries the requests; default: the network
    worker : who does the jobs; default: workers of the service

    Raises
    ------
    Unreachable : the address is none.
    """

    def __init__(
        self, url: str, key: str | None, timeout_s: float,
        transport: httpx.BaseTransport | None = None, worker: LocalWorker | None = None,
    ) -> None:  # fmt: skip
        self._url = url.rstrip("/")
        self._timeout_s = timeout_s
        self._worker = worker
        self._met = False  # whether it has ever answered
        headers = {"User-Agent": f"sceneprint-client/{__version__}"}
        if key is not None:
            headers["Authorization"] = f"Bearer {key}"
        try:
            parsed = httpx.URL(self._url)
            if parsed.scheme not in ("http", "https") or not parsed.host:
                raise httpx.InvalidURL("it does not begin with http:// or https://")
            self._http = httpx.Client(
                base_url=self._url,
                headers=headers,
                timeout=timeout_s,
                transport=transport,
                verify=_authorities(parsed),
                # no proxy stands before this machine
                trust_env=transport is None and not is_loopback(parsed.host),
            )
        except (httpx.InvalidURL, UnicodeEncodeError, ValueError) as error:
            raise errors.Unreachable(
                f"{url!r:.200} is not the address of a service, or the key is not one ({error}). "
                "Write it like http://127.0.0.1:8008."
            ) from error
        self._log_filter = RequestLogFilter(self._url)
        logging.getLogger("httpx").addFilter(self._log_filter)

    def close(self) -> None:
        """Close connections and files."""
        logging.getLogger("httpx").removeFilter(self._log_filter)
        self._http.close()

    def _ask(self, kind: type[Record], method: str, path: str, **request: Any) -> Record:
        """What it answers, as a record."""
        return read_record(kind, self._send(method, path, **request))

    def _bytes(self, path: str, **request: Any) -> bytes:
        """What it answers to a GET, as it comes."""
        return self._send("GET", path, **request).content

    def _delete(self, path: str) -> None:
        self._send("DELETE", path)

    def _items(self, kind: type[Page[Item]], path: str, **parameters: Any) -> Iterator[Item]:
        """The items of all pages of a list; the first page is asked for at once."""

        def page_after(cursor: str | None) -> Page[Item]:
            asked = given(**parameters, cursor=cursor, limit=PAGE)
            return self._ask(kind, "GET", path, params=asked)

        def items(page: Page[Item]) -> Iterator[Item]:
            yield from page.items
            while page.next_cursor is not None:
                page = page_after(page.next_cursor)
                yield from page.items

        return items(page_after(None))

    def _send(self, method: str, path: str, **request: Any) -> httpx.Response:
        """Every call may be repeated: what is made is found, what was deleted is gone."""
        response, lost = self._persist(lambda: self._http.request(method, path, **request))
        deleted_before = method == "DELETE" and lost > 0 and response.status_code == 404
        if response.is_success or deleted_before:
            return response
        raise error_of(response)

    def _persist(self, send: Callable[[], httpx.Response]) -> tuple[httpx.Response, int]:
        response, lost = persist(send, self._url, met=self._met)
        self._met = True
        return response, lost

    def _open_stream(
        self, path: str, last: str | None, parameters: dict[str, Any]
    ) -> httpx.Response:
        """A stream of events that begins behind an id."""

        def send() -> httpx.Response:
            headers = {"Accept": "text/event-stream"} | given(**{"Last-Event-ID": last})
            request = self._http.build_request(
                "GET", path, params=parameters, headers=headers, timeout=SILENCE_S
            )
            response = self._http.send(request, stream=True)
            if not response.is_success:
                response.read()
            return response

        response, _ = self._persist(send)
        if not response.is_success:
            raise error_of(response)
        return response

    def _let_work(self, pause_s: float) -> None:
        """Let jobs come nearer to their end: do one, or wait for those who do."""
        if self._worker is None:
            time.sleep(pause_s)
        else:
            self._worker.work(pause_s)


class RequestLogFilter(logging.Filter):
    """Keeps a line a request of one service out of the log of whoever uses the client."""

    def __init__(self, url: str) -> None:
        super().__init__()
        self._url = url

    def filter(self, record: logging.LogRecord) -> bool:
        """False for what httpx tells of requests to the service."""
        about = record.args if isinstance(record.args, tuple) else ()
        return not any(str(one).startswith(self._url) for one in about)


def _authorities(url: httpx.URL) -> ssl.SSLContext | bool:
    """Whose certificates are believed: those of SSL_CERT_FILE and SSL_CERT_DIR, where they are set.

    httpx looks at them too, but not where it is told to look for no proxies.
    """
    file, folder = os.environ.get("SSL_CERT_FILE"), os.environ.get("SSL_CERT_DIR")
    if url.scheme != "https" or not (file or folder):
        return True
    try:
        return ssl.create_default_context(cafile=file or None, capath=folder or None)
    except OSError as error:
        raise ValueError(
            f"SSL_CERT_FILE or SSL_CERT_DIR names no certificates: {error.strerror or error}"
        ) from error


# Trying again where that may help: a busy service, a broken connection.


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
            nobody = isinstance(caught, (httpx.ConnectError, httpx.ConnectTimeout))
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


def unreachable(url: str, error: Exception | None) -> errors.Unreachable:
    """No answer came, in our words."""
    if isinstance(error, httpx.TimeoutException):
        return errors.Unreachable(
            f"{url} did not answer in time ({type(error).__name__}). Look into the service's log, "
            "or give it longer."
        )
    if "CERTIFICATE_VERIFY_FAILED" in str(error):
        return errors.Unreachable(
            f"{url} shows a certificate that is not trusted here ({error}). Check the address; if "
            "it is right, set SSL_CERT_FILE to the PEM file of the authority that issued it."
        )
    return errors.Unreachable(
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
        when = when.replace(tzinfo=timezone.utc)
    return max((when - datetime.now(timezone.utc)).total_seconds(), 0.0)


# Answers: records, or problem documents back to the errors of our tree.


def read_record(kind: type[Record], response: httpx.Response) -> Record:
    """The record in an answer; Refused where the answer is none of ours."""
    try:
        return kind.model_validate_json(response.content)
    except ValidationError as error:
        raise errors.Refused(
            f"{response.request.url} answered with something else than this version of sceneprint "
            "understands. Check the address, and the service's version with `sceneprint doctor`.",
            response.status_code,
            {},
        ) from error


def error_of(response: httpx.Response) -> errors.SceneprintError:
    """The error that an answer tells of: of the class its `type` names, or else Refused."""
    error = _error_of(response)
    error.retry_after_s = retry_after_s(response.headers.get("Retry-After", ""))
    return error


def _error_of(response: httpx.Response) -> errors.SceneprintError:
    try:
        problem = Problem.model_validate_json(response.content)
    except ValidationError:
        return errors.Refused(
            f"{response.request.url} answered {response.status_code} {response.reason_phrase} "
            "without saying why, so it is hardly sceneprint. Check the address.",
            response.status_code,
            {},
        )
    kind = problem_kinds().get(problem.type.rstrip("/").rpartition("/")[2])
    if kind is None:
        return errors.Refused(problem.detail, response.status_code, problem.model_dump())
    if issubclass(kind, errors.InvalidRequest):
        return kind(problem.detail, _fields(problem))
    return kind(problem.detail)


def problem_kinds() -> dict[str, type[errors.SceneprintError]]:
    """The classes of the tree by the last part of a problem's `type`."""
    return {
        errors.kebab_case(name): kind
        for name, kind in vars(errors).items()
        if isinstance(kind, type)
        and issubclass(kind, errors.SceneprintError)
        and not issubclass(kind, errors.ServiceError)  # ways of hearing of a service
    }


def _fields(problem: Problem) -> tuple[tuple[str, str], ...]:
    """(place, reason) of each field at fault, as far as they are told."""
    told: Any = (problem.model_extra or {}).get("errors")
    if not isinstance(told, list):
        return ()
    return tuple(
        (str(one["field"]), str(one["reason"]))
        for one in told
        if isinstance(one, dict) and {"field", "reason"} <= one.keys()
    )


# Streams of events, read for as long as anybody wants them.


@dataclass
class StreamPosition:
    """How far a stream has been read.

    Parameters
    ----------
    last : `id` that came last; None: there was none
    pause_s : to wait before the stream is asked for again
    """

    last: str | None
    pause_s: float = STREAM_PAUSE_S


def read_events(lines: Iterable[str], place: StreamPosition) -> Iterator[Event]:
    """Events of a stream; the place is moved on before each is given out."""
    data: list[str] = []
    last = place.last
    for line in lines:
        name, _, value = line.partition(":")
        value = value.removeprefix(" ")
        if not line:
            place.last = last
            if data:
                yield Event.model_validate_json("\n".join(data))
            data = []
        elif name == "data":
            data.append(value)
        elif name == "id" and "\0" not in value:
            last = value
        elif name == "retry" and value.isascii() and value.isdigit():
            place.pause_s = min(float(value[:9]) / 1e3, SILENCE_S)


def follow_stream(
    opened: Callable[[str | None], httpx.Response], after: str | None
) -> Iterator[Event]:
    """Events of one stream after the other, as if it were one.

    Parameters
    ----------
    opened : asks for a stream, from an `id` on; raises where there will be none
    after : id of the event to begin behind; None: from now on
    """
    place = StreamPosition(after)
    met = False
    while True:
        try:
            with closing(opened(place.last)) as response:
                met = True
                yield from read_events(response.iter_lines(), place)
        except httpx.TransportError:
            pass  # it broke, or was silent for too long
        except errors.Unreachable:
            if not met:
                raise
        time.sleep(place.pause_s)
