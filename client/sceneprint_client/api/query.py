"""Queries and answers as JSON."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, field_validator, model_validator

from sceneprint_client.api.base import ApiRecord, Given, Transform
from sceneprint_client.api.frames import GivenPose, Kind
from sceneprint_client.api.listing import Filter, parsed
from sceneprint_client.api.matches import (
    Alternative,
    ExplainedFrame,
    Explanation,
    Location,
    Match,
    Uncertainty,
    Verifier,
)
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
#: Frames of a sequence that is asked at once, at most.
MOST_OF_SEQUENCE = 10
#: Deviations of a prior, from and to, metres and radians: what is beyond means nothing, or cannot
#: be computed with.
LEAST_DEVIATION, MOST_DEVIATION = 1e-6, 1000.0
#: How far from the origin of its parent frame a prior may lie, metres.
FARTHEST_PRIOR = 1e9
#: The likeliest cause of an answer `not_found`.
Cause = Literal[
    "no_frames", "deadline", "too_little_in_view", "one_plane", "gravity", "other_sensor", "scale",
    "nothing_alike",
]  # fmt: skip


class Prior(Given):
    """What a robot believes of its pose before it asks: T_parent_query and how sure that is."""

    pose: GivenPose = Field(
        description="Of the query's sensor in a parent frame of the map; `parent_frame` is needed. "
        f"Along each axis {FARTHEST_PRIOR:,.0f} m from the origin at most."
    )
    covariance: Annotated[list[float], Field(min_length=36, max_length=36)] | None = Field(
        default=None,
        description="6 x 6, row by row, of errors (x, y, z, rx, ry, rz) in the parent's axes, as "
        "ROS orders PoseWithCovariance: metres and radians. The deviations, which are the roots of "
        f"its diagonal, are from {LEAST_DEVIATION} to {MOST_DEVIATION:.0f}.",
    )
    deviation_m: float = Field(
        default=0.3,
        ge=LEAST_DEVIATION,
        le=20,
        description="In place of `covariance`: along each axis.",
    )
    deviation_deg: float = Field(
        default=10.0, ge=1e-4, le=180, description="In place of `covariance`: about each axis."
    )

    @model_validator(mode="after")
    def _in_a_parent_frame(self) -> Prior:
        if self.pose.parent_frame is None:
            raise ValueError("a prior needs pose.parent_frame: the one of the map's poses")
        if self.pose.of != "sensor":
            raise ValueError("a prior is the pose of the sensor: leave `of` out")
        return self


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
    prior: Annotated[Prior | None, JsonText] = Field(
        default=None,
        description="What the robot believes of its pose. Candidates near it are tried first, and "
        "it is refined on the map beside the search over all; it decides only between poses that "
        "the map bears out alike.",
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
    record: bool = Field(
        default=True,
        description="Leave a record in GET /v1/queries, an event, and a count in the figures.",
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
        description="`found`: one pose is supported, and no other comes near; where no accepted "
        "match has a pose, a match is accepted. `ambiguous`: the evidence supports several poses, "
        "or one that it does not confirm: never drive on it. `not_found`: nothing is supported, "
        "see `cause`. `unvalidated`: validation was not asked for, or the deadline came before a "
        "match was accepted."
    )
    reason: str = Field(
        default="", description="Why, in a sentence; of `not_found` with what to do next."
    )
    cause: Cause | None = Field(default=None, description="The likeliest of `not_found`.")
    matches: list[Match] = Field(
        description="Accepted ones first, strong before weak, then the most precise, or, of scans "
        "all around, the nearest first; then the others that were tried."
    )
    location: Location | None = Field(
        description="Where the query was taken: where it is `found`, and the matches have poses."
    )
    alternatives: list[Alternative] = Field(
        default=[],
        description="Of `ambiguous`: the poses that the evidence supports, the best first.",
    )
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
        "`validate`, `locate`, `explain` where it was asked for, `earlier` for the earlier frames "
        "of a sequence, `total`."
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
    frames: int = Field(
        default=1, description="Of the query: with a sequence, `matches` are those of the last."
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
        description="`found`: one pose is supported, and no other comes near. `ambiguous`: several "
        "are, see `alternatives`, or one that is not confirmed: move on and ask again. "
        "`not_found`: none is, see `cause`, or the deadline came before."
    )
    reason: str
    cause: Cause | None = Field(default=None, description="The likeliest of `not_found`.")
    map: str
    pose: Transform | None = Field(
        description="T_parent_query: the query's camera in the parent frame of its matches' "
        "poses. Null unless `found`, and where no accepted match has a pose: see `best`."
    )
    support: int = Field(
        description="Matches that agree on the pose; 1 is one view, which nothing confirms."
    )
    votes: int = Field(description="Accepted matches, whatever pose they vote for.")
    spread_m: float | None = Field(description="Of the votes; null without a pose.")
    spread_deg: float | None
    uncertainty: Uncertainty | None = Field(default=None, description="Of `pose`.")
    base: Transform | None = Field(
        default=None,
        description="As `pose`, of the robot's base: where the query has T_base_sensor.",
    )
    strength: Literal["strong", "weak"] | None = Field(
        description="`strong` where a match that votes for the pose is; null unless `found`."
    )
    verified_by: Verifier | None = Field(
        default=None,
        description="What decided, as in `location` of an answer; null unless `found`.",
    )
    rival_ratio: float | None = Field(
        default=None,
        description="How near another place comes, 0 to 1; null where the map was not asked.",
    )
    alternatives: list[Alternative] = Field(
        default=[],
        description="Of `ambiguous`: the poses that the evidence supports, the best first.",
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
