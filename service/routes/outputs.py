"""What a frame is made of, as files and as JSON; a client that has it is told so with 304."""

from __future__ import annotations

from contextlib import suppress
from typing import Annotated

from fastapi import APIRouter, Depends, Query, Request, Response

from sceneprint.datasets.sizes import HEAD
from sceneprint.engine.made import BYTES, JSON, NPY, PLY, PNG, Output, upload_type
from sceneprint.errors import DamagedBlob
from sceneprint.schemas.outputs import (
    WIDTH,
    WIDTHS,
    CloudFrame,
    FramePatches,
    FrameSignature,
    View,
)
from service.access import may_read
from service.conditions import chosen, is_known
from service.context import Context, Here
from service.files import files, send_file
from service.made import look, made_files, safe, sent, tagged

router = APIRouter(
    prefix="/maps/{map_name}/frames/{frame_id}", tags=["frames"], dependencies=[Depends(may_read)]
)


@router.get(
    "/cloud.ply",
    response_class=Response,
    responses=made_files(
        PLY,
        description="Points and normals, binary little-endian, 32-bit; a comment names the frame "
        "of the coordinates.",
        statuses=(404, 409, 422),
    ),
)
async def get_cloud(
    map_name: str,
    frame_id: str,
    request: Request,
    here: Here,
    frame: Annotated[
        CloudFrame,
        Query(
            description="Coordinates: `optical` of the camera (of a cloud, its sensor), `parent` "
            "of its pose, or `base` of the robot."
        ),
    ] = "optical",
) -> Response:
    """The surface that was seen, as a cloud of up to 160 x 120 points: smoothed, as validation
    compares it; of a point cloud, a range image's about its viewpoint. The samples themselves are
    in the upload.
    """
    found = await look(lambda: here.engine.outputs.cloud(map_name, frame_id, frame))
    return await sent(request, here, found, PLY, name=f"{frame_id}-{frame}.ply")


@router.get(
    "/preview.png",
    response_class=Response,
    responses=made_files(
        PNG,
        description="What its colours mean is in the tEXt chunks.",
        statuses=(404, 409, 422),
    ),
)
async def get_preview(
    map_name: str,
    frame_id: str,
    request: Request,
    here: Here,
    view: Annotated[
        View,
        Query(
            description="`depth`: yellow near, violet far. `normals`: red, green, blue are "
            "127.5 (1 + n) of x right, y down, z ahead. `patches`: each of the finest level a "
            "colour. Dark grey where nothing is known. Of a cloud what is seen around its "
            "viewpoint, normals along its own axes; of one without, the view from above, with "
            "heights in place of depth."
        ),
    ] = "depth",
    width: Annotated[int, Query(ge=WIDTHS[0], le=WIDTHS[1], description="Columns.")] = WIDTH,
) -> Response:
    """A picture of a frame, for people."""
    found = await look(lambda: here.engine.outputs.preview(map_name, frame_id, view, width))
    return await sent(request, here, found, PNG, name=f"{frame_id}-{view}.png")


@router.get(
    "/patches",
    response_class=Response,
    responses=made_files(model=FramePatches, description="The same, as lists of numbers."),
)
async def get_patches(map_name: str, frame_id: str, request: Request, here: Here) -> Response:
    """The surface patches of a frame, by level, and those that validation compares."""
    found = await look(lambda: here.engine.outputs.patches(map_name, frame_id))
    told = Output(found.tag, lambda: found.make().model_dump_json().encode())
    return await sent(request, here, told, JSON)


@router.get(
    "/signature",
    response_class=Response,
    responses=made_files(
        BYTES,
        NPY,
        model=FrameSignature,
        description="By Accept: JSON with the bytes as base64, the bytes, or an NPY file.",
    ),
)
async def get_signature(map_name: str, frame_id: str, request: Request, here: Here) -> Response:
    """The signature of a frame. Signatures of one model are compared by the sum of absolute
    differences of their bytes.
    """
    outputs, kind = here.engine.outputs, chosen(request, (JSON, BYTES, NPY))
    if kind == JSON:
        made = await look(lambda: outputs.signature(map_name, frame_id))
        told = Output(made.tag, lambda: made.make().model_dump_json().encode())
    else:
        told = await look(lambda: outputs.vector(map_name, frame_id, kind))
    return await sent(request, here, told, kind, Vary="Accept")


@router.get(
    "/upload",
    response_class=Response,
    responses=files((PNG, NPY, PLY, BYTES), "Byte for byte as it came.", 409),
)
async def get_upload(map_name: str, frame_id: str, request: Request, here: Here) -> Response:
    """The frame's upload: what you sent in is yours to take out."""
    found = await look(lambda: here.engine.outputs.upload(map_name, frame_id))
    if is_known(request, found.tag):
        return Response(None, 304, tagged(found))
    async with here.gate.place():
        return await here.gate.run(lambda: _upload(request, here, found, frame_id))


def _upload(request: Request, here: Context, found: Output[bytes], frame_id: str) -> Response:
    """An upload out of its file: of 70 MiB in memory each, a few slow readers would be too much."""
    blobs, blob = here.engine.store.blobs, found.blob or ""
    if blobs.condition(blob) == "sound":
        with suppress(FileNotFoundError):
            with blobs.open(blob) as file:
                kind, suffix = upload_type(file.read(HEAD))
            name = safe(f"{frame_id}.{suffix}")
            return send_file(request, lambda: blobs.open(blob), kind, found.tag, name)
    found.make()  # says what is wrong with it
    raise DamagedBlob(f"The upload of frame {frame_id} was put back just now. Ask again.")
