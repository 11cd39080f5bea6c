"""One map for a robot's own store, as JSON: what it is, which frames it has, and their rows."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Base64Bytes, Field

from sceneprint_client.api.base import DIGEST, ApiRecord, Page

#: Frames whose rows are told in one answer, and frames that are listed in one.
MOST_ROWS, MOST_LISTED = 50, 1000

Digest = Annotated[str, Field(pattern=DIGEST)]
# a whole number stays one: rows are told apart by their JSON
_Three = Annotated[list[int | float], Field(min_length=3, max_length=3)]
_Four = Annotated[list[int | float], Field(min_length=4, max_length=4)]
_Matrix = Annotated[list[_Four], Field(min_length=4, max_length=4)]


class ListedFrame(ApiRecord):
    """An indexed frame of a map."""

    frame_id: str
    tag: str = Field(description="Another one as soon as anything of its row changes.")


class MapListing(Page[ListedFrame]):
    """A map, and a part of the list of its indexed frames, in the order they came."""

    name: str
    title: str | None
    up: _Three | None
    created_at: float = Field(description="Seconds since 1970.")
    revision: int = Field(
        description="List the map again where it differs from that of the part before."
    )
    model_id: str
    model: str = Field(description="The model's name.")


class FrameRowRecord(ApiRecord):
    """All that a store knows of an indexed frame, but for its upload."""

    frame_id: str
    content_id: str | None
    blob: Digest = Field(description="Of the upload, which is not copied.")
    bytes: int
    intrinsics: dict[str, Any] | None
    depth_scale: float
    depth_along_ray: bool
    robot: str | None
    session: str | None
    captured_at: float | None
    tags: list[str]
    pose_parent: str | None
    pose: _Matrix | None
    sent_parent: str | None
    sent_pose: _Matrix | None
    base_frame: str | None
    base: _Matrix | None
    novelty: float | None
    received_at: float
    indexed_at: float | None
    cloud: dict[str, Any] | None
    up: _Three | None
    name: str | None
    sequence: int | None
    samples: dict[str, Any] | None
    vector: Base64Bytes = Field(description="The signature.")
    geometry: Digest = Field(description="Of the artifact.")
    n_patches: list[int]
    n_pairs: list[int]


class FrameRows(ApiRecord):
    """Rows of some frames; those that are not indexed, or not there, are left out."""

    items: list[FrameRowRecord]
