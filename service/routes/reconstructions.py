"""Routes for reconstructions, which fuse the views of an answer into a surface."""

from __future__ import annotations

from functools import partial

from fastapi import Request, Response

from sceneprint.engine.products.reconstruction import MEDIA_TYPE, MESH
from sceneprint.engine.results.query_entry import StoredAnswer, unknown_query
from sceneprint_client.api.surface import NewReconstruction, Reconstruction
from service.auth import Caller, Sender, v1_router
from service.bodies import json_body, read_record
from service.problems import refusals
from service.responses import file_responses, send_product_file
from service.running_service import Here, Service

router = v1_router(tag="reconstructions")


@router.post(
    "/queries/{query_id}/reconstruction",
    status_code=202,
    responses=refusals(400, 404, 413, 415, 422),
    openapi_extra=json_body("NewReconstruction", required=False),
)
async def reconstruct(
    query_id: str, request: Request, here: Here, caller: Sender, response: Response
) -> Reconstruction:
    """Fuse the accepted matches of an answer into a surface in the query's camera frame.

    A worker runs the job with Open3D, even if the answer expires in the meantime. GET the path in
    `Location` until `state` is `succeeded`, then download mesh.ply. Requires the scope `write`.
    """
    stored = await here.run(lambda: _stored_answer(here, caller, query_id))
    body = await read_record(request, NewReconstruction, "The reconstruction", optional=True)
    record = await here.run(lambda: here.reconstructions.begin_for(stored, body))
    response.headers["Location"] = f"/v1/reconstructions/{record.job_id}"
    return record


@router.get("/reconstructions/{job_id}", responses=refusals(404))
def get_reconstruction(job_id: str, here: Here, caller: Sender) -> Reconstruction:
    """Return a reconstruction, its progress, and its result once it has succeeded."""
    return _find_reconstruction(here, caller, job_id)


@router.get(
    "/reconstructions/{job_id}/mesh.ply",
    response_class=Response,
    responses=file_responses(
        MEDIA_TYPE,
        description="Points with normals, coloured by the first view that saw them, and triangles "
        "unless a cloud was requested; binary little-endian. A comment names the coordinate frame.",
        ranges=True,
    ),
)
async def get_mesh(job_id: str, request: Request, here: Here, caller: Sender) -> Response:
    """Return the surface in the query's camera frame. The response is 409 until the job has
    succeeded.
    """
    await here.run(_find_reconstruction, here, caller, job_id)
    async with here.gate.place():  # limit memory, since the whole file is read
        find = partial(here.reconstructions.file, None, job_id, MESH)
        name = f"{job_id[:12]}-{MESH}"
        return await here.gate.run(partial(send_product_file, request, here, find, name))


@router.delete("/reconstructions/{job_id}", status_code=204, responses=refusals(404))
def delete_reconstruction(job_id: str, here: Here, caller: Sender) -> None:
    """Delete a reconstruction and its files. A running job is cancelled."""
    for name in _find_reconstruction(here, caller, job_id).maps:
        caller.require(name, "write")
    here.reconstructions.remove(None, job_id)


def _stored_answer(here: Service, caller: Caller, query_id: str) -> StoredAnswer:
    """Return a stored answer if the caller may read all its maps and write to the maps of its
    matches.
    """
    stored = here.context.query_log.find(query_id)
    answer = stored.answer
    matched = {match.map for match in answer.matches}
    queried = {*answer.maps, *([] if answer.frame is None else [answer.frame.map])}
    if not all(caller.may("read", name) for name in queried | matched):
        raise unknown_query(query_id)
    for name in sorted(matched):
        caller.require(name, "write")
    return stored


def _find_reconstruction(here: Service, caller: Caller, job_id: str) -> Reconstruction:
    record = here.reconstructions.get(None, job_id)
    if not all(caller.may("read", name) for name in record.maps):
        raise here.reconstructions.unknown(job_id)
    return record
