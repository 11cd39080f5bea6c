"""Queries and answers as JSON."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, field_validator

from sceneprint.schemas.base import Given, Told
from sceneprint.schemas.filters import Filter, parsed
from sceneprint.schemas.transforms import Transform

Stage = Literal["retrieve", "diversify", "validate"]
STAGES: tuple[Stage, ...] = ("retrieve", "diversify", "validate")

AnswerStatus = Literal["found", "ambiguous", "not_found", "unvalidated"]
ValidationStatus = Literal["accepted", "rejected", "ambiguous", "skipped"]


class Query(Given):
    """How to ask; the same whether the frame is uploaded or named."""

    k: int = Field(
        default=5, ge=1, le=50, description="Accepted matches wanted (or matches, unvalidated)."
    )
    stages: tuple[Stage, ...] = Field(
        default=STAGES,
        description="R, DR, VR or VDR of the paper: always from `retrieve`, in this order.",
    )
    exact: bool = Field(
        default=False, description="Compare every frame of the map that passes the filter."
    )
    filter: Filter | None = Field(
        default=None,
        description="Only frames that pass it are searched, and as many are found as exist.",
    )
    seed: int = Field(
        default=0, ge=0, lt=2**32, description="Of the random choices; the answer echoes it."
    )

    @field_validator("stages", mode="before", json_schema_input_type=str | tuple[Stage, ...])
    @classmethod
    def _from_text(cls, stages: object) -> object:
        """As a form and a command line give them: one text with commas."""
        if isinstance(stages, str):
            return [one.strip() for one in stages.split(",")]
        if isinstance(stages, list | tuple):
            return stages
        # pydantic would speak of tuples, as Python does
        raise ValueError("give a list of stages, or a text with commas between them")

    @field_validator("filter", mode="before", json_schema_input_type=str | Filter | None)
    @classmethod
    def _from_json(cls, given: object) -> object:
        return parsed(given)

    @field_validator("stages")
    @classmethod
    def _in_order(cls, stages: tuple[Stage, ...]) -> tuple[Stage, ...]:
        if stages != tuple(stage for stage in STAGES if stage in stages) or not stages:
            raise ValueError("name stages once, in the order retrieve, diversify, validate")
        if stages[0] != "retrieve":
            raise ValueError("every query begins with retrieve")
        return stages


class Residual(Told):
    """Both directions composed: the identity if they agreed."""

    translation_m: float
    rotation_deg: float


class Validation(Told):
    """What came of aligning the query with a match."""

    status: ValidationStatus = Field(description="`skipped`: enough others had been accepted.")
    strength: Literal["strong", "weak"] | None = Field(
        default=None, description="Of an accepted match."
    )
    reason: str
    residual: Residual | None = None
    overlap: float | None = Field(
        default=None, description="Share of both frames' points that agree."
    )
    plane_overlap: float | None = Field(
        default=None, description="The same, every plane counting alike."
    )
    free_space_violations: float | None = Field(
        default=None, description="Share that lies where the other frame saw through."
    )
    inliers: int | None = Field(default=None, description="Points of both frames that agree.")
    ambiguity: float | None = Field(
        default=None,
        description="Share that the best rival explains.",
    )


class Match(Told):
    """A database frame returned for a query."""

    frame_id: str
    map: str
    robot: str | None
    session: str | None
    rank: int = Field(description="Place in the ranking R, from 1.")
    distance: int = Field(description="L1 distance of the stored signatures.")
    similarity: float = Field(description="1 - distance / that of unrelated frames, 0 to 1.")
    selected: bool | None = Field(
        description="In the diverse selection C; null without that stage."
    )
    diversity_gain: float | None = Field(description="1 for the first; near 0 for a duplicate.")
    validation: Validation
    transform: Transform | None = Field(description="Query to match; believe it where accepted.")
    pose_in_map: Transform | None = Field(
        description="The query in the parent frame of the match's pose, where that is known."
    )


class Location(Told):
    """The query's pose averaged over its accepted matches."""

    pose: Transform
    support: int = Field(description="Matches that agree on it.")
    votes: int = Field(description="Matches that were asked.")
    spread_m: float
    spread_deg: float


class Counts(Told):
    """How many frames each stage saw."""

    map: int = Field(description="Frames of the map that can be found.")
    passed: int = Field(description="Of them those that pass the filter; all without one.")
    compared: int = Field(description="Of these compared by their whole signature.")
    ranked: int
    selected: int
    validated: int
    accepted: int


class Answer(Told):
    """What a query comes back with."""

    query_id: str
    status: AnswerStatus = Field(
        description="`found`: at least one match is accepted. `ambiguous`: none is, and one fits "
        "in several ways. `unvalidated`: validation was not asked for."
    )
    matches: list[Match] = Field(
        description="Accepted ones first, strong before weak; then the others that were tried."
    )
    location: Location | None = Field(description="Where accepted matches have poses.")
    seed: int
    model: str
    index_generation: int = Field(description="0 where the map is scanned without an index.")
    exact: bool = Field(description="Every frame that passes the filter was compared.")
    counts: Counts
    milliseconds: dict[str, float] = Field(
        description="`prepare` (signature and geometry of the query), `retrieve`, `diversify`, "
        "`validate`, `total`."
    )
