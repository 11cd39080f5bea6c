"""One map for a robot's own store: its head, and parts of rows that are named by digest."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from sceneprint_client.api.base import DIGEST, ApiRecord

#: Most parts that a robot says it has: of a map of three million frames.
MOST_PARTS = 3_500

Digest = Annotated[str, Field(pattern=DIGEST)]


class CopyRequest(ApiRecord):
    """The parts of a map that the caller already has."""

    have: list[Digest] = Field(default=[], max_length=MOST_PARTS)


class CopyPart(ApiRecord):
    """A part of a map: rows of some frames, one after the other in the order they came."""

    digest: Digest = Field(description="SHA-256 of its bytes.")
    bytes: int
    rows: int
    sent: bool = Field(description="Its bytes follow the head.")


class MapCopy(ApiRecord):
    """The head of a copy: the map at one moment, and all parts of its rows."""

    name: str
    title: str | None
    up: Annotated[list[float], Field(min_length=3, max_length=3)] | None
    created_at: float = Field(description="Seconds since 1970.")
    revision: int
    model_id: str
    model: str = Field(description="The model's name.")
    parts: list[CopyPart]
