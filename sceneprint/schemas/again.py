"""How a query was asked, as JSON: so that it can be understood, and asked again."""

from __future__ import annotations

from typing import Any

from pydantic import Field

from sceneprint.schemas.base import Told
from sceneprint.schemas.frames import Kind
from sceneprint.schemas.options import FrameName


class Question(Told):
    """What was asked, and how."""

    query_id: str
    maps: list[str] = Field(description="The maps that were asked.")
    frame: FrameName | None = Field(
        description="The stored frame that was asked for; null for an upload."
    )
    kind: Kind = Field(description="Of the frame that was asked for.")
    robot: str | None = Field(description="Who took an uploaded frame, as it was told.")
    session: str | None
    asked_at: str = Field(description="When, in UTC.")
    validates: bool = Field(
        description="Its points are kept, so that it can be asked again with the stage `validate`."
    )
    model: str
    options: dict[str, Any] = Field(
        description="As they were given; what was left out had its default."
    )
