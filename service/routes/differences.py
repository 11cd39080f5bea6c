"""Two sessions of a map compared: what is gone, and what is new."""

from __future__ import annotations

from contextlib import suppress
from typing import Annotated

from fastapi import Depends, Query, Request, Response

from sceneprint.errors import DamagedBlob
from sceneprint.formats.export import MEDIA_TYPE
from sceneprint_client.api import Page
from sceneprint_client.api.sessions import Difference, NewDifference
from service.auth import Here, may_read, may_write, v1_router
from service.bodies import json_body, read_record
from service.problems import declared
from service.responses import file_responses, is_known, send_file

router = v1_router("/maps/{map_name}/differences", "differences", may_read)


@router.post(
    "",
    status_code=202,
    responses=declared(400, 404, 413, 415, 422),
    openapi_extra=json_body("NewDifference"),
    dependencies=[Depends(may_write)],
)
async def begin_difference(
    map_name: str, request: Request, here: Here, response: Response
) -> Difference:
    """Compare two sessions whose frames have poses in one parent frame.

    A job fuses at most 500 frames of each session to cells, and asks the frames of the other
    session about each cell. It runs when nothing else waits for a worker. Ask under `Location`
    until `state` is `succeeded`. It takes the scope `write`.
    """
    asked = await read_record(request, NewDifference, "The difference")
    begun = await here.run(here.engine.differences.begin, map_name, asked)
    response.headers["Location"] = f"/v1/maps/{map_name}/differences/{begun.difference_id}"
    return begun


@router.get("", responses=declared(404, 422))
def list_differences(
    map_name: str,
    here: Here,
    cursor: Annotated[str | None, Query(description="`next_cursor` of the page before.")] = None,
    limit: Annotated[int, Query(ge=1, le=1000)] = 100,
) -> Page[Difference]:
    """Differences of a map, the newest first."""
    return here.engine.differences.list_all(map_name, cursor, limit)


@router.get("/{job_id}", responses=declared(404))
def get_difference(map_name: str, job_id: str, here: Here) -> Difference:
    """How far a comparison has come; when it has succeeded, its counts."""
    return here.engine.differences.get(map_name, job_id)


@router.delete(
    "/{job_id}", status_code=204, responses=declared(404), dependencies=[Depends(may_write)]
)
def delete_difference(map_name: str, job_id: str, here: Here) -> None:
    """Delete a difference with its points; one that is not over is given up."""
    here.engine.differences.remove(map_name, job_id)


@router.get(
    "/{job_id}/points",
    response_class=Response,
    responses=file_responses(
        MEDIA_TYPE,
        description="Cells of both sessions in the format of `frames/{frame_id}/points`. The patch "
        "index says what each is: 0 same, 1 gone, 2 new, 3 only in `before` and unseen in `after`, "
        "4 the reverse. Points are in this order.",
        statuses=(404, 409),
    ),
)
def get_difference_points(map_name: str, job_id: str, request: Request, here: Here) -> Response:
    """The cells of both sessions; 409 until the job has succeeded."""
    file, blobs = here.engine.differences.points(map_name, job_id), here.engine.store.blobs
    if is_known(request, file.blob) or blobs.condition(file.blob) == "sound":
        with suppress(FileNotFoundError):
            return send_file(
                request, lambda: blobs.open(file.blob), file.media_type, file.blob,
                f"{job_id[:12]}-points",
            )  # fmt: skip
    here.engine.differences.points(map_name, job_id)  # UnknownJob where it was deleted meanwhile
    raise DamagedBlob(
        f"The points of difference {job_id} are damaged. Delete it and compare the sessions again."
    )
