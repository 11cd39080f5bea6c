"""Reconstructions as JSON: what is asked for, and what it came to."""

from __future__ import annotations

from datetime import datetime
from typing import Literal

from pydantic import Field

from sceneprint_client.api.base import ApiRecord, Given, JobState
from sceneprint_client.api.options import Named

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


class ReconstructionFile(ApiRecord):
    """What a reconstruction made."""

    name: Literal["mesh.ply", "picture.png"]
    media_type: str
    bytes: int


class Reconstruction(ApiRecord):
    """Views of an answer, fused by a worker."""

    job_id: str = Field(description="Its own id too; /v1/jobs tells more, and cancels it.")
    query_id: str
    maps: list[str] = Field(description="Whose frames are fused.")
    state: JobState
    error: str | None
    created_at: datetime
    finished_at: datetime | None
    request: NewReconstruction
    parent_frame: str = Field(
        description="Coordinates of mesh.ply: those of the query's sensor, metres; of a camera "
        "x right, y down, z forward."
    )
    coverage: Coverage | None = Field(default=None, description="When it has succeeded.")
    files: list[ReconstructionFile] = Field(
        default=[], description="GET /v1/reconstructions/{job_id}/{name}."
    )
