"""The fused surface of a map as JSON: where its tiles are, and which frames saw a spot."""

from __future__ import annotations

from datetime import datetime
from typing import Literal

from pydantic import Field

from sceneprint_client.api.base import ApiRecord, Vector
from sceneprint_client.api.coverage import UpSource
from sceneprint_client.api.frames import Kind

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
