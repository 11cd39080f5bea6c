"""Records for copying a map to a robot: a header, and parts that are identified by digests."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from sceneprint_client.api.base import DIGEST, ApiRecord

#: Maximum number of parts in a request, enough for a map of three million frames.
MOST_PARTS = 3_500

Digest = Annotated[str, Field(pattern=DIGEST)]


class CopyRequest(ApiRecord):
    """The parts of a map that the caller already has."""

    have: list[Digest] = Field(default=[], max_length=MOST_PARTS)


class CopyPart(ApiRecord):
    """A part of a map, with the rows of consecutive frames in the order of their upload."""

    digest: Digest = Field(description="SHA-256 of the bytes of the part.")
    bytes: int
    rows: int
    sent: bool = Field(description="Whether the bytes of the part follow the header.")


class MapCopy(ApiRecord):
    """The header of a copy, with the state of the map at one point in time and all its parts."""

    name: str
    title: str | None
    up: Annotated[list[float], Field(min_length=3, max_length=3)] | None
    created_at: float = Field(description="Creation time, seconds since 1970.")
    revision: int
    model_id: str
    model: str = Field(description="Name of the model.")
    parts: list[CopyPart]
