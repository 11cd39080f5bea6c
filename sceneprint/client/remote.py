"""A service over HTTP, as a backend of the client."""

from __future__ import annotations

import logging
import time
from typing import Any

import httpx

from sceneprint import __version__
from sceneprint.client.backend import Status
from sceneprint.client.messages import Quiet, Record, form, frame_path, job_path, map_path, read
from sceneprint.client.problems import refusal
from sceneprint.client.retrying import persist
from sceneprint.errors import Unreachable
from sceneprint.schemas import (
    Added,
    Answer,
    Frame,
    FrameMeta,
    FrameState,
    Job,
    JobState,
    Map,
    NewMap,
    Page,
    Query,
)
from sceneprint.settings import is_loopback

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
        self._quiet = Quiet(self._url)
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
        return self._ask(Map, "GET", map_path(name))

    def delete_map(self, name: str) -> None:
        """Remove a map with all that is in it."""
        self._delete(map_path(name))

    # frames

    def add_frame(
        self, map_name: str, data: bytes, meta: FrameMeta, wait_s: float, priority: int,
        if_novel: float | None,
    ) -> tuple[Added, bool]:  # fmt: skip
        """Take a frame into a map; the service does not wait for one it had already."""
        wait = min(int(wait_s), _LONGEST_WAIT_S)
        sent = form(data, meta)
        if priority:  # a service of before knows of none
            sent["data"]["priority"] = str(priority)
        if if_novel is not None:
            sent["data"]["if_novel"] = repr(if_novel)
        response = self._send(
            "POST",
            f"{map_path(map_name)}/frames",
            headers={"Prefer": f"wait={wait}"} if wait else {},
            timeout=self._timeout_s + wait,
            **sent,
        )
        return read(Added, response), response.status_code != 200

    def list_frames(
        self, map_name: str, cursor: str | None, state: FrameState | None
    ) -> Page[Frame]:
        """A page of the frames of a map."""
        given = {"cursor": cursor, "state": state, "limit": str(_PAGE)}
        parameters = {name: value for name, value in given.items() if value is not None}
        return self._ask(Page[Frame], "GET", f"{map_path(map_name)}/frames", params=parameters)

    def get_frame(self, map_name: str, frame_id: str) -> Frame:
        """A frame."""
        return self._ask(Frame, "GET", frame_path(map_name, frame_id))

    def delete_frame(self, map_name: str, frame_id: str) -> None:
        """Take a frame out of its map."""
        self._delete(frame_path(map_name, frame_id))

    def get_job(self, job_id: str) -> Job:
        """A job."""
        return self._ask(Job, "GET", job_path(job_id))

    def list_jobs(self, cursor: str | None, state: JobState | None) -> Page[Job]:
        """A page of all jobs, the newest first."""
        given = {"cursor": cursor, "state": state, "limit": str(_PAGE)}
        parameters = {name: value for name, value in given.items() if value is not None}
        return self._ask(Page[Job], "GET", "/v1/jobs", params=parameters)

    def cancel_job(self, job_id: str) -> Job:
        """Give up a job that is not over."""
        return self._ask(Job, "POST", f"{job_path(job_id)}/cancel")

    def retry_job(self, job_id: str) -> Job:
        """Try again what was given up; asked twice, the service tells of the same new job."""
        return self._ask(Job, "POST", f"{job_path(job_id)}/retry")

    # queries

    def query_upload(self, map_name: str, data: bytes, meta: FrameMeta, query: Query) -> Answer:
        """Look a frame up that is not kept."""
        sent = form(data, meta)
        sent["data"] |= {
            "k": str(query.k),
            "stages": ",".join(query.stages),
            "exact": str(query.exact).lower(),
            "seed": str(query.seed),
        }
        if query.filter is not None:
            sent["data"]["filter"] = query.filter.model_dump_json(exclude_none=True)
        return self._ask(Answer, "POST", f"{map_path(map_name)}/queries", **sent)

    def query_frame(self, map_name: str, frame_id: str, query: Query) -> Answer:
        """Look a frame of the map up among the others."""
        body = {"frame_id": frame_id, **query.model_dump(mode="json", exclude_none=True)}
        return self._ask(Answer, "POST", f"{map_path(map_name)}/queries", json=body)

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
        return read(kind, self._send(method, path, **request))

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
