"""How a map grew, as JSON."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Literal

from pydantic import Field

from sceneprint.schemas.base import Given, Told

By = Literal["hour", "day"]


class GrowthOf(Given):
    """Which part of a map's past is told, and how finely."""

    by: By = Field(default="day", description="What frames are counted by, in UTC.")
    last: Annotated[int, Field(ge=1, le=400)] = Field(
        default=30, description="Hours or days, with the one that is not over."
    )


class Grown(Told):
    """An hour or a day of a map."""

    at: datetime = Field(description="When it began.")
    indexed: int = Field(description="Frames that were indexed in it.")
    total: int = Field(description="Frames that were indexed in it or before.")


class Growth(Told):
    """How a map grew. Frames that are not there any more are not counted anywhere."""

    map: str
    by: By
    indexed: int = Field(description="Frames that are indexed now; the last `total`.")
    before: int = Field(description="Of them, those of before the first bucket.")
    buckets: list[Grown] = Field(description="The oldest first; the last is not over yet.")
