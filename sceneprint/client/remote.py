"""A service over HTTP, as a backend of the client."""

from __future__ import annotations

import logging
import re
import time
from typing import Any, TypeVar

import httpx
from pydantic import BaseModel, ValidationError

from sceneprint import __version__
from sceneprint.client.backend import Status
from sceneprint.client.problems import not_ours, refusal
from sceneprint.client.retrying import persist
from sceneprint.errors import SceneprintError, UnknownFrame, UnknownJob, UnknownMap, Unreachable
from sceneprint.schemas import (
    Added,
    Answer,
    Frame,
    FrameMeta,
    FrameState,
    Job,
    Map,
    NewMap,
    Page,
    Query,
)
from sceneprint.settings import is_loopback

Record = TypeVar("Record", bound=BaseModel)

#: Longest time the service is asked to wait for a worker, seconds.
_LONGEST_WAIT_S = 60
#: Longest silence that a service may keep and be called healthy, seconds.
_HEALTHY_S = 5.0
#: Frames a page.
_PAGE = 500


class Remote:
    """A service.

    Parameters
    ----------
    url : of it, with http:// or https://
    key : where it asks for one
    timeout_s : longest silence of the service

    Raises
    ------
    Unreachable : the address is none.
    """

    def __init__(self, url: str, key: str | None, timeout_s: float) -> None:
        self._url = url.rstrip("/")
        self._timeout_s = timeout_s
        self._met = False  # whether it has ever answered
        headers = {"User-Agent": f"sceneprint/{__version__}"}
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
                trust_env=not is_loopback(parsed.host),  # no proxy stands before this machine
            )
        except (httpx.InvalidURL, UnicodeEncodeError, ValueError) as error:
            raise Unreachable(
                f"{url!r:.200} is not the address of a service, or the key is not one ({error}). "
                "Write it like http://127.0.0.1:8008."
            ) from error
        self._quiet = _Quiet(self._url)
        logging.getLogger("httpx").addFilter(self._quiet)

    def close(self) -> None:
        """Close all connections."""
        logging.getLogger("httpx").removeFilter(self._quiet)
        self._http.close()

    # maps

    def create_map(self, new: NewMap) -> Map:
        """Make a map, or find that it is there as wanted."""
        return self._ask(Map, "POST", "/v1/maps", json=new.model_dump())

    def list_maps(self) -> list[Map]:
        """All maps by name."""
        return self._ask(Page[Map], "GET", "/v1/maps").items

    def get_map(self, name: str) -> Map:
        """A map."""
        return self._ask(Map, "GET", _map(name))

    def delete_map(self, name: str) -> None:
        """Remove a map with all that is in it."""
        self._delete(_map(name))

    # frames

    def add_frame(
        self, map_name: str, data: bytes, meta: FrameMeta, wait_s: float
    ) -> tuple[Added, bool]:
        """Take a frame into a map; the service does not wait for one it had already."""
        wait = min(int(wait_s), _LONGEST_WAIT_S)
        response = self._send(
            "POST",
            f"{_map(map_name)}/frames",
            headers={"Prefer": f"wait={wait}"} if wait else {},
            timeout=self._timeout_s + wait,
            **_form(data, meta),
        )
        return _read(Added, response), response.status_code != 200

    def list_frames(
        self, map_name: str, cursor: str | None, state: FrameState | None
    ) -> Page[Frame]:
        """A page of the frames of a map."""
        given = {"cursor": cursor, "state": state, "limit": str(_PAGE)}
        parameters = {name: value for name, value in given.items() if value is not None}
        return self._ask(Page[Frame], "GET", f"{_map(map_name)}/frames", params=parameters)

    def get_frame(self, map_name: str, frame_id: str) -> Frame:
        """A frame."""
        return self._ask(Frame, "GET", _frame(map_name, frame_id))

    def delete_frame(self, map_name: str, frame_id: str) -> None:
        """Take a frame out of its map."""
        self._delete(_frame(map_name, frame_id))

    def get_job(self, job_id: str) -> Job:
        """A job."""
        return self._ask(Job, "GET", f"/v1/jobs/{_part(job_id, 'job', UnknownJob)}")

    # queries

    def query_upload(self, map_name: str, data: bytes, meta: FrameMeta, query: Query) -> Answer:
        """Look a frame up that is not kept."""
        form = _form(data, meta)
        form["data"] |= {
            "k": str(query.k),
            "stages": ",".join(query.stages),
            "exact": str(query.exact).lower(),
            "seed": str(query.seed),
        }
        return self._ask(Answer, "POST", f"{_map(map_name)}/queries", **form)

    def query_frame(self, map_name: str, frame_id: str, query: Query) -> Answer:
        """Look a frame of the map up among the others."""
        body = {"frame_id": frame_id, **query.model_dump(mode="json")}
        return self._ask(Answer, "POST", f"{_map(map_name)}/queries", json=body)

    # the service

    def meanwhile(self, pause_s: float) -> None:
        """Wait for the workers."""
        time.sleep(pause_s)

    def status(self) -> Status:
        """How the service is."""
        return self._ask(Status, "GET", "/readyz")

    def healthy(self) -> bool:
        """Whether it answers, asked once."""
        try:
            timeout = min(self._timeout_s, _HEALTHY_S)
            response = self._http.get("/healthz", timeout=timeout)
            return response.status_code == 200 and response.json()["status"] == "ok"
        except (httpx.TransportError, ValueError, KeyError, TypeError):
            return False

    def _ask(self, kind: type[Record], method: str, path: str, **request: Any) -> Record:
        return _read(kind, self._send(method, path, **request))

    def _delete(self, path: str) -> None:
        self._send("DELETE", path)

    def _send(self, method: str, path: str, **request: Any) -> httpx.Response:
        """Every call may be repeated: what is made is found, what was deleted is gone."""
        response, lost = persist(
            lambda: self._http.request(method, path, **request), self._url, met=self._met
        )
        self._met = True
        deleted_before = method == "DELETE" and lost > 0 and response.status_code == 404
        if response.is_success or deleted_before:
            return response
        raise refusal(response)


class _Quiet(logging.Filter):
    """Keeps a line a request of one service out of the log of whoever uses the client."""

    def __init__(self, url: str) -> None:
        super().__init__()
        self._url = url

    def filter(self, record: logging.LogRecord) -> bool:
        """False for what httpx tells of requests to the service."""
        about = record.args if isinstance(record.args, tuple) else ()
        return not any(str(one).startswith(self._url) for one in about)


def _read(kind: type[Record], response: httpx.Response) -> Record:
    try:
        return kind.model_validate_json(response.content)
    except ValidationError as error:
        raise not_ours(response) from error


def _form(data: bytes, meta: FrameMeta) -> dict[str, Any]:
    return {
        "files": {"frame": ("frame", data, "application/octet-stream")},
        "data": {"meta": meta.model_dump_json(exclude_none=True)},
    }


def _map(name: str) -> str:
    return f"/v1/maps/{_part(name, 'map', UnknownMap)}"


def _frame(map_name: str, frame_id: str) -> str:
    return f"{_map(map_name)}/frames/{_part(frame_id, 'frame', UnknownFrame)}"


def _part(name: str, what: str, error: type[SceneprintError]) -> str:
    """A name that stays one part of a path: `..` would lead to another resource."""
    if not re.fullmatch(r"[A-Za-z0-9_-]+", name):
        raise error(f"There is no {what} {name!r:.80}. Check the name.")
    return name
