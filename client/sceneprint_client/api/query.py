"""Queries and answers as JSON."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, field_validator

from sceneprint_client.api.base import ApiRecord, Given, Transform
from sceneprint_client.api.frames import Kind
from sceneprint_client.api.listing import Filter, parsed
from sceneprint_client.api.matches import ExplainedFrame, Explanation, Location, Match, Uncertainty
from sceneprint_client.api.options import (
    MOST_MAPS,
    STAGES,
    Diversity,
    FrameName,
    JsonText,
    Named,
    NamedFrame,
    Stage,
    ValidationOptions,
)

AnswerStatus = Literal["found", "ambiguous", "not_found", "unvalidated"]


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
        default=False,
        description="Compare every frame of the map that passes the filter. Most queries do so "
        "anyway: only in a very large map, or where PostgreSQL searches, are some left out.",
    )
    filter: Filter | None = Field(
        default=None,
        description="Only frames that pass it are searched, and as many are found as exist.",
    )
    seed: int = Field(
        default=0, ge=0, lt=2**32, description="Of the random choices; the answer echoes it."
    )
    candidates: int | None = Field(
        default=None,
        ge=1,
        le=200,
        description="How many of the ranking are selected and validated until `k` are accepted, "
        "some 20 ms each; default: 10, or `k` where that is more. Without validation `k` counts.",
    )
    diversity: Annotated[Diversity | None, JsonText] = Field(
        default=None, description="The scales of the selection."
    )
    validation: Annotated[ValidationOptions | None, JsonText] = Field(
        default=None, description="What a match must stand to be accepted."
    )
    deadline_ms: int | None = Field(
        default=None,
        ge=1,
        le=600_000,
        description="Counted from when the request came. No candidate is begun that would likely "
        "be validated too late; the ranking and the selection are always made.",
    )
    explain: bool = Field(
        default=False, description="Say of every frame of the ranking how far it came, and why."
    )
    explain_frame: Named | None = Field(
        default=None,
        description="A frame of the map: say where it was lost. It is compared and validated for "
        "this even where the query did not. Of several maps, the first that has one of this id.",
    )
    keep: bool = Field(
        default=True,
        description="Keep the answer for a while, so that GET /v1/queries/{query_id} has it.",
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


class SeveralQuery(Query):
    """How to ask several maps of one model at once."""

    maps: Literal["*"] | Annotated[list[Named], Field(min_length=1, max_length=MOST_MAPS)] = Field(
        description=f"Their names, at most {MOST_MAPS}; `*` for all that you may read. A form and "
        "a query string have them with commas between."
    )
    frame: NamedFrame | None = Field(
        default=None, description="A stored frame, in place of an upload; it does not find itself."
    )

    @field_validator("maps", mode="before")
    @classmethod
    def _names(cls, maps: object) -> object:
        if isinstance(maps, str) and maps.strip() != "*":
            return [one.strip() for one in maps.split(",")]
        return maps.strip() if isinstance(maps, str) else maps


class Counts(ApiRecord):
    """How many frames each stage saw."""

    map: int = Field(description="Frames of the map that can be found.")
    passed: int = Field(description="Of them those that pass the filter; all without one.")
    compared: int = Field(description="Of these those whose distance was computed.")
    ranked: int
    selected: int
    validated: int
    accepted: int


class OfMap(ApiRecord):
    """What one of several maps had of a query."""

    index_generation: int = Field(
        description="0 where it was searched without an index of this node."
    )
    counts: Counts


class Answer(ApiRecord):
    """What a query comes back with."""

    query_id: str
    status: AnswerStatus = Field(
        description="`found`: at least one match is accepted. `ambiguous`: none is, and one fits "
        "in several ways. `unvalidated`: validation was not asked for, or the deadline came "
        "before a match was accepted."
    )
    matches: list[Match] = Field(
        description="Accepted ones first, strong before weak, then the most precise, or, of scans "
        "all around, the nearest first; then the others that were tried."
    )
    location: Location | None = Field(description="Where accepted matches have poses.")
    seed: int
    model: str
    index_generation: int = Field(
        description="0 where the map was searched without an index of this node: a small one, "
        "one that PostgreSQL searched, or one whose model stores psi. Of several maps the least."
    )
    exact: bool = Field(description="Every frame that passes the filter was compared.")
    counts: Counts
    milliseconds: dict[str, float] = Field(
        description="`prepare` (signature and geometry of the query), `retrieve`, `diversify`, "
        "`validate`, `explain` where it was asked for, `total`."
    )
    maps: list[str] = Field(default=[], description="The maps that were asked.")
    frame: FrameName | None = Field(
        default=None,
        description="The stored frame that was asked for; null for an upload. Transforms call its "
        "sensor by its id where its own map alone was asked, and `query` else.",
    )
    kind: Kind = Field(
        default="depth",
        description="Of the frame that was asked for. Transforms call the sensor of a depth image "
        "`ID.optical` (x right, y down, z forward), and that of a cloud, which keeps its axes, "
        "`ID.sensor`.",
    )
    per_map: dict[str, OfMap] | None = Field(
        default=None, description="What each of several maps had; null where one was asked."
    )
    deadline_reached: bool | None = Field(
        default=None,
        description="Whether candidates were left out for want of time; null without a deadline.",
    )
    replica_behind_s: float | None = Field(
        default=None,
        description="Answered from a read replica: what was stored or deleted so many seconds "
        "before the query came, or earlier, is taken into account. Null: answered from the "
        "database itself, as of now.",
    )
    explanations: list[Explanation] | None = Field(
        default=None, description="With `explain`: every frame of the ranking, the nearest first."
    )
    explained_frame: ExplainedFrame | None = Field(
        default=None, description="With `explain_frame`: what became of that one."
    )


# Where a robot is, in one record.

LocalizationStatus = Literal["found", "ambiguous", "not_found"]


class Localization(ApiRecord):
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
