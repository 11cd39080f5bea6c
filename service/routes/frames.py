"""Frames of a map."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Depends, Query, Response

from sceneprint.schemas import Frame, Page
from sceneprint.schemas.browsing import FramePage
from service.access import may_read, may_write
from service.bodies import FORM
from service.context import Here
from service.problems import declared

router = APIRouter(prefix="/maps/{map_name}/frames", tags=["frames"])

BODY: dict[str, Any] = {
    "required": True,
    "content": {
        FORM: {
            "schema": {
                "type": "object",
                "required": ["frame", "meta"],
                "properties": {
                    "frame": {
                        "type": "string",
                        "format": "binary",
                        "description": "A depth image: 16-bit greyscale PNG in stored units (0 and "
                        "65535 where missing), or a two-dimensional float NPY in metres. Or a "
                        "point cloud: PLY, PCD, LAS, LAZ, NPY of shape (N, 3), or KITTI's .bin.",
                    },
                    "meta": {"$ref": "#/components/schemas/FrameMeta"},
                },
            },
            "encoding": {"meta": {"contentType": "application/json"}},
        }
    },
}


@router.get("", responses=declared(404, 422), dependencies=[Depends(may_read)])
def list_frames(map_name: str, here: Here, wanted: Annotated[FramePage, Query()]) -> Page[Frame]:
    """Frames in the order they came; deleted ones only with `state=deleted`."""
    return here.engine.list_frames(map_name, wanted.cursor, wanted.limit, wanted=wanted)


@router.get("/{frame_id}", responses=declared(404), dependencies=[Depends(may_read)])
def get_frame(map_name: str, frame_id: str, here: Here, response: Response) -> Frame:
    """A frame, and what has become of it. Its ETag stands for what PATCH can change of it."""
    frame = here.engine.get_frame(map_name, frame_id)
    response.headers["ETag"] = f'"{frame.etag}"'
    return frame


@router.delete(
    "/{frame_id}", status_code=204, responses=declared(404), dependencies=[Depends(may_write)]
)
def delete_frame(map_name: str, frame_id: str, here: Here) -> None:
    """Take a frame out of its map; from now on no query finds it."""
    here.engine.delete_frame(map_name, frame_id)
