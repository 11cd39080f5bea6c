"""Where a robot is, in one record."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from sceneprint.schemas.base import Told
from sceneprint.schemas.matches import Match, Uncertainty
from sceneprint.schemas.transforms import Transform

LocalizationStatus = Literal["found", "ambiguous", "not_found"]


class Localization(Told):
    """Where the query was taken, if that is known."""

    status: LocalizationStatus = Field(
        description="`found`: a match is accepted. `ambiguous`: none is, and one fits in several "
        "ways: move on and ask again. `not_found`: none is, or the deadline came before."
    )
    reason: str
    map: str
    pose: Transform | None = Field(
        description="T_parent_query: the query's camera in the parent frame of its matches' "
        "poses. Null unless `found`, and where no accepted match has a pose: see `best`."
    )
    support: int = Field(description="Matches that agree on the pose.")
    votes: int = Field(description="Matches that were asked for it.")
    spread_m: float | None = Field(description="Of the votes; null without a pose.")
    spread_deg: float | None
    uncertainty: Uncertainty | None = Field(default=None, description="Of `pose`.")
    base: Transform | None = Field(
        default=None,
        description="As `pose`, of the robot's base: where the query has T_base_sensor.",
    )
    strength: Literal["strong", "weak"] | None = Field(
        description="`strong` where any accepted match is; null where none is accepted."
    )
    best: Match | None = Field(
        description="The accepted match to believe first, with the transform to it."
    )
    matches: list[str] = Field(description="Ids of the accepted matches, in the order of belief.")
    query_id: str
    seed: int
    model: str
    deadline_reached: bool | None = None
    milliseconds: dict[str, float]
