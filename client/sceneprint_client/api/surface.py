"""Records of the fused surface of a map, and of reconstructions from the views of an answer."""

from __future__ import annotations

from datetime import datetime
from typing import Literal

from pydantic import Field

from sceneprint_client.api.admin import Product
from sceneprint_client.api.base import ApiRecord, Given, Vector
from sceneprint_client.api.coverage import UpSource
from sceneprint_client.api.frames import Kind
from sceneprint_client.api.query import Named

#: State of a map's surface.
SurfaceState = Literal["none", "building", "ready", "stale"]
#: Default, minimum and maximum length of the longer side of a plan, pixels.
PLAN_WIDTH, PLAN_WIDTHS = 1024, (16, 4096)


class SurfaceLevel(ApiRecord):
    """All tiles of a parent frame with the same cell width."""

    level: int = Field(
        description="Number of the level. Level 0 has the finest cells; on each further level, "
        "cells are 4 times as wide."
    )
    cell_m: float = Field(description="Width of a cell, metres.")
    tile_m: float = Field(description="Width of a tile (64 cells), metres.")
    tiles: int
    cells: int = Field(description="Number of cells in all tiles.")
    bytes: int


class SurfacePlan(ApiRecord):
    """Scale, size and position of a parent frame's plan (`plan.png` with the default width)."""

    m_per_pixel: float
    width: int = Field(description="Width, pixels.")
    height: int
    left: float = Field(
        description="Position of the picture's upper left corner along `x_axis`, metres."
    )
    top: float = Field(description="Position of the same corner along `y_axis`, metres.")


class SurfaceParent(ApiRecord):
    """The surface in one parent frame."""

    parent_frame: str
    frames: int = Field(description="Number of fused frames.")
    up: Vector = Field(description="Unit vector that points up, in the parent frame.")
    up_from: UpSource = Field(
        description="Source of the up direction. `map`: the map's `up`. `frames`: the `up` of its "
        "frames. `cameras`: an estimate, namely the axis nearest to the vertical of the camera "
        "images."
    )
    x_axis: list[float] = Field(
        min_length=3,
        max_length=3,
        description="Unit vector in the parent frame that points right in the plan.",
    )
    y_axis: list[float] = Field(
        min_length=3,
        max_length=3,
        description="Unit vector in the parent frame that points to the top of the plan.",
    )
    low: Vector = Field(
        description="Corner with the minimum coordinates of the box that contains all cells."
    )
    high: Vector = Field(description="Corner with the maximum coordinates of the same box.")
    levels: list[SurfaceLevel] = Field(description="Levels, finest first.")
    plan: SurfacePlan


class MapSurface(ApiRecord):
    """The fused surface of a map's frames with poses, and whether it is up to date."""

    map: str
    state: SurfaceState = Field(
        description="`none`: the surface has not been built. `building`: a job is building the "
        "surface; existing tiles are available. `ready`: the surface contains all indexed frames "
        "with poses. `stale`: frames have been added, deleted or moved since the last update."
    )
    job_id: str | None = Field(description="Id of the latest job; see GET /v1/jobs/{job_id}.")
    error: str | None = Field(description="Error of the latest job, if the job failed.")
    frames: int = Field(description="Number of fused frames.")
    frames_left: int = Field(
        description="Approximate number of frames that still have to be added or removed."
    )
    updated_at: datetime | None = Field(description="Time of the last change of a tile.")
    sessions: list[str] = Field(
        description="Names of the sessions. Each cell contains the index of its session in this "
        "list."
    )
    first_taken: datetime | None = Field(description="Earliest `captured_at` of the fused frames.")
    last_taken: datetime | None
    taken_from: datetime | None = Field(
        description="Start of the time scale of cells. A cell was last seen at `taken_from` + "
        "`taken` * `taken_step_s`. Null if no fused frame has `captured_at`."
    )
    taken_step_s: float
    parents: list[SurfaceParent] = Field(
        description="Surface in each of at most 20 parent frames, sorted by number of frames."
    )


class SurfaceTile(ApiRecord):
    """A cube of cells, 64 along each side."""

    column: int = Field(
        description="Index along the x axis of the parent frame. The tile extends from `column` * "
        "`tile_m` to (`column` + 1) * `tile_m`."
    )
    row: int = Field(description="Index along the y axis; see `column`.")
    floor: int = Field(description="Index along the z axis; see `column`.")
    cells: int = Field(description="Number of cells that are not empty.")
    bytes: int
    digest: str = Field(
        description="Digest of the cells. GET /v1/maps/{map}/surface/tiles/{digest} returns them."
    )


class SurfaceSighting(ApiRecord):
    """A frame that saw a point, or was taken in a box."""

    frame_id: str
    name: str | None
    kind: Kind
    robot: str | None
    session: str | None
    captured_at: datetime | None
    parent_frame: str
    position: Vector = Field(description="Position of the frame's sensor in the parent frame.")
    distance_m: float | None = Field(
        description="Distance from the sensor to the point, metres; null for a frame that was "
        "taken in a box."
    )


# Reconstructions.

#: Maximum number of fused views, including that of the query.
MOST_VIEWS = 32


class NewReconstruction(Given):
    """The views to fuse in a reconstruction, and the kind of output."""

    frames: tuple[Named, ...] | None = Field(
        default=None,
        min_length=1,
        max_length=64,
        description="Ids of accepted matches to fuse; default: the first accepted matches of the "
        f"ranking, at most {MOST_VIEWS - 1}.",
    )
    strength: Literal["strong", "any"] = Field(
        default="any", description="Strength of the fused matches; `strong` excludes weak matches."
    )
    include_query: bool = Field(
        default=True,
        description="Whether to fuse the query as the first view. A query with a cloud cannot be "
        "fused.",
    )
    voxel_m: float | None = Field(
        default=None,
        ge=0.002,
        le=0.5,
        description="Edge of a voxel, metres; default: the spacing of the samples, but at least "
        "0.01, and more if memory is insufficient.",
    )
    output: Literal["mesh", "cloud"] = Field(
        default="mesh", description="Content of mesh.ply. `mesh`: triangles. `cloud`: only points."
    )


class FusedView(ApiRecord):
    """One view of a reconstruction."""

    frame_id: str | None = Field(description="Id of the frame; null for the query.")
    map: str | None
    rank: int | None = Field(description="Position in the ranking R, from 1.")
    strength: Literal["strong", "weak"] | None = Field(description="Strength of the match.")
    source: Literal["upload", "geometry"] = Field(
        description="`upload`: the uploaded depth. `geometry`: the reduced depth that validation "
        "compares; it is used for the query and for frames whose upload is lost."
    )
    samples: int = Field(description="Number of depth samples within the fused range.")
    added_m2: float = Field(
        description="Area that this view sees and no earlier view sees, square metres."
    )


class LeftOut(ApiRecord):
    """A match that was not fused. Clouds cannot be fused because they lack free space."""

    frame_id: str
    map: str
    reason: str


class Coverage(ApiRecord):
    """Surface and volume that the views see together, as in the last figure of the paper."""

    views: list[FusedView] = Field(
        description="Views in the order of the ranking, the query first."
    )
    left_out: list[LeftOut]
    area_m2: float = Field(description="Area of the fused surface, the sum of all `added_m2`.")
    observed_volume_m3: float = Field(
        description="Volume that is known to be empty or part of a surface. It lies between the "
        "cameras and the surfaces that they saw."
    )
    query_explained: float = Field(
        description="Share of the query's points that other views also see, 0 to 1."
    )
    voxel_m: float
    points: int
    triangles: int = Field(description="Number of triangles; 0 for a cloud.")


class Reconstruction(Product):
    """A reconstruction job and its result."""

    noun, collection, request_type = "reconstruction", "reconstructions", NewReconstruction

    query_id: str
    maps: list[str] = Field(description="Maps of the fused frames.")
    request: NewReconstruction
    parent_frame: str = Field(
        description="Coordinate frame of mesh.ply. It is the frame of the query's sensor; for a "
        "camera, x points right, y down and z forward."
    )
    result: Coverage | None = Field(
        description="Result of a job that has succeeded. GET "
        "/v1/reconstructions/{job_id}/mesh.ply then returns the surface."
    )
