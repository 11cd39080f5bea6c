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
    """All tiles of a parent frame that have cells of one width."""

    level: int = Field(description="0 has the finest cells; those of each next one are 4 times as "
                       "wide.")  # fmt: skip
    cell_m: float = Field(description="Width of a cell.")
    tile_m: float = Field(description="Width of a tile: 64 cells.")
    tiles: int
    cells: int = Field(description="Of all tiles together.")
    bytes: int


class SurfacePlan(ApiRecord):
    """Where the picture of a parent frame lies, as `plan.png` has it without `width`."""

    m_per_pixel: float
    width: int = Field(description="Pixels.")
    height: int
    left: float = Field(description="Of the picture's upper left corner along `x_axis`, metres.")
    top: float = Field(description="The same along `y_axis`.")


class SurfaceParent(ApiRecord):
    """The surface in one parent frame."""

    parent_frame: str
    frames: int = Field(description="Frames whose surfaces are fused.")
    up: Vector = Field(description="Unit vector, in the parent frame.")
    up_from: UpSource = Field(
        description="How the vertical is known. `map`: the map's `up`. `frames`: the `up` of its "
        "frames. `cameras`: guessed, the axis nearest to the cameras' upright."
    )
    x_axis: list[float] = Field(
        min_length=3, max_length=3, description="Unit vector to the right of the plan."
    )
    y_axis: list[float] = Field(
        min_length=3, max_length=3, description="Unit vector to the top of the plan."
    )
    low: Vector = Field(description="Corner of the box that holds all cells, and the other one:")
    high: Vector
    levels: list[SurfaceLevel] = Field(description="The finest first.")
    plan: SurfacePlan


class MapSurface(ApiRecord):
    """What the posed frames of a map saw, fused; and whether that is up to date."""

    map: str
    state: SurfaceState = Field(
        description="`none`: not built. `building`: a job is at it; the tiles that are there can "
        "be read. `ready`: of all indexed frames that have poses. `stale`: frames came, went or "
        "moved since."
    )
    job_id: str | None = Field(description="Of the latest job: GET /v1/jobs/{job_id}.")
    error: str | None = Field(description="Of that job, where it failed.")
    frames: int = Field(description="Frames whose surfaces are fused.")
    frames_left: int = Field(description="Frames that are to be added or taken out, about.")
    updated_at: datetime | None = Field(description="When a tile last changed.")
    sessions: list[str] = Field(description="A cell names its session by its place in this list.")
    first_taken: datetime | None = Field(description="Of the fused frames with `captured_at`.")
    last_taken: datetime | None
    taken_from: datetime | None = Field(
        description="A cell was last seen at `taken_from` plus `taken` times `taken_step_s`. Null "
        "where no fused frame has `captured_at`."
    )
    taken_step_s: float
    parents: list[SurfaceParent] = Field(description="The one of most frames first; at most 20.")


class SurfaceTile(ApiRecord):
    """A cube of 64 cells along each side."""

    column: int = Field(
        description="It reaches from `column` times `tile_m` to `column` + 1 times along the x "
        "axis of the parent frame."
    )
    row: int = Field(description="The same along y.")
    floor: int = Field(description="The same along z.")
    cells: int = Field(description="Cells that are not empty.")
    bytes: int
    digest: str = Field(
        description="GET /v1/maps/{map}/surface/tiles/{digest} has its cells. Another one when "
        "they change."
    )


class SurfaceSighting(ApiRecord):
    """A frame that saw a spot, or was taken in a box."""

    frame_id: str
    name: str | None
    kind: Kind
    robot: str | None
    session: str | None
    captured_at: datetime | None
    parent_frame: str
    position: Vector = Field(description="Of its sensor, in the parent frame.")
    distance_m: float | None = Field(
        description="From its sensor to the spot; null of a frame that was taken in a box."
    )


# Reconstructions: what is asked for, and what it came to.

#: Most views that are fused, the query's own among them.
MOST_VIEWS = 32


class NewReconstruction(Given):
    """Which views of an answer to fuse, and to what."""

    frames: tuple[Named, ...] | None = Field(
        default=None,
        min_length=1,
        max_length=64,
        description="Ids of accepted matches; default: all accepted ones, at most "
        f"{MOST_VIEWS - 1}, the first of the ranking.",
    )
    strength: Literal["strong", "any"] = Field(
        default="any", description="`strong`: leave out matches whose acceptance is weak."
    )
    include_query: bool = Field(
        default=True,
        description="Fuse what the query itself saw as well, as the first view; but no cloud.",
    )
    voxel_m: float | None = Field(
        default=None,
        ge=0.002,
        le=0.5,
        description="Edge of a voxel, metres; default: as fine as the samples lie, at least "
        "0.01, and as memory allows.",
    )
    output: Literal["mesh", "cloud"] = Field(
        default="mesh", description="What mesh.ply holds: triangles, or points alone."
    )


class FusedView(ApiRecord):
    """One view of a reconstruction."""

    frame_id: str | None = Field(description="Null for the query's own view.")
    map: str | None
    rank: int | None = Field(description="Place in the ranking R, from 1.")
    strength: Literal["strong", "weak"] | None = Field(description="Of the match's acceptance.")
    source: Literal["upload", "geometry"] = Field(
        description="`upload`: its depth as it was sent. `geometry`: the reduced depth that "
        "validation compares; so it is for the query, and where an upload is lost."
    )
    samples: int = Field(description="Depth samples within the range that is fused.")
    added_m2: float = Field(
        description="Square metres of the surface that this view sees and none before it does."
    )


class LeftOut(ApiRecord):
    """A match that could not be fused: point clouds are not, as only depth images carve space."""

    frame_id: str
    map: str
    reason: str


class Coverage(ApiRecord):
    """What the views show together: the paper's last figure."""

    views: list[FusedView] = Field(description="In the order of the ranking, the query first.")
    left_out: list[LeftOut]
    area_m2: float = Field(description="Of the fused surface; the sum of all `added_m2`.")
    observed_volume_m3: float = Field(
        description="Space known to be empty or surface: between the cameras and what they saw."
    )
    query_explained: float = Field(
        description="Share of the query's points that the other views see too, 0 to 1."
    )
    voxel_m: float
    points: int
    triangles: int = Field(description="0 where a cloud was asked for.")


class Reconstruction(Product):
    """Views of an answer, fused by a worker."""

    noun, collection, request_type = "reconstruction", "reconstructions", NewReconstruction

    query_id: str
    maps: list[str] = Field(description="Whose frames are fused.")
    request: NewReconstruction
    parent_frame: str = Field(
        description="Coordinates of mesh.ply: those of the query's sensor, metres; of a camera "
        "x right, y down, z forward."
    )
    result: Coverage | None = Field(
        description="When it has succeeded; GET /v1/reconstructions/{job_id}/mesh.ply then."
    )
