"""Snapshots of the data folder, taken by a worker while all goes on."""

from __future__ import annotations

from fastapi import APIRouter, Depends, Request, Response

from sceneprint.maintenance.shelf import SNAPSHOT, Shelf
from sceneprint.schemas import Job, JobState, Page
from sceneprint.schemas.snapshots import SnapshotFile
from service.access import administers
from service.context import Here
from service.files import files, send_file
from service.problems import declared

router = APIRouter(prefix="/snapshots", tags=["operations"], dependencies=[Depends(administers)])


@router.post("", status_code=202, responses=declared())
def take_snapshot(here: Here, response: Response) -> Job:
    """Have a snapshot taken of all maps: database and blobs, one state of both, in one archive.

    Ask for the job until it has succeeded: `result` is the snapshot then. One that waits its turn
    already is not queued twice. Restoring is for the operator: `sceneprint restore`.
    """
    waiting = here.engine.list_jobs(JobState.QUEUED, limit=1, kind=SNAPSHOT).items
    job = waiting[0] if waiting else here.engine.tasks.begin(SNAPSHOT, None, {})
    response.headers["Location"] = f"/v1/jobs/{job.job_id}"
    return job


@router.get("", responses=declared())
def list_snapshots(here: Here) -> Page[SnapshotFile]:
    """Snapshots that were taken over the service, the newest first: all in one page."""
    return Page[SnapshotFile](items=list(Shelf(here.engine.settings).list()))


@router.get(
    "/{snapshot_id}",
    response_class=Response,
    responses=files(["application/x-tar"], "The archive, for `sceneprint restore`."),
)
def get_snapshot(snapshot_id: str, request: Request, here: Here) -> Response:
    """The archive. It holds all frames and the hashes of keys: keep it as you keep the folder.

    With `Range` a download goes on where it broke off.
    """
    shelf = Shelf(here.engine.settings)
    found = shelf.find(snapshot_id)
    name = f"sceneprint-{snapshot_id}.tar"
    return send_file(
        request, lambda: shelf.open(snapshot_id), "application/x-tar", found.sha256, name
    )


@router.delete("/{snapshot_id}", status_code=204, responses=declared(404))
def delete_snapshot(snapshot_id: str, here: Here) -> None:
    """Remove a snapshot. A download that is under way goes on."""
    Shelf(here.engine.settings).delete(snapshot_id)
