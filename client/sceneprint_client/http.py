"""HTTP requests to a service, their retries, and their answers as records or errors.

frame, options  --named_or_sent, query_of-->  QueryFrame, Query
QueryFrame, Query  --query_form, query_json-->  arguments of a request  --_call-->  a record
"""

from __future__ import annotations

import asyncio
import email.utils
import json
import logging
import os
import random
import re
import ssl
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable, Iterator, Sequence
from copy import copy
from dataclasses import dataclass, field
from datetime import datetime, timezone
from http import HTTPStatus
from os import PathLike
from typing import TYPE_CHECKING, Any, Protocol, TypedDict, TypeVar

import httpx
from pydantic import BaseModel, ValidationError

from sceneprint_client import __version__, errors
from sceneprint_client.api import (
    CameraIntrinsics,
    Diversity,
    Filter,
    FrameMeta,
    NamedFrame,
    Page,
    Prior,
    Problem,
    Query,
    Stage,
    ValidationOptions,
)
from sceneprint_client.api.admin import Event, Product
from sceneprint_client.api.base import checked, is_loopback
from sceneprint_client.calls import Blocking, Call, P, T, settled
from sceneprint_client.errors import (
    NotFound,
    SceneprintError,
    UnknownDeletion,
    UnknownFrame,
    UnknownJob,
    UnknownMap,
    UnknownQuery,
)

# Requests.

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from sceneprint_client.frame_files import FrameFile, PinholeCamera

    class LibraryImage(Protocol):
        """An image of Pillow, or another object that NumPy reads in the same way."""

        @property
        def __array_interface__(self) -> dict[str, Any]: ...

    #: A frame: content or path of a file, a frame of `find_sequences`, or an array: (H, W) depth,
    #: uint16 in stored units or floating point in metres; or (N, 3) points. Images and clouds of
    #: Open3D and images of Pillow count as arrays.
    FrameInput = bytes | str | PathLike[str] | FrameFile | NDArray[np.generic] | LibraryImage
    #: Metadata of a frame, or only its camera; for an array, the camera may be a (3, 3) matrix or
    #: (fx, fy, cx, cy), pixels.
    MetaInput = FrameMeta | CameraIntrinsics | PinholeCamera | Sequence[float] | NDArray[np.generic]

#: Default address of `sceneprint serve`.
DEFAULT_URL = "http://127.0.0.1:8008"
#: A stored frame, or the bytes and metadata of a new one.
QueryFrame = NamedFrame | tuple[bytes, FrameMeta]


def without_none(**parameters: Any) -> dict[str, Any]:
    """Return the parameters of a request that are not None."""
    return {name: value for name, value in parameters.items() if value is not None}


def frame_bytes(
    frame: FrameInput, meta: MetaInput | None, *, with_pose: bool,
    up: Sequence[float] | None = None,
) -> tuple[bytes, FrameMeta]:  # fmt: skip
    """Return the bytes and metadata of a frame; see `frame_files.sendable`."""
    from sceneprint_client.frame_files import sendable  # this import loads numpy

    return sendable(frame, meta, with_pose=with_pose, up=up)


def frame_form(data: bytes, meta: FrameMeta) -> dict[str, Any]:
    """Return the keyword arguments of an httpx request that sends a frame."""
    return {
        "files": {"frame": ("frame", data, "application/octet-stream")},
        "data": {"meta": json.dumps(meta_json(meta))},
    }


def frames_form(frames: Sequence[FrameInput], metas: Sequence[MetaInput | None]) -> dict[str, Any]:
    """Return the keyword arguments of an httpx request that sends frames with their poses."""
    uploads = [frame_bytes(*pair, with_pose=True) for pair in zip(frames, metas, strict=True)]
    return {
        "files": [("frame", ("frame", data, "application/octet-stream")) for data, _ in uploads],
        "data": {"metas": json.dumps([meta_json(meta) for _, meta in uploads])},
    }


def meta_json(meta: FrameMeta) -> dict[str, Any]:
    """Return the non-default fields as JSON; a null viewpoint means that points have none."""
    return meta.model_dump(mode="json", exclude_defaults=True)


def map_path(name: str) -> str:
    """Return the path of a map; raise UnknownMap for an invalid name."""
    return f"/v1/maps/{_path_part(name, 'map', UnknownMap)}"


def query_path(query_id: str) -> str:
    """Return the path of a past query; raise UnknownQuery for an invalid id."""
    return f"/v1/queries/{_path_part(query_id, 'query', UnknownQuery)}"


def match_path(query_id: str, frame_id: str) -> str:
    """Return the path of a match of a past query; raise NotFound for an invalid id."""
    return f"{query_path(query_id)}/matches/{_path_part(frame_id, 'frame', UnknownFrame)}"


def frame_path(map_name: str, frame_id: str) -> str:
    """Return the path of a frame; raise NotFound for an invalid name or id."""
    return f"{map_path(map_name)}/frames/{_path_part(frame_id, 'frame', UnknownFrame)}"


def deletion_path(map_name: str, deletion_id: str) -> str:
    """Return the path of a deletion; raise NotFound for an invalid name or id."""
    return f"{map_path(map_name)}/deletions/{_path_part(deletion_id, 'deletion', UnknownDeletion)}"


def job_path(job_id: str) -> str:
    """Return the path of a job; raise UnknownJob for an invalid id."""
    return f"/v1/jobs/{_path_part(job_id, 'job', UnknownJob)}"


def product_path(kind: type[Product], map_name: str | None, job_id: str) -> str:
    """Return the path of a product; raise NotFound for an invalid name or id."""
    root = "/v1" if map_name is None else map_path(map_name)
    return f"{root}/{kind.collection}/{_path_part(job_id, kind.noun, UnknownJob)}"


def surface_path(map_name: str) -> str:
    """Return the path of the surface of a map; raise UnknownMap for an invalid name."""
    return f"{map_path(map_name)}/surface"


def surface_tile_path(map_name: str, digest: str) -> str:
    """Return the path of a tile; raise NotFound for an invalid name or digest."""
    return f"{surface_path(map_name)}/tiles/{_path_part(digest, 'tile', NotFound)}"


def _path_part(name: str, what: str, error: type[SceneprintError]) -> str:
    """Return a name that is a safe path segment (unlike `..`); otherwise raise `error`."""
    if not re.fullmatch(r"[A-Za-z0-9_-][A-Za-z0-9._-]*", name):
        raise error(f"There is no {what} {name!r:.80}. Check the name.")
    return name


# Queries.


class QueryOptions(TypedDict, total=False):
    """Options of a query; see the fields of Query."""

    k: int
    stages: str | Iterable[Stage]
    exact: bool
    filter: Filter | dict[str, Any] | None
    seed: int
    candidates: int | None
    diversity: Diversity | dict[str, float] | None
    validation: ValidationOptions | dict[str, Any] | None
    prior: Prior | dict[str, Any] | None
    confidence: float
    deadline_ms: int | None
    explain: bool
    explain_frame: str | None
    keep: bool
    record: bool


def check_options(how: QueryOptions) -> None:
    """Raise TypeError for unknown options of a query."""
    unknown = how.keys() - Query.model_fields.keys()
    if unknown:
        raise TypeError(
            f"a query has no option {', '.join(sorted(unknown))}; its options are "
            f"{', '.join(sorted(QueryOptions.__annotations__))}, and the camera is passed as `meta`"
        )


def query_of(kind: type[Any], how: QueryOptions, **more: Any) -> Any:
    """Return a record of type `kind` with options that `check_options` has accepted."""
    stages: Any = how.get("stages")
    if stages is not None and not isinstance(stages, str):
        how = {**how, "stages": tuple(stages)}
    return checked(kind, "The query", **how, **more)


def query_target(
    map_name: str | None, frame: FrameInput | None, meta: MetaInput | None,
    frame_id: str | None, up: Sequence[float] | None = None,
) -> tuple[str, QueryFrame]:  # fmt: skip
    """Return the map to search and the frame of the query, stored or as bytes with metadata."""
    if map_name is None:
        raise TypeError("pass `map_name` or `maps`")
    if frame_id is not None and frame is None:
        if up is not None:
            raise TypeError("a stored frame has the `up` of its upload; omit `up`")
        return map_name, NamedFrame.model_construct(map=map_name, frame_id=frame_id)
    if frame is None or frame_id is not None:
        raise TypeError("pass either `frame` or `frame_id`")
    return map_name, frame_bytes(frame, meta, with_pose=False, up=up)


def compared_frame(
    frame: FrameInput | NamedFrame | tuple[str, str], meta: MetaInput | None
) -> QueryFrame:
    """Return a frame of a comparison, stored or as bytes with metadata."""
    if isinstance(frame, tuple):
        return checked(NamedFrame, "The frame", map=frame[0], frame_id=frame[1])
    if isinstance(frame, NamedFrame):
        return frame
    return frame_bytes(frame, meta, with_pose=False)


def query_json(query: Query) -> dict[str, Any]:
    """Return the non-default fields of a query as JSON."""
    return query.model_dump(mode="json", exclude_defaults=True)


def query_form(data: bytes, meta: FrameMeta, query: Query) -> dict[str, Any]:
    """Return the keyword arguments of an httpx request that sends a frame and query options."""
    form = frame_form(data, meta)
    form["data"] |= {name: form_text(value) for name, value in query_json(query).items()}
    return form


def form_text(value: object) -> str:
    """Return a value as the text of a form field: lists joined by commas, other values as JSON."""
    if isinstance(value, str):
        return value
    if isinstance(value, list):
        return ",".join(value)
    return json.dumps(value)


# The connection.

Record = TypeVar("Record", bound=BaseModel)
Item = TypeVar("Item")

#: Number of records on a page.
PAGE = 200
#: Maximum number of attempts, and time after which no new attempt starts, seconds: long enough for
#: a restart of the service.
TRIES, LIMIT_S = 8, 30.0
#: Number of attempts if the service never answered, so that a wrong address fails soon.
TRIES_UNMET = 2
#: Delay before the second attempt, and maximum delay, seconds; the delay doubles each time.
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.25, 5.0
#: Time without data after which a stream counts as broken, seconds: three heartbeat intervals.
SILENCE_S = 50.0
#: Delay before a stream is reopened, seconds, unless the stream specifies another delay.
STREAM_PAUSE_S = 1.0

_BUSY = (HTTPStatus.TOO_MANY_REQUESTS, HTTPStatus.SERVICE_UNAVAILABLE)
#: Errors for which a retry is pointless.
_PERMANENT = (httpx.UnsupportedProtocol, httpx.LocalProtocolError, httpx.ProxyError)


class LocalWorker(Protocol):
    """Protocol of the worker that runs jobs in this process."""

    def work(self, pause_s: float) -> None:
        """Run a job, or wait `pause_s` seconds if there is none."""


class ServiceConnection:
    """Connection to a service; base class of the client's methods.

    Parameters
    ----------
    url : address of the service, with http:// or https://
    key : API key; None if the service requires no key
    timeout_s : maximum time without data from the service, seconds
    transport : transport of the requests; default: the network
    worker : worker that runs jobs in this process; default: workers of the service

    Raises
    ------
    Unreachable : If the URL is invalid.
    KeyRequired : If the key cannot be sent in an HTTP header.
    MissingDependency : If a SOCKS proxy is set and its package is not installed.
    """

    #: Copy of a blocking client whose methods are coroutines, which never suspend.
    _core: ServiceConnection | None = None

    def __init__(
        self, url: str, key: str | None, timeout_s: float,
        transport: Any = None, worker: LocalWorker | None = None,
    ) -> None:  # fmt: skip
        self._url = url.rstrip("/")
        self._timeout_s = timeout_s
        self._worker = worker
        self._answered = False  # whether the service has ever answered
        self._is_blocking = isinstance(self, Blocking)
        headers = {"User-Agent": f"sceneprint-client/{__version__}"}
        if key is not None:
            headers["Authorization"] = f"Bearer {_checked_key(key)}"
        try:
            parsed = httpx.URL(self._url)
            if parsed.scheme not in ("http", "https") or not parsed.host:
                raise httpx.InvalidURL("it does not begin with http:// or https://")
            self._http = (httpx.Client if self._is_blocking else httpx.AsyncClient)(
                base_url=self._url,
                headers=headers,
                timeout=timeout_s,
                transport=transport,
                verify=_authorities(parsed),
                # Requests to this machine bypass any proxy.
                trust_env=transport is None and not is_loopback(parsed.host),
            )
        except (httpx.InvalidURL, ValueError) as error:
            raise errors.Unreachable(
                f"{url!r:.200} is not the address of a service ({error}). Write it like "
                "http://127.0.0.1:8008."
            ) from error
        except ImportError as error:  # socksio is missing
            raise errors.MissingDependency(
                "ALL_PROXY, HTTP_PROXY or HTTPS_PROXY names a SOCKS proxy, which requires another "
                "package. Run: pip install 'httpx[socks]'. Or exclude this service from the proxy "
                "with NO_PROXY."
            ) from error
        self._log_filter = RequestLogFilter(self._url)
        logging.getLogger("httpx").addFilter(self._log_filter)
        if self._is_blocking:
            self._core = copy(self)

    @Call
    async def close(self) -> None:
        """Close connections and files."""
        logging.getLogger("httpx").removeFilter(self._log_filter)
        http = self._http
        if isinstance(http, httpx.Client):
            http.close()
        else:
            await http.aclose()

    async def _run(self, function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Return the result of a blocking call, which an asynchronous client runs in a thread."""
        if self._is_blocking:
            return function(*args, **kwargs)
        return await asyncio.to_thread(function, *args, **kwargs)

    async def _pause(self, seconds: float) -> None:
        await settled((time if self._is_blocking else asyncio).sleep(seconds))

    async def _call(self, kind: type[Record], method: str, path: str, **request: Any) -> Record:
        """Send a request and return its answer as a record of type `kind`."""
        return read_record(kind, await self._send(method, path, **request))

    async def _create(self, kind: type[Record], path: str, options: BaseModel) -> Record:
        """Create a job from its options and return its record, of type `kind`."""
        document = options.model_dump(mode="json", exclude_unset=True)
        return await self._call(kind, "POST", path, json=document)

    async def _bytes(self, path: str, **request: Any) -> bytes:
        return (await self._send("GET", path, **request)).content

    async def _delete(self, path: str) -> None:
        await self._send("DELETE", path)

    async def _pages(
        self, kind: type[Page[Item]], path: str, **parameters: Any
    ) -> AsyncIterator[Item]:
        cursor: str | None = None
        while True:
            query = without_none(**parameters, cursor=cursor, limit=PAGE)
            page = await self._call(kind, "GET", path, params=query)
            for item in page.items:
                yield item
            cursor = page.next_cursor
            if cursor is None:
                return

    async def _send(self, method: str, path: str, **request: Any) -> httpx.Response:
        """Send a request with retries; return the response, or raise the error that it reports.

        If an earlier attempt to delete was lost, a 404 counts as success.
        """
        response, lost = await self._persist(lambda: self._http.request(method, path, **request))
        deleted_before = method == "DELETE" and lost > 0 and response.status_code == 404
        if response.is_success or deleted_before:
            return response
        raise error_of(response)

    async def _persist(
        self, send: Callable[[], httpx.Response | Awaitable[httpx.Response]]
    ) -> tuple[httpx.Response, int]:
        """Send an idempotent request until it is answered.

        Returns
        -------
        response : the first response that does not request a retry, or the last one
        lost : number of unanswered attempts that the service may have executed

        Raises
        ------
        Unreachable : If the service does not answer.
        """
        until, lost = time.monotonic() + LIMIT_S, 0
        for attempt in range(1, TRIES + 1):
            pause = min(FIRST_PAUSE_S * 2 ** (attempt - 1), LONGEST_PAUSE_S)
            pause *= random.uniform(0.5, 1.5)
            is_last = attempt == TRIES
            error: httpx.TransportError | None = None
            response: httpx.Response | None = None
            try:
                response = await settled(send())
            except httpx.TransportError as caught:
                error = caught
                is_unconnected = isinstance(caught, (httpx.ConnectError, httpx.ConnectTimeout))
                lost += not is_unconnected
                is_last |= isinstance(caught, _PERMANENT)
                is_last |= is_unconnected and not self._answered and attempt >= TRIES_UNMET
            if response is not None:
                self._answered = True
                if response.status_code not in _BUSY:
                    return response, lost
                pause = max(pause, retry_after_s(response.headers.get("Retry-After", "")))
            if is_last or time.monotonic() + pause > until:
                if response is not None:
                    return response, lost
                raise unreachable(self._url, error) from error
            await self._pause(pause)
        raise AssertionError("the last attempt returns or raises")

    async def _open_stream(
        self, path: str, last: str | None, parameters: dict[str, Any]
    ) -> httpx.Response:
        """Open a stream of events that starts after the id `last`; raise the service's error."""

        async def send() -> httpx.Response:
            headers = {"Accept": "text/event-stream"} | without_none(**{"Last-Event-ID": last})
            request = self._http.build_request(
                "GET", path, params=parameters, headers=headers, timeout=SILENCE_S
            )
            response = await settled(self._http.send(request, stream=True))
            if not response.is_success:
                await settled(response.read() if self._is_blocking else response.aread())
            return response

        response, _ = await self._persist(send)
        if not response.is_success:
            raise error_of(response)
        return response

    async def _follow(
        self, path: str, after: str | None, parameters: dict[str, Any]
    ) -> AsyncIterator[Event]:
        """Yield events indefinitely; a stream that ends or breaks is reopened.

        Parameters
        ----------
        path, parameters : address of the stream
        after : id of an event; only later events are returned. None: only new events
        """
        place, met = StreamPosition(after), False
        while True:
            place = StreamPosition(place.last, place.pause_s)
            try:
                response = await self._open_stream(path, place.last, parameters)
                met = True
                try:
                    async for line in _lines(response):
                        if (event := place.read(line)) is not None:
                            yield event
                finally:
                    if self._is_blocking:
                        response.close()
                    else:
                        await response.aclose()
            except httpx.TransportError:
                pass  # the stream broke or timed out
            except errors.Unreachable:
                if not met:
                    raise
            await self._pause(place.pause_s)

    async def _work_or_wait(self, pause_s: float) -> None:
        """Run a job in this process, or wait while workers of the service run jobs."""
        if self._worker is None:
            await self._pause(pause_s)
        else:
            self._worker.work(pause_s)


class RequestLogFilter(logging.Filter):
    """Log filter that removes httpx's lines about requests to a service."""

    def __init__(self, url: str) -> None:
        super().__init__()
        self._url = url

    def filter(self, record: logging.LogRecord) -> bool:
        """Return False for httpx's lines about requests to the service."""
        about = record.args if isinstance(record.args, tuple) else ()
        return not any(str(argument).startswith(self._url) for argument in about)


def _checked_key(key: str) -> str:
    """Return a key without surrounding whitespace; raise KeyRequired if it is malformed."""
    key = key.strip()
    if not key or not all(33 <= ord(sign) < 127 for sign in key):
        raise errors.KeyRequired(
            "The key is empty or contains whitespace or an invalid character. Copy it again, "
            "or unset SCENEPRINT_KEY."
        )
    return key


def _authorities(url: httpx.URL) -> ssl.SSLContext | bool:
    """Return the certificates of SSL_CERT_FILE and SSL_CERT_DIR; True (default certificates) if
    neither is set or the URL is not https. Raise ValueError if they contain no certificates.

    httpx reads these variables itself, but not if it ignores proxies.
    """
    file, folder = os.environ.get("SSL_CERT_FILE"), os.environ.get("SSL_CERT_DIR")
    if url.scheme != "https" or not (file or folder):
        return True
    try:
        return ssl.create_default_context(cafile=file or None, capath=folder or None)
    except OSError as error:
        raise ValueError(
            f"SSL_CERT_FILE or SSL_CERT_DIR contains no certificates: {error.strerror or error}"
        ) from error


#: HTTP statuses that a proxy sends if it cannot reach the service.
_OF_PROXY = (502, 503, 504)
#: HTTP statuses that, without a problem document, may mean that URL and headers are too long; some
#: proxies reject more than `_LONG_HEAD` bytes.
_OF_LONG_HEADS, _LONG_HEAD = (400, 414, 431), 8 << 10


def unreachable(url: str, error: Exception | None) -> errors.Unreachable:
    """Return the error of a service that did not answer."""
    if isinstance(error, httpx.TimeoutException):
        return errors.Unreachable(
            f"{url} did not answer in time ({type(error).__name__}). Check the service's log, or "
            "increase the timeout."
        )
    if "CERTIFICATE_VERIFY_FAILED" in str(error):
        return errors.Unreachable(
            f"{url} presents a certificate that is not trusted here ({error}). Check the address; "
            "if it is right, set SSL_CERT_FILE to the PEM file of the authority that issued it."
        )
    return errors.Unreachable(
        f"{url} cannot be reached ({error}). Check the address and that the service runs; "
        "`sceneprint serve` starts one here."
    )


def retry_after_s(text: str) -> float:
    """Return the delay of a `Retry-After` header, seconds; 0 if its value is invalid."""
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


# Answers as records, and problem documents as errors.


def read_record(kind: type[Record], response: httpx.Response) -> Record:
    """Return the record in an answer; raise Refused if the answer has another format."""
    try:
        return kind.model_validate_json(response.content)
    except ValidationError as error:
        raise errors.Refused(
            f"The answer of {response.request.url} is not valid for this version of sceneprint. "
            "Check the address, and the service's version with `sceneprint doctor`.",
            response.status_code,
            {},
        ) from error


def error_of(response: httpx.Response) -> errors.SceneprintError:
    """Return the error of a response, of the class for its problem type, or else Refused."""
    error = _error_of(response)
    error.retry_after_s = retry_after_s(response.headers.get("Retry-After", ""))
    return error


def _error_of(response: httpx.Response) -> errors.SceneprintError:
    try:
        problem = Problem.model_validate_json(response.content)
    except ValidationError:
        if response.status_code in _OF_PROXY:
            return errors.Unreachable(
                f"{response.request.url} answered {response.status_code} {response.reason_phrase}: "
                "a proxy in front of the service cannot reach a ready process. Try again later."
            )
        request = response.request
        answered = f"answered {response.status_code} {response.reason_phrase} without a reason"
        lengths = [len(name) + len(value) for name, value in request.headers.raw]
        length = len(request.url.raw_path) + sum(lengths)
        if response.status_code in _OF_LONG_HEADS and length > _LONG_HEAD:
            text = (
                f"{request.url.copy_with(query=None)} {answered}, most likely because the URL and "
                f"the headers of the request have {length} bytes. The service accepts 16 KiB, and "
                "some proxies only 8 KiB. Send fewer or shorter tags or other options."
            )
        else:
            text = f"{request.url} {answered}, so it is probably not sceneprint. Check the address."
        return errors.Refused(text, response.status_code, {})
    kind = problem_kinds().get(problem.type.rstrip("/").rpartition("/")[2])
    if kind is None:
        return errors.Refused(problem.detail, response.status_code, problem.model_dump())
    if issubclass(kind, errors.InvalidRequest):
        return kind(problem.detail, _fields(problem))
    return kind(problem.detail)


def problem_kinds() -> dict[str, type[errors.SceneprintError]]:
    """Return the error classes by the last part of a problem's `type`."""
    return {
        errors.kebab_case(name): kind
        for name, kind in vars(errors).items()
        if isinstance(kind, type)
        and issubclass(kind, errors.SceneprintError)
        and not issubclass(kind, errors.ServiceError)  # the client itself raises these
    }


def _fields(problem: Problem) -> tuple[tuple[str, str], ...]:
    """Return (name, reason) of each invalid field in a problem document."""
    entries: Any = (problem.model_extra or {}).get("errors")
    if not isinstance(entries, list):
        return ()
    return tuple(
        (str(entry["field"]), str(entry["reason"]))
        for entry in entries
        if isinstance(entry, dict) and {"field", "reason"} <= entry.keys()
    )


# Streams of events.


@dataclass
class StreamPosition:
    """Position in a stream of events.

    Parameters
    ----------
    last : id of the last event; None before the first
    pause_s : delay before the stream is reopened, seconds
    """

    last: str | None
    pause_s: float = STREAM_PAUSE_S
    _id: str | None = field(default=None, init=False, compare=False)
    _data: list[str] = field(default_factory=list, init=False, compare=False)

    def read(self, line: str) -> Event | None:
        """Process the next line; return the event that it completes, otherwise None."""
        name, _, value = line.partition(":")
        value = value.removeprefix(" ")
        if not line:
            self.last = self.last if self._id is None else self._id
            data, self._data = self._data, []
            return Event.model_validate_json("\n".join(data)) if data else None
        if name == "data":
            self._data.append(value)
        elif name == "id" and "\0" not in value:
            self._id = value
        elif name == "retry" and value.isascii() and value.isdigit():
            self.pause_s = min(float(value[:9]) / 1e3, SILENCE_S)
        return None


async def _lines(response: httpx.Response) -> AsyncIterator[str]:
    """Yield the lines of a response to a blocking or an asynchronous client."""
    if isinstance(response.stream, httpx.SyncByteStream):
        for line in response.iter_lines():
            yield line
    else:
        async for line in response.aiter_lines():
            yield line


#: First and longest pause between checks of a job, seconds.
_PAUSES_S = (0.02, 0.5)


def growing_pauses(until: float) -> Iterator[float]:
    """Yield increasing pauses, seconds; stop when `time.monotonic` reaches `until`."""
    pause, longest = _PAUSES_S
    while (remaining := until - time.monotonic()) > 0:
        yield min(pause, remaining)
        pause = min(1.4 * pause, longest)
