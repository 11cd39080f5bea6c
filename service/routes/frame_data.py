"""Routes for the data of a frame, as files and as JSON, with ETags."""

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
from service.auth import MatchMap, Sender, may_read, require_readable, v1_router
from service.responses import (
    file_responses,
    is_known,
    preferred_media_type,
    safe,
    send_file,
    send_output,
    tag_headers,
)
from service.running_service import Here, Service

router = v1_router("/maps/{map_name}/frames/{frame_id}", "frames", may_read)


@router.get(
    "/cloud.ply",
    response_class=Response,
    responses=file_responses(
        PLY,
        description="Points and normals, binary little-endian, 32-bit; a comment names the "
        "coordinate frame.",
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
            description="Coordinate frame. `optical`: the frame of the camera (for a cloud, of its "
            "sensor). `parent`: the parent frame of the pose. `base`: the base frame of the robot."
        ),
    ] = "optical",
) -> Response:
    """Return the visible surface as a cloud of up to 160 x 120 points, smoothed as for validation.
    A point cloud is first rendered as a range image around its viewpoint. The original samples are
    in the upload.
    """
    output = await here.run(lambda: here.outputs.cloud(map_name, frame_id, frame))
    return await send_output(request, here, output, PLY, name=f"{frame_id}-{frame}.ply")


@router.get(
    "/preview.png",
    response_class=Response,
    responses=file_responses(
        PNG, description="The tEXt chunks explain the colours.", statuses=(404, 409, 422)
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
            description="`depth`: yellow is near, violet is far. `normals`: red, green and blue "
            "are 127.5 (1 + n) for x right, y down, z forward. `patches`: one colour for each "
            "patch of the finest level. Pixels without data are dark grey. A cloud is shown as "
            "seen from its viewpoint, with normals along its own axes; without a viewpoint, it is "
            "shown from above, with heights instead of depth."
        ),
    ] = "depth",
    width: Annotated[
        int, Query(ge=WIDTHS[0], le=WIDTHS[1], description="Width in pixels.")
    ] = WIDTH,
) -> Response:
    """Return a picture of a frame."""
    output = await here.run(lambda: here.outputs.preview(map_name, frame_id, view, width))
    return await send_output(request, here, output, PNG, name=f"{frame_id}-{view}.png")


@router.get(
    "/patches",
    response_class=Response,
    responses=file_responses(model=FramePatches, description="The patches as lists of numbers."),
)
async def get_patches(map_name: str, frame_id: str, request: Request, here: Here) -> Response:
    """Return the surface patches of a frame by level, and the patches that validation compares."""
    output = await here.run(lambda: here.outputs.patches(map_name, frame_id))
    document = Output(output.tag, lambda: output.make().model_dump_json().encode())
    return await send_output(request, here, document, JSON)


@router.get(
    "/signature",
    response_class=Response,
    responses=file_responses(
        BYTES,
        NPY,
        model=FrameSignature,
        description="Depending on Accept: JSON with base64, the bytes, or an NPY file.",
    ),
)
async def get_signature(map_name: str, frame_id: str, request: Request, here: Here) -> Response:
    """Return the signature of a frame. The distance between two signatures of a model is the
    squared Euclidean distance of their bytes, or the L1 distance for models that store psi.
    """
    outputs, kind = here.outputs, preferred_media_type(request, (JSON, BYTES, NPY))
    if kind == JSON:
        record = await here.run(lambda: outputs.signature(map_name, frame_id))
        output = Output(record.tag, lambda: record.make().model_dump_json().encode())
    else:
        output = await here.run(lambda: outputs.vector(map_name, frame_id, kind))
    return await send_output(request, here, output, kind, Vary="Accept")


@router.get(
    "/upload",
    response_class=Response,
    responses=file_responses(
        *media_types_of("depth", "cloud"), description="The uploaded bytes, unchanged.", ranges=True
    ),
)
async def get_upload(map_name: str, frame_id: str, request: Request, here: Here) -> Response:
    """Return the uploaded file of a frame."""
    output = await here.run(lambda: here.outputs.upload(map_name, frame_id))
    if is_known(request, output.tag):
        return Response(None, 304, tag_headers(output))
    return await here.gate.enter(lambda: _upload(request, here, output, frame_id))


def _upload(request: Request, here: Service, output: Output[bytes], frame_id: str) -> Response:
    """Return a response with an upload, sent from its file to limit memory."""
    blobs, blob = here.context.store.blobs, output.blob or ""
    if blobs.condition(blob) == "sound":
        with suppress(FileNotFoundError):
            with blobs.open(blob) as file:
                kind, suffix = upload_type(file.read(HEAD))
            name = safe(f"{frame_id}{suffix}")
            return send_file(request, lambda: blobs.open(blob), kind, output.tag, name)
    output.make()  # raise the error of the blob
    raise DamagedBlob(f"The upload of frame {frame_id} has just been restored. Try again.")


# Points as bytes that a page draws without conversion; see `sceneprint.formats.export`.

points_router = v1_router()

_MostPoints = Annotated[
    int,
    Query(ge=1, le=MOST, description="Maximum number of points; the selection is deterministic."),
]
_POINTS = file_responses(
    MEDIA_TYPE,
    description="A header of 48 bytes, then 12 bytes per point; see docs/reference.md, Points. "
    "Normals, validation patches and, in a comparison, residuals are included.",
    statuses=(404, 409, 422),
)


@points_router.get(
    "/maps/{map_name}/frames/{frame_id}/points",
    tags=["frames"],
    dependencies=[Depends(may_read)],
    response_class=Response,
    responses=_POINTS,
)
async def get_frame_points(
    map_name: str,
    frame_id: str,
    request: Request,
    here: Here,
    frame: Annotated[
        CloudFrame, Query(description="Coordinate frame, as for `cloud.ply`.")
    ] = "optical",
    limit: _MostPoints = LIMIT,
) -> Response:
    """Return the points of `cloud.ply` in a third of its bytes, for display on a web page."""
    output = await here.run(lambda: here.points.frame(map_name, frame_id, frame, limit))
    return await send_output(request, here, output, MEDIA_TYPE)


@points_router.get(
    "/queries/{query_id}/points", tags=["queries"], response_class=Response, responses=_POINTS
)
async def get_query_points(
    query_id: str, request: Request, here: Here, caller: Sender, limit: _MostPoints = LIMIT
) -> Response:
    """Return the surface of a query in the frame of its sensor, for display on a web page."""
    await here.run(require_readable, query_id, here, caller)
    output = await here.run(lambda: here.points.query(query_id, limit))
    return await send_output(request, here, output, MEDIA_TYPE)


@points_router.get(
    "/queries/{query_id}/matches/{frame_id}/points",
    tags=["queries"],
    response_class=Response,
    responses=_POINTS,
)
async def get_match_points(
    query_id: str,
    frame_id: str,
    request: Request,
    here: Here,
    caller: Sender,
    map_name: MatchMap = None,
    side: Annotated[PointsSide, Query(description="Frame to return, query or match.")] = "query",
    transform: Annotated[
        OverlayTransform,
        Query(
            description="Transform of the comparison. `aligned`: the transform of the match. "
            "`rival`: the best alternative transform. `none`: the identity."
        ),
    ] = "aligned",
    limit: _MostPoints = LIMIT,
) -> Response:
    """Return the query or one of its matches in the frame of its own sensor, for display on a web
    page. Every point has its distance from the surface of the other frame.
    """
    await here.run(require_readable, query_id, here, caller)
    output = await here.run(
        lambda: here.points.match(query_id, frame_id, map_name, side, transform, limit)
    )
    return await send_output(request, here, output, MEDIA_TYPE)
