"""Fused surfaces as JSON: that of a map, and reconstructions of the views of an answer."""

from __future__ import annotations

from datetime import datetime
from typing import Literal

from pydantic import Field

from sceneprint_client.api.admin import Product
from sceneprint_client.api.base import ApiRecord, Given, Vector
from sceneprint_client.api.coverage import UpSource
from sceneprint_client.api.frames import Kind
from sceneprint_client.api.query import Named

#: Whether a map has a surface, and whether it is that of all its frames.
SurfaceState = Literal["none", "building", "ready", "stale"]
#: Longer side of a picture of a surface, pixels: by default, at least, and at most.
PLAN_WIDTH, PLAN_WIDTHS = 1024, (16, 4096)


class SurfaceLevel(ApiRecord):
    """All tiles of a parent frame whose cells have the same width."""

    level: int = Field(
        description="0 has the finest cells; those of each next level are 4 times as wide."
    )
    cell_m: float = Field(description="Width of a cell.")
    tile_m: float = Field(description="Width of a tile: 64 cells.")
    tiles: int
    cells: int = Field(description="Number of cells of all tiles.")
    bytes: int


class SurfacePlan(ApiRecord):
    """Position of a parent frame's picture, as `plan.png` shows it without `width`."""

    m_per_pixel: float
    width: int = Field(description="Width, pixels.")
    height: int
    left: float = Field(
        description="Position of the picture's upper left corner along `x_axis`, metres."
    )
    top: float = Field(description="Position of that corner along `y_axis`, metres.")


class SurfaceParent(ApiRecord):
    """The surface in one parent frame."""

    parent_frame: str
    frames: int = Field(description="Number of fused frames.")
    up: Vector = Field(description="Unit vector, in the parent frame.")
    up_from: UpSource = Field(
        description="Source of the vertical. `map`: the map's `up`. `frames`: the `up` of its "
        "frames. `cameras`: estimated, the axis nearest to the upright of the cameras."
    )
    x_axis: list[float] = Field(
        min_length=3, max_length=3, description="Unit vector to the right of the plan."
    )
    y_axis: list[float] = Field(
        min_length=3, max_length=3, description="Unit vector to the top of the plan."
    )
    low: Vector = Field(description="Opposite corners of the box that contains all cells:")
    high: Vector
    levels: list[SurfaceLevel] = Field(description="Levels, the finest first.")
    plan: SurfacePlan


class MapSurface(ApiRecord):
    """The fused surface of a map's posed frames, and whether it is up to date."""

    map: str
    state: SurfaceState = Field(
        description="`none`: not built. `building`: a job builds it, and existing tiles can be "
        "read. `ready`: it has all indexed frames with poses. `stale`: frames were added, "
        "removed or moved since."
    )
    job_id: str | None = Field(description="Id of the latest job: GET /v1/jobs/{job_id}.")
    error: str | None = Field(description="Error of that job, if it failed.")
    frames: int = Field(description="Number of fused frames.")
    frames_left: int = Field(description="Approximate number of frames to add or remove.")
    updated_at: datetime | None = Field(description="Time of the last change of a tile.")
    sessions: list[str] = Field(
        description="Names of sessions; a cell refers to its session by its index in this list."
    )
    first_taken: datetime | None = Field(description="Earliest `captured_at` of the fused frames.")
    last_taken: datetime | None
    taken_from: datetime | None = Field(
        description="A cell was last seen at `taken_from` plus `taken` times `taken_step_s`. "
        "Null if no fused frame has `captured_at`."
    )
    taken_step_s: float
    parents: list[SurfaceParent] = Field(
        description="Surfaces in each parent frame, that with most frames first; at most 20."
    )


class SurfaceTile(ApiRecord):
    """A cube of 64 cells along each side."""

    column: int = Field(
        description="The tile extends from `column` times `tile_m` to `column` + 1 times along "
        "the x axis of the parent frame."
    )
    row: int = Field(description="The same along y.")
    floor: int = Field(description="The same along z.")
    cells: int = Field(description="Number of cells that are not empty.")
    bytes: int
    digest: str = Field(
        description="GET /v1/maps/{map}/surface/tiles/{digest} returns its cells. It changes "
        "with them."
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
    position: Vector = Field(description="Position of its sensor in the parent frame.")
    distance_m: float | None = Field(
        description="Distance from its sensor to the point; null for a frame that was taken in "
        "a box."
    )


# Reconstructions: what is asked for, and what it came to.

#: Most views that are fused, the query's own among them.
MOST_VIEWS = 32


class NewReconstruction(Given):
    """Views of an answer to fuse, and the kind of result."""

    frames: tuple[Named, ...] | None = Field(
        default=None,
        min_length=1,
        max_length=64,
        description="Ids of accepted matches; default: all accepted ones, at most the first "
        f"{MOST_VIEWS - 1} of the ranking.",
    )
    strength: Literal["strong", "any"] = Field(
        default="any", description="`strong`: exclude matches whose acceptance is weak."
    )
    include_query: bool = Field(
        default=True,
        description="Whether to fuse the query itself, as the first view; clouds cannot be fused.",
    )
    voxel_m: float | None = Field(
        default=None,
        ge=0.002,
        le=0.5,
        description="Edge of a voxel, metres; default: the spacing of the samples, at least "
        "0.01, as far as memory allows.",
    )
    output: Literal["mesh", "cloud"] = Field(
        default="mesh", description="Content of mesh.ply: triangles, or points only."
    )


class FusedView(ApiRecord):
    """One view of a reconstruction."""

    frame_id: str | None = Field(description="Null for the query's own view.")
    map: str | None
    rank: int | None = Field(description="Place in the ranking R, from 1.")
    strength: Literal["strong", "weak"] | None = Field(
        description="Strength of the match's acceptance."
    )
    source: Literal["upload", "geometry"] = Field(
        description="`upload`: the depth that was sent. `geometry`: the reduced depth that "
        "validation compares, used for the query and for lost uploads."
    )
    samples: int = Field(description="Number of depth samples within the fused range.")
    added_m2: float = Field(
        description="Area of the surface that this view sees and no earlier view does, square "
        "metres."
    )


class LeftOut(ApiRecord):
    """A match that was not fused; clouds are not fused, as only depth images carve space."""

    frame_id: str
    map: str
    reason: str


class Coverage(ApiRecord):
    """The surface and volume that the views show together, as in the paper's last figure."""

    views: list[FusedView] = Field(
        description="The views in the order of the ranking, the query first."
    )
    left_out: list[LeftOut]
    area_m2: float = Field(description="Area of the fused surface; the sum of all `added_m2`.")
    observed_volume_m3: float = Field(
        description="Volume known to be empty or surface: between the cameras and the surfaces "
        "that they saw."
    )
    query_explained: float = Field(
        description="Share of the query's points that the other views see as well, 0 to 1."
    )
    voxel_m: float
    points: int
    triangles: int = Field(description="Number of triangles; 0 for a cloud.")


class Reconstruction(Product):
    """A fusion of an answer's views: a job with its result."""

    noun, collection, request_type = "reconstruction", "reconstructions", NewReconstruction

    query_id: str
    maps: list[str] = Field(description="Maps of the fused frames.")
    request: NewReconstruction
    parent_frame: str = Field(
        description="Frame of mesh.ply: that of the query's sensor, metres; of a camera x "
        "right, y down, z forward."
    )
    result: Coverage | None = Field(
        description="The result of a job that has succeeded; then GET "
        "/v1/reconstructions/{job_id}/mesh.ply returns the surface."
    )
