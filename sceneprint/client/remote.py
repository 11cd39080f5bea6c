"""A service over HTTP, as a backend of the client."""

from __future__ import annotations

import time

import httpx

from sceneprint.client.asking import RemoteAsking
from sceneprint.client.associations import RemoteAssociations
from sceneprint.client.backend import Status
from sceneprint.client.ingest import RemoteIngest
from sceneprint.client.kept import RemoteKept
from sceneprint.client.keys import RemoteKeys
from sceneprint.client.messages import form, frame_path, job_path, map_path, read
from sceneprint.client.operations import RemoteOperations
from sceneprint.client.outputs import RemoteOutputs
from sceneprint.client.reconstructions import RemoteReconstructions
from sceneprint.client.sending import PAGE
from sceneprint.client.snapshots import RemoteSnapshots
from sceneprint.schemas import (
    Added,
    Frame,
    FrameMeta,
    Job,
    JobState,
    Map,
    NewMap,
    Page,
)

#: Longest time the service is asked to wait for a worker, seconds.
_LONGEST_WAIT_S = 60
#: Longest silence that a service may keep and be called healthy, seconds.
_HEALTHY_S = 5.0


class Remote(
    RemoteIngest,
    RemoteAsking,
    RemoteKept,
    RemoteOutputs,
    RemoteAssociations,
    RemoteReconstructions,
    RemoteSnapshots,
    RemoteKeys,
    RemoteOperations,
):
    """A service; see Sender."""

    # maps

    def create_map(self, new: NewMap) -> Map:
        """Make a map, or find that it is there as wanted."""
        return self._ask(Map, "POST", "/v1/maps", json=new.model_dump(exclude_unset=True))

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
        given = {"cursor": cursor, "state": state, "limit": str(PAGE)}
        parameters = {name: value for name, value in given.items() if value is not None}
        return self._ask(Page[Job], "GET", "/v1/jobs", params=parameters)

    def cancel_job(self, job_id: str) -> Job:
        """Give up a job that is not over."""
        return self._ask(Job, "POST", f"{job_path(job_id)}/cancel")

    def retry_job(self, job_id: str) -> Job:
        """Try again what was given up; asked twice, the service tells of the same new job."""
        return self._ask(Job, "POST", f"{job_path(job_id)}/retry")

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
