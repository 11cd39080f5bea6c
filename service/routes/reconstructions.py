"""Reconstructions: the views of an answer, fused to a surface by a worker."""

from __future__ import annotations

from functools import partial

from fastapi import Request, Response

from sceneprint.engine.products.reconstruction import MEDIA_TYPE, MESH
from sceneprint.engine.results.query_entry import StoredAnswer, unknown_query
from sceneprint_client.api.surface import NewReconstruction, Reconstruction
from service.auth import Asking, Caller, v1_router
from service.bodies import json_body, read_record
from service.problems import declared
from service.responses import files, send_product_file
from service.running_service import Here, Service

router = v1_router(tag="reconstructions")


@router.post(
    "/queries/{query_id}/reconstruction",
    status_code=202,
    responses=declared(400, 404, 413, 415, 422),
    openapi_extra=json_body("NewReconstruction", required=False),
)
async def reconstruct(
    query_id: str, request: Request, here: Here, asking: Asking, response: Response
) -> Reconstruction:
    """Fuse the accepted matches of an answer, moved into the query's camera frame, to a surface.

    A worker does it, with Open3D. The answer may expire meanwhile. Ask under `Location` until
    `state` is `succeeded`; then mesh.ply is there. It takes the scope `write`.
    """
    stored = await here.run(lambda: _stored_answer(here, asking, query_id))
    wanted = await read_record(request, NewReconstruction, "The reconstruction", optional=True)
    made = await here.run(lambda: here.reconstructions.begin_for(stored, wanted))
    response.headers["Location"] = f"/v1/reconstructions/{made.job_id}"
    return made


@router.get("/reconstructions/{job_id}", responses=declared(404))
def get_reconstruction(job_id: str, here: Here, asking: Asking) -> Reconstruction:
    """A reconstruction: how far it is, and what its views show together when it is done."""
    return _find_reconstruction(here, asking, job_id)


@router.get(
    "/reconstructions/{job_id}/mesh.ply",
    response_class=Response,
    responses=files(
        [MEDIA_TYPE],
        "Points with normals, coloured by the first view that saw them, and triangles unless a "
        "cloud was asked for; binary little-endian. A comment names the frame of coordinates.",
        409,
    ),
)
async def get_mesh(job_id: str, request: Request, here: Here, asking: Asking) -> Response:
    """The surface, in the query's camera frame; 409 until the job has succeeded."""
    await here.run(_find_reconstruction, here, asking, job_id)
    async with here.gate.place():  # it is read whole: when it is its turn
        find = partial(here.reconstructions.file, None, job_id, MESH)
        name = f"{job_id[:12]}-{MESH}"
        return await here.gate.run(partial(send_product_file, request, here, find, name))


@router.delete("/reconstructions/{job_id}", status_code=204, responses=declared(404))
def delete_reconstruction(job_id: str, here: Here, asking: Asking) -> None:
    """Remove a reconstruction with its files; one that is under way is given up."""
    for name in _find_reconstruction(here, asking, job_id).maps:
        asking.require(name, "write")
    here.reconstructions.remove(None, job_id)


def _stored_answer(here: Service, asking: Caller, query_id: str) -> StoredAnswer:
    """The answer, for who may read the maps that it was asked of, and write to those it names."""
    stored = here.context.query_log.find(query_id)
    answer = stored.answer
    matched = {match.map for match in answer.matches}
    asked = {*answer.maps, *([] if answer.frame is None else [answer.frame.map])}
    if not all(asking.may("read", name) for name in asked | matched):
        raise unknown_query(query_id)
    for name in sorted(matched):
        asking.require(name, "write")
    return stored


def _find_reconstruction(here: Service, asking: Caller, job_id: str) -> Reconstruction:
    found = here.reconstructions.get(None, job_id)
    if not all(asking.may("read", name) for name in found.maps):
        raise here.reconstructions.unknown(job_id)
    return found
