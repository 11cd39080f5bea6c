"""Requests to one service: as they are sent, sent until they are answered, and read as records or
as errors.

    frame, options  --named_or_sent, query_of-->  QueryFrame, Query
    QueryFrame, Query  --query_form, query_json-->  arguments of a request  --_ask-->  a record
"""

from __future__ import annotations

import email.utils
import json
import logging
import os
import random
import re
import ssl
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
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
from sceneprint_client.errors import (
    NotFound,
    SceneprintError,
    UnknownDeletion,
    UnknownFrame,
    UnknownJob,
    UnknownMap,
    UnknownQuery,
)

# What is sent.

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from sceneprint_client.frame_files import FrameFile, PinholeCamera

    class LibraryImage(Protocol):
        """An image of Pillow, or another object that NumPy reads in the same way."""

        @property
        def __array_interface__(self) -> dict[str, Any]: ...

    #: A frame at hand: the content of a file, a path, a frame of `find_sequences`, or an array:
    #: (H, W) depth, uint16 in stored units or floating in metres; (N, 3) floating points. Images
    #: and clouds of Open3D and images of Pillow count as arrays.
    FrameInput = bytes | str | PathLike[str] | FrameFile | NDArray[np.generic] | LibraryImage
    #: What is known of a frame; or its camera alone, also that of Open3D, of an array also as
    #: (3, 3) matrix or as (fx, fy, cx, cy), pixels.
    MetaInput = FrameMeta | CameraIntrinsics | PinholeCamera | Sequence[float] | NDArray[np.generic]

#: Where `sceneprint serve` listens unless told otherwise.
DEFAULT_URL = "http://127.0.0.1:8008"
#: A frame that is stored, or one at hand: its bytes and what is known of it.
QueryFrame = NamedFrame | tuple[bytes, FrameMeta]


def given(**parameters: Any) -> dict[str, Any]:
    """Return those parameters of a request that are not None."""
    return {name: value for name, value in parameters.items() if value is not None}


def frame_bytes(
    frame: FrameInput, meta: MetaInput | None, *, with_pose: bool,
    up: Sequence[float] | None = None,
) -> tuple[bytes, FrameMeta]:  # fmt: skip
    """Bytes of a frame and what is known of it; see `frame_files.sendable`."""
    from sceneprint_client.frame_files import sendable  # it takes numpy

    return sendable(frame, meta, with_pose=with_pose, up=up)


def frame_form(data: bytes, meta: FrameMeta) -> dict[str, Any]:
    """Arguments of a request that sends a frame."""
    return {
        "files": {"frame": ("frame", data, "application/octet-stream")},
        "data": {"meta": json.dumps(meta_json(meta))},
    }


def frames_form(frames: Sequence[FrameInput], metas: Sequence[MetaInput | None]) -> dict[str, Any]:
    """Arguments of a request that sends several frames with their poses; see `frame_bytes`."""
    sent = [frame_bytes(*one, with_pose=True) for one in zip(frames, metas, strict=True)]
    return {
        "files": [("frame", ("frame", data, "application/octet-stream")) for data, _ in sent],
        "data": {"metas": json.dumps([meta_json(meta) for _, meta in sent])},
    }


def meta_json(meta: FrameMeta) -> dict[str, Any]:
    """What is known of a frame as it is sent: a viewpoint of null says that there is none."""
    return meta.model_dump(mode="json", exclude_defaults=True)


def map_path(name: str) -> str:
    """Path of a map; UnknownMap for a name that none can have."""
    return f"/v1/maps/{_part(name, 'map', UnknownMap)}"


def query_path(query_id: str) -> str:
    """Path of a past query; UnknownQuery where no answer can have that id."""
    return f"/v1/queries/{_part(query_id, 'query', UnknownQuery)}"


def match_path(query_id: str, frame_id: str) -> str:
    """Path of a match of a past query; UnknownQuery or UnknownFrame as `query_path`."""
    return f"{query_path(query_id)}/matches/{_part(frame_id, 'frame', UnknownFrame)}"


def frame_path(map_name: str, frame_id: str) -> str:
    """Path of a frame; UnknownMap or UnknownFrame as `map_path`."""
    return f"{map_path(map_name)}/frames/{_part(frame_id, 'frame', UnknownFrame)}"


def deletion_path(map_name: str, deletion_id: str) -> str:
    """Path of a deletion; UnknownMap or UnknownDeletion as `map_path`."""
    return f"{map_path(map_name)}/deletions/{_part(deletion_id, 'deletion', UnknownDeletion)}"


def job_path(job_id: str) -> str:
    """Path of a job; UnknownJob as `map_path`."""
    return f"/v1/jobs/{_part(job_id, 'job', UnknownJob)}"


def product_path(kind: type[Product], map_name: str | None, job_id: str) -> str:
    """Path of a product; UnknownMap or UnknownJob as `map_path`."""
    root = "/v1" if map_name is None else map_path(map_name)
    return f"{root}/{kind.collection}/{_part(job_id, kind.noun, UnknownJob)}"


def surface_path(map_name: str) -> str:
    """Path of the surface of a map; UnknownMap as `map_path`."""
    return f"{map_path(map_name)}/surface"


def surface_tile_path(map_name: str, digest: str) -> str:
    """Path of a tile; UnknownMap as `map_path`, NotFound where no tile can have that digest."""
    return f"{surface_path(map_name)}/tiles/{_part(digest, 'tile', NotFound)}"


def _part(name: str, what: str, error: type[SceneprintError]) -> str:
    """Return a name that stays one part of a path: `..` would lead to another resource."""
    if not re.fullmatch(r"[A-Za-z0-9_-][A-Za-z0-9._-]*", name):
        raise error(f"There is no {what} {name!r:.80}. Check the name.")
    return name


# Queries.


class QueryOptions(TypedDict, total=False):
    """How to ask; see the fields of Query."""

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
    """Raise TypeError for options that a query does not have, before the frame is looked at."""
    unknown = how.keys() - Query.model_fields.keys()
    if unknown:
        raise TypeError(
            f"a query has no option {', '.join(sorted(unknown))}; its options are "
            f"{', '.join(sorted(QueryOptions.__annotations__))}, and the camera is `meta`"
        )


def query_of(kind: type[Any], how: QueryOptions, **more: Any) -> Any:
    """Return a query from options that `check_options` has seen."""
    stages: Any = how.get("stages")
    if stages is not None and not isinstance(stages, str):
        how = {**how, "stages": tuple(stages)}
    return checked(kind, "The query", **how, **more)


def named_or_sent(
    map_name: str | None, frame: FrameInput | None, meta: MetaInput | None,
    frame_id: str | None, up: Sequence[float] | None = None,
) -> tuple[str, QueryFrame]:  # fmt: skip
    """Return the frame that is asked for, of the map that it is asked of."""
    if map_name is None:
        raise TypeError("give `map_name`, or `maps`")
    if frame_id is not None and frame is None:
        if up is not None:
            raise TypeError("a stored frame has the `up` that it was uploaded with")
        return map_name, NamedFrame.model_construct(map=map_name, frame_id=frame_id)
    if frame is None or frame_id is not None:
        raise TypeError("give either `frame` or `frame_id`")
    return map_name, frame_bytes(frame, meta, with_pose=False, up=up)


def compared_frame(
    frame: FrameInput | NamedFrame | tuple[str, str], meta: MetaInput | None
) -> QueryFrame:
    """One of two frames to compare."""
    if isinstance(frame, tuple):
        return checked(NamedFrame, "The frame", map=frame[0], frame_id=frame[1])
    if isinstance(frame, NamedFrame):
        return frame
    return frame_bytes(frame, meta, with_pose=False)


def query_json(query: Query) -> dict[str, Any]:
    """Return the fields of a query that are not the default, as JSON."""
    return query.model_dump(mode="json", exclude_defaults=True)


def query_form(data: bytes, meta: FrameMeta, query: Query) -> dict[str, Any]:
    """Arguments of a request that sends a frame and how to ask for it."""
    sent = frame_form(data, meta)
    sent["data"] |= {name: form_text(value) for name, value in query_json(query).items()}
    return sent


def form_text(value: object) -> str:
    """Return a field of a form: names with commas between, else JSON."""
    if isinstance(value, str):
        return value
    if isinstance(value, list):
        return ",".join(value)
    return json.dumps(value)


# The connection.

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
    KeyRequired : the key is none.
    MissingDependency : a SOCKS proxy is set, and the package for it is not installed.
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
            headers["Authorization"] = f"Bearer {_checked_key(key)}"
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
        except (httpx.InvalidURL, ValueError) as error:
            raise errors.Unreachable(
                f"{url!r:.200} is not the address of a service ({error}). Write it like "
                "http://127.0.0.1:8008."
            ) from error
        except ImportError as error:  # of socksio
            raise errors.MissingDependency(
                "ALL_PROXY, HTTP_PROXY or HTTPS_PROXY names a SOCKS proxy, which needs a package: "
                "pip install 'httpx[socks]'. Or leave it out for this service with NO_PROXY."
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

    def _begin(self, kind: type[Record], path: str, wanted: BaseModel) -> Record:
        """Return the job that a record asks for."""
        document = wanted.model_dump(mode="json", exclude_unset=True)
        return self._ask(kind, "POST", path, json=document)

    def _bytes(self, path: str, **request: Any) -> bytes:
        """What it answers to a GET, as it comes."""
        return self._send("GET", path, **request).content

    def _delete(self, path: str) -> None:
        self._send("DELETE", path)

    def _items(self, kind: type[Page[Item]], path: str, **parameters: Any) -> Iterator[Item]:
        """Yield the items of all pages of a list; the first page is asked for at once."""

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
        """Return a stream of events that begins behind an id."""

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


def _checked_key(key: str) -> str:
    """Return a key without blanks around it, such as the newline of its file; never show it."""
    key = key.strip()
    if not key or not all(33 <= ord(sign) < 127 for sign in key):
        raise errors.KeyRequired(
            "The key is empty, or has a blank or a sign in it that no key has. Copy it again, "
            "or unset SCENEPRINT_KEY."
        )
    return key


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


#: Statuses of a proxy that reaches nobody, where it is a proxy that answers.
_OF_PROXY = (502, 503, 504)

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
    """Return the record in an answer; Refused where the answer is none of ours."""
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
    """Return the error that an answer tells of: of the class its `type` names, or else Refused."""
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
                "a proxy before the service reaches no process that is ready. Try again later."
            )
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
    """Return the classes of the tree by the last part of a problem's `type`."""
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


#: Pauses between two looks at a job, seconds: the first, and the longest.
_PAUSES_S = (0.02, 0.5)


def growing_pauses(until: float) -> Iterator[float]:
    """Growing pauses that end at a time of `time.monotonic`; none if it has come."""
    pause, longest = _PAUSES_S
    while (left := until - time.monotonic()) > 0:
        yield min(pause, left)
        pause = min(1.4 * pause, longest)
