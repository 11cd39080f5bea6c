"""What a frame is made of, as files and as JSON; a client that has it is told so with 304."""

from __future__ import annotations

from contextlib import suppress
from typing import Annotated

from fastapi import Depends, Query, Request, Response

from sceneprint.engine.maps.map_frames import JSON, NPY, PLY, PNG, Output, upload_type
from sceneprint.errors import DamagedBlob
from sceneprint.formats.export import LIMIT, MEDIA_TYPE, MOST
from sceneprint_client.api.results import (
    WIDTH,
    WIDTHS,
    CloudFrame,
    FramePatches,
    FrameSignature,
    OverlayTransform,
    PointsSide,
    View,
)
from sceneprint_client.formats import BYTES, HEAD, media_types_of
from service.auth import Asking, MatchMap, may_read, require_readable, v1_router
from service.responses import (
    file_responses,
    files,
    is_known,
    preferred_media_type,
    safe,
    send_file,
    sent,
    tagged,
)
from service.running_service import Here, Service

router = v1_router("/maps/{map_name}/frames/{frame_id}", "frames", may_read)


@router.get(
    "/cloud.ply",
    response_class=Response,
    responses=file_responses(
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
    found = await here.run(lambda: here.outputs.cloud(map_name, frame_id, frame))
    return await sent(request, here, found, PLY, name=f"{frame_id}-{frame}.ply")


@router.get(
    "/preview.png",
    response_class=Response,
    responses=file_responses(
        PNG, description="What its colours mean is in the tEXt chunks.", statuses=(404, 409, 422)
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
            "127.5 (1 + n) of x right, y down, z forward. `patches`: each of the finest level a "
            "colour. Dark grey where nothing is known. Of a cloud what is seen around its "
            "viewpoint, normals along its own axes; of one without, the view from above, with "
            "heights in place of depth."
        ),
    ] = "depth",
    width: Annotated[int, Query(ge=WIDTHS[0], le=WIDTHS[1], description="Columns.")] = WIDTH,
) -> Response:
    """A picture of a frame, for people."""
    found = await here.run(lambda: here.outputs.preview(map_name, frame_id, view, width))
    return await sent(request, here, found, PNG, name=f"{frame_id}-{view}.png")


@router.get(
    "/patches",
    response_class=Response,
    responses=file_responses(model=FramePatches, description="The same, as lists of numbers."),
)
async def get_patches(map_name: str, frame_id: str, request: Request, here: Here) -> Response:
    """The surface patches of a frame, by level, and those that validation compares."""
    found = await here.run(lambda: here.outputs.patches(map_name, frame_id))
    told = Output(found.tag, lambda: found.make().model_dump_json().encode())
    return await sent(request, here, told, JSON)


@router.get(
    "/signature",
    response_class=Response,
    responses=file_responses(
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
    outputs, kind = here.outputs, preferred_media_type(request, (JSON, BYTES, NPY))
    if kind == JSON:
        made = await here.run(lambda: outputs.signature(map_name, frame_id))
        told = Output(made.tag, lambda: made.make().model_dump_json().encode())
    else:
        told = await here.run(lambda: outputs.vector(map_name, frame_id, kind))
    return await sent(request, here, told, kind, Vary="Accept")


@router.get(
    "/upload",
    response_class=Response,
    responses=files(media_types_of("depth", "cloud"), "Byte for byte as it came.", 409),
)
async def get_upload(map_name: str, frame_id: str, request: Request, here: Here) -> Response:
    """The frame's upload: what you sent in is yours to take out."""
    found = await here.run(lambda: here.outputs.upload(map_name, frame_id))
    if is_known(request, found.tag):
        return Response(None, 304, tagged(found))
    return await here.gate.enter(lambda: _upload(request, here, found, frame_id))


def _upload(request: Request, here: Service, found: Output[bytes], frame_id: str) -> Response:
    """An upload out of its file: of 70 MiB in memory each, a few slow readers would be too much."""
    blobs, blob = here.context.store.blobs, found.blob or ""
    if blobs.condition(blob) == "sound":
        with suppress(FileNotFoundError):
            with blobs.open(blob) as file:
                kind, suffix = upload_type(file.read(HEAD))
            name = safe(f"{frame_id}{suffix}")
            return send_file(request, lambda: blobs.open(blob), kind, found.tag, name)
    found.make()  # says what is wrong with it
    raise DamagedBlob(f"The upload of frame {frame_id} was restored just now. Try again.")


# Points as bytes that a page draws as they are; `sceneprint.formats.export` says what they
# mean.

points_router = v1_router()

Limit = Annotated[
    int, Query(ge=1, le=MOST, description="Most points; of more, always the same ones are told.")
]
_BYTES = "12 bytes a point after a header of 48: docs/reference.md, Points. "


@points_router.get(
    "/maps/{map_name}/frames/{frame_id}/points",
    tags=["frames"],
    dependencies=[Depends(may_read)],
    response_class=Response,
    responses=file_responses(
        MEDIA_TYPE,
        description=f"{_BYTES}With normals and validation patches.",
        statuses=(404, 409, 422),
    ),
)
async def get_frame_points(
    map_name: str,
    frame_id: str,
    request: Request,
    here: Here,
    frame: Annotated[CloudFrame, Query(description="Coordinates, as of `cloud.ply`.")] = "optical",
    limit: Limit = LIMIT,
) -> Response:
    """The points of `cloud.ply` in a third of its bytes, for a page to draw."""
    found = await here.run(lambda: here.points.frame(map_name, frame_id, frame, limit))
    return await sent(request, here, found, MEDIA_TYPE)


@points_router.get(
    "/queries/{query_id}/points",
    tags=["queries"],
    response_class=Response,
    responses=file_responses(
        MEDIA_TYPE,
        description=f"{_BYTES}With normals and validation patches.",
        statuses=(404, 409, 422),
    ),
)
async def get_query_points(
    query_id: str, request: Request, here: Here, asking: Asking, limit: Limit = LIMIT
) -> Response:
    """The surface that a query saw, for a page to draw, in the query's sensor's frame."""
    await here.run(require_readable, query_id, here, asking)
    found = await here.run(lambda: here.points.query(query_id, limit))
    return await sent(request, here, found, MEDIA_TYPE)


@points_router.get(
    "/queries/{query_id}/matches/{frame_id}/points",
    tags=["queries"],
    response_class=Response,
    responses=file_responses(
        MEDIA_TYPE,
        description=f"{_BYTES}With normals, validation patches and, where there is a transform, "
        "residuals.",
        statuses=(404, 409, 422),
    ),
)
async def get_match_points(
    query_id: str,
    frame_id: str,
    request: Request,
    here: Here,
    asking: Asking,
    map_name: MatchMap = None,
    side: Annotated[PointsSide, Query(description="Whose points.")] = "query",
    transform: Annotated[
        OverlayTransform,
        Query(
            description="Under which they are compared: `aligned` as the match was found, `rival` "
            "the other transform that fits best, `none` both as their cameras saw them."
        ),
    ] = "aligned",
    limit: Limit = LIMIT,
) -> Response:
    """The query or a match of it, for a page to draw, each in its own sensor's frame; every point
    says how far it is from the surface that the other saw.
    """
    await here.run(require_readable, query_id, here, asking)
    found = await here.run(
        lambda: here.points.match(query_id, frame_id, map_name, side, transform, limit)
    )
    return await sent(request, here, found, MEDIA_TYPE)
