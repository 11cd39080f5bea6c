"""Queries, matches and answers as JSON; where the defaults are from: docs/evaluation.md."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BeforeValidator, Field, StringConstraints, field_validator, model_validator

from sceneprint_client.api.base import ApiRecord, Given, GivenPose, Transform, Vector
from sceneprint_client.api.frames import Kind
from sceneprint_client.api.listing import Filter, parsed

Stage = Literal["retrieve", "diversify", "validate"]
STAGES: tuple[Stage, ...] = ("retrieve", "diversify", "validate")

#: Most maps that one query asks.
MOST_MAPS = 64

#: A map's name or a frame's id as it is asked for; whether there is such a one is found out later.
Named = Annotated[str, StringConstraints(min_length=1, max_length=128)]

#: A part of a whole.
Share = Annotated[float, Field(ge=0.0, le=1.0)]

#: An object in JSON; a form and a query string give it as text.
JsonText = BeforeValidator(parsed)


class NamedFrame(Given):
    """A stored frame, named in a request."""

    map: Named = Field(description="Name of its map.")
    frame_id: Named


class FrameName(ApiRecord):
    """A stored frame that the request named."""

    map: str
    frame_id: str


class Diversity(Given):
    """The scales of the determinantal point process, Eq. 3 of the paper."""

    sigma: float = Field(
        default=1.0,
        ge=0.01,
        le=100.0,
        description="Factor on the median distance within the ranking: with a greater one, more "
        "frames count as similar.",
    )
    omega: float = Field(
        default=4.0,
        ge=0.01,
        le=1000.0,
        description="Factor on the ranking's span of distances: a greater one gives diversity "
        "more weight than rank.",
    )


class ValidationOptions(Given):
    """Requirements on accepted matches.

    Omitted values are those of the map's model; the stated defaults are those of `depth`.
    """

    mode: Literal["full", "paper"] = Field(
        default="full",
        description="`paper`: only the residual of the two directions decides, and more wrong "
        "matches are accepted.",
    )
    residual_m: float = Field(
        default=0.08, gt=0, le=1.0, description="Maximum distance between both directions."
    )
    residual_deg: float = Field(
        default=5.0, gt=0, le=45.0, description="Maximum rotation between both directions."
    )
    evidence: Share = Field(
        default=0.2,
        description="Minimum `overlap` - `violation_weight` x `free_space_violations`. By "
        "default, half of it suffices for a weak match if little is shared and all of it "
        "agrees.",
    )
    violation_weight: float = Field(default=5.0, ge=0.0, le=100.0)
    plane_overlap: Share = Field(
        default=0.15, description="Minimum overlap with every plane counting the same."
    )
    strong: Share = Field(
        default=0.3, description="Evidence below which an accepted match is weak."
    )
    weak: Share = Field(
        default=0.05, description="`ambiguity` from which on an accepted match is weak."
    )
    ambiguous: Share = Field(
        default=0.14, description="`ambiguity` from which on no match is accepted."
    )
    ambiguous_share: float = Field(
        default=0.5,
        ge=0.0,
        le=10.0,
        description="Share of `plane_overlap` from which on no match is accepted.",
    )


# Matches of a query.

ValidationStatus = Literal["accepted", "rejected", "ambiguous", "skipped"]


class Residual(ApiRecord):
    """Both directions composed: the identity if they agree."""

    translation_m: float
    rotation_deg: float


class Validation(ApiRecord):
    """The result of aligning the query with a match.

    An accepted pair is evidence that two frames look alike, not that they show the same place: the
    answer's `status` weighs it against the map.
    """

    status: ValidationStatus = Field(
        description="`skipped`: it was not tried, and `reason` says why."
    )
    strength: Literal["strong", "weak"] | None = Field(
        default=None, description="Strength of an accepted match."
    )
    reason: str
    residual: Residual | None = None
    overlap: float | None = Field(
        default=None, description="Share of both frames' points that agree."
    )
    plane_overlap: float | None = Field(
        default=None, description="`overlap` with every plane counting the same."
    )
    free_space_violations: float | None = Field(
        default=None,
        description="Share of points that the other frame saw through; null if neither frame "
        "has a viewpoint.",
    )
    planes: float | None = Field(
        default=None, description="Number of distinct planes that agree, the mean of both frames."
    )
    plane_violations: float | None = Field(
        default=None, description="`free_space_violations` with every plane counting the same."
    )
    inliers: int | None = Field(
        default=None, description="Number of points of both frames that agree."
    )
    ambiguity: float | None = Field(
        default=None,
        description="Share of the points that the best rival explains.",
    )
    search: Literal["correspondences", "plans", "guided"] | None = Field(
        default=None,
        description="Source of the transform: patches with similar surroundings, or the plans "
        "of two scans. `guided`: other matches and the map's poses; it was refined and checked "
        "but not searched for, so it is no independent vote.",
    )
    directions: list[Literal["query_to_match", "match_to_query"]] = Field(
        default=[],
        description="Number of search directions that found it. One direction alone makes an "
        "accepted match weak.",
    )
    tilt_deg: float | None = Field(
        default=None,
        description="Angle by which the transform tilts the query's `up` against the match's; "
        "null if either is unknown.",
    )


class FreeDirection(ApiRecord):
    """A direction in which a transform is poorly constrained, as along a corridor.

    Both parts together have unit length: the error's metres and radians along the direction.
    """

    translation: Vector
    rotation: Vector
    deviation: float = Field(
        description="Standard deviation along it: metres of a shift, radians of a turn; at most "
        "10, if nothing constrains it."
    )


class Uncertainty(ApiRecord):
    """The likely error of a transform, if it is not wrong altogether.

    Errors are (x, y, z, rx, ry, rz): the displacement of the child's origin along the axes of the
    transform's parent frame, metres, then a rotation vector about the parent's axes, radians,
    multiplied from the left. ROS's PoseWithCovariance has the same order and meaning.
    """

    covariance: list[float] = Field(
        min_length=36, max_length=36, description="6 x 6, row by row, in that order."
    )
    method: Literal["information-scaled", "votes-and-spread"] = Field(
        description="`information-scaled`: for one match, the inverse information of its "
        "refinement, scaled to the errors in synthetic rooms. `votes-and-spread`: for several "
        "matches, from their uncertainties and spread. See docs/uncertainty.md."
    )
    degenerate: list[FreeDirection] = Field(
        description="Directions at least 30 times as uncertain as the most certain one, the "
        "most uncertain first."
    )


class Match(ApiRecord):
    """A database frame returned for a query."""

    frame_id: str
    map: str
    robot: str | None
    session: str | None
    name: str | None = Field(default=None, description="Name of the original file or message.")
    sequence: int | None = Field(default=None, description="Position in the session.")
    rank: int = Field(description="Place in the ranking R, from 1.")
    distance: int = Field(description="Distance of the signatures.")
    similarity: float = Field(description="1 - distance / distance of unrelated frames, 0 to 1.")
    selected: bool | None = Field(
        description="Whether it is in the diverse selection C; null without that stage. False: "
        "a frame of another place, which was validated because it looks like the query as well."
    )
    diversity_gain: float | None = Field(
        description="1 for the first match; near 0 for a duplicate."
    )
    validation: Validation
    transform: Transform | None = Field(
        description="Transform from query to match; trust it only if accepted."
    )
    predicted: Transform | None = Field(
        default=None,
        description="For a guided match: `transform` as predicted from the map's poses and the "
        "earlier matches, with an error of up to 15 cm and 6 deg.",
    )
    parent_frame: str | None = Field(
        default=None,
        description="Parent frame in which the frame's pose was sent; null without a pose. If "
        "the map joined it to another, `pose_in_map` is in that one.",
    )
    pose_in_map: Transform | None = Field(
        description="Pose of the query in the parent frame of the match's pose, if that is "
        "known and the match is not rejected."
    )
    uncertainty: Uncertainty | None = Field(
        default=None, description="Uncertainty of `transform`, if the match is accepted."
    )
    base_in_map: Transform | None = Field(
        default=None,
        description="`pose_in_map` for the robot's base, if the query has T_base_sensor.",
    )


#: What decided on a pose.
Verifier = Literal["matches", "map", "prior"]


class EvidenceRecord(ApiRecord):
    """Evidence for and against a pose, from which its `confidence` is computed."""

    score: float = Field(
        description="Degree to which the map's frames confirm the pose: `share`, less the share "
        "that they saw through; at most 1."
    )
    share: float = Field(
        description="Share of the query's surface that the map shows there; every plane counts "
        "the same."
    )
    planes: float = Field(
        description="Number of distinct planes of the query that agree with the map."
    )
    frames: int = Field(description="Number of the map's frames that agree.")
    viewpoints: int = Field(description="Number of different viewpoints of these frames.")
    excess: float = Field(
        description="Share of the surface that should be in sight and is missing, in the query "
        "or the map, beyond what the map's own frames miss among themselves."
    )
    weight: float = Field(
        description="Weight of the matches that vote for the pose, one for each viewpoint: 1 "
        "for a strong match, 0.4 for a weak or ambiguous one."
    )
    strong: int = Field(
        description="Number of different viewpoints of strong matches that vote for it."
    )
    accepted: int = Field(
        description="Number of different viewpoints of accepted matches that lead to it, guided "
        "or not."
    )
    suggested: int = Field(
        description="Number of different viewpoints of candidates that suggest it, accepted or not."
    )
    similarity: float = Field(
        description="Similarity of the signatures of the query and the nearest of these "
        "candidates, 0 to 1."
    )
    rival: float = Field(
        description="Score of the best pose at another place relative to `score`; 0 without "
        "one. If the prior decided, of the places that it expects."
    )
    rival_weight: float = Field(
        description="Largest weight of matches that vote for another place."
    )
    rendered: bool = Field(
        default=False,
        description="Whether most of these frames are rendered views of an imported map, for "
        "which the same numbers give another confidence.",
    )


_CONFIDENCE = (
    "Probability that the pose is right, 0 to 1. Null if it was not compared with the map."
)


class Alternative(ApiRecord):
    """A pose of the query that the evidence supports; at most one of several is right."""

    pose: Transform
    confidence: float | None = Field(default=None, description=_CONFIDENCE)
    evidence: EvidenceRecord | None = Field(
        default=None,
        description="The numbers from which `confidence` is computed; null if that is null.",
    )
    map: str | None = Field(default=None, description="Map whose parent frame the pose is in.")
    support: int = Field(
        description="Number of matches from different viewpoints that vote for it; 0 if only "
        "the map suggests it."
    )


class Location(ApiRecord):
    """The query's pose averaged over the accepted matches that agree on it."""

    pose: Transform
    confidence: float | None = Field(default=None, description=_CONFIDENCE)
    evidence: EvidenceRecord | None = Field(
        default=None,
        description="The numbers from which `confidence` is computed; null if that is null.",
    )
    map: str | None = Field(default=None, description="Map of the matches.")
    support: int = Field(
        description="Number of matches that agree on it; 1 is a single view, and 0 means that "
        "only the map confirms it."
    )
    guided: int = Field(
        default=0,
        description="Number of these that were guided by the others: they make the pose more "
        "precise, and are no independent evidence.",
    )
    votes: int = Field(description="Number of accepted matches, whatever pose they vote for.")
    strength: Literal["strong", "weak"] = Field(
        default="strong", description="`strong` if a strong match votes for it."
    )
    verified_by: Verifier = Field(
        default="matches",
        description="`matches`: a strong match votes for the pose. `map`: no strong match does, "
        "but the map's frames confirm it. `prior`: the frames confirm several poses, and the "
        "prior expects this one.",
    )
    spread_m: float
    spread_deg: float
    uncertainty: Uncertainty | None = Field(default=None, description="Uncertainty of `pose`.")
    base: Transform | None = Field(
        default=None,
        description="`pose` for the robot's base, if the query has T_base_sensor.",
    )


# Why a query found what it found, and not another frame, as JSON.

Outcome = Literal["accepted", "ambiguous", "rejected", "skipped", "not_selected", "ranked"]
Lost = Literal[
    "state", "query", "filter", "shortlist", "ranking", "selection", "turn", "deadline",
    "validation",
]  # fmt: skip


class Explanation(ApiRecord):
    """The last stage that a frame of the ranking reached."""

    frame_id: str
    map: str
    name: str | None = Field(default=None, description="Name of the original file or message.")
    rank: int = Field(description="Place in the ranking R, from 1.")
    distance: int
    similarity: float
    stage: Stage = Field(description="The last stage that it reached.")
    outcome: Outcome = Field(
        description="`skipped`: a candidate that was not validated; `not_selected`: not a "
        "candidate; `ranked`: only the ranking was requested."
    )
    reason: str


class ExplainedFrame(ApiRecord):
    """The reason why a frame is, or is not, among the matches."""

    frame_id: str
    map: str
    name: str | None = Field(default=None, description="Name of the original file or message.")
    state: str = Field(description="State of the frame; only indexed frames are searched.")
    passes_filter: bool | None = Field(description="Null if the frame is not searchable.")
    distance: int | None = Field(
        description="Exact distance, whether or not the query computed it."
    )
    similarity: float | None
    rank: int | None = Field(
        description="Rank from 1 among all frames that pass the filter, by exact distance; of a "
        "frame that does not pass, the rank that it would have."
    )
    of: int | None = Field(description="Number of frames that pass the filter.")
    shortlisted: bool | None = Field(
        description="False if an approximate index missed a frame that is near enough for the "
        "ranking."
    )
    ranked: bool | None = Field(description="Whether it is in the ranking R.")
    selected: bool | None = Field(
        description="Whether it is a candidate: in the selection C, or, without that stage, "
        "among the first of R."
    )
    validation: Validation | None = Field(
        description="Validation of the frame, computed for this explanation even if the query "
        "did not reach it; null if validation was not requested."
    )
    transform: Transform | None = Field(description="Transform from the query to the frame.")
    lost_at: Lost | None = Field(
        description="Stage at which it was dropped; null for a match. `turn`: enough frames "
        "were accepted before it, or `k` others are listed before it; `query`: it is the query "
        "itself."
    )
    reason: str


# Queries and answers.

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
    """The robot's belief about its pose: T_parent_query and its uncertainty."""

    pose: GivenPose = Field(
        description="Pose of the query's sensor in a parent frame of the map; `parent_frame` is "
        f"required. At most {FARTHEST_PRIOR:,.0f} m from the origin along each axis."
    )
    covariance: Annotated[list[float], Field(min_length=36, max_length=36)] | None = Field(
        default=None,
        description="6 x 6, row by row, of errors (x, y, z, rx, ry, rz) along the parent's axes, "
        "ordered as in ROS's PoseWithCovariance: metres and radians. The square roots of its "
        f"diagonal are from {LEAST_DEVIATION} to {MOST_DEVIATION:.0f}.",
    )
    deviation_m: float = Field(
        default=0.3,
        ge=LEAST_DEVIATION,
        le=20,
        description="Instead of `covariance`: deviation along each axis.",
    )
    deviation_deg: float = Field(
        default=10.0,
        ge=1e-4,
        le=180,
        description="Instead of `covariance`: deviation about each axis.",
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
        default=5,
        ge=1,
        le=50,
        description="Accepted matches to list, at most (or matches, unvalidated). The status and "
        "the pose do not depend on it: they rest on the first 5 that are accepted.",
    )
    stages: tuple[Stage, ...] = Field(
        default=STAGES,
        description="R, DR, VR or VDR of the paper: always from `retrieve`, in this order.",
    )
    exact: bool = Field(
        default=False,
        description="Compare every frame of the map that passes the filter. Most queries do so "
        "anyway: only in a large map are some left out.",
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
        description="How many of the ranking are selected, and validated until 5 are accepted, "
        "some 20 ms each; default: 10. Where `k` is more than 5, validation goes on until `k` are "
        "accepted, and by default among `k` candidates. Without validation `k` counts.",
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
    confidence: float = Field(
        default=0.99,
        ge=0.5,
        le=0.999,
        description="Least confidence of a pose that is `found`. All other places together have "
        "at most the rest.",
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
        description="Store the answer, so that GET /v1/queries/{query_id} returns it.",
    )
    record: bool = Field(
        default=True,
        description="List the query in GET /v1/queries, report it as an event, and count it.",
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
    query_id: str | None = Field(
        default=None,
        description="An earlier query whose answer is stored, in place of an upload: its frame "
        "with these options. The answer has an id of its own.",
    )

    @field_validator("maps", mode="before")
    @classmethod
    def _names(cls, maps: object) -> object:
        if isinstance(maps, str) and maps.strip() != "*":
            return [one.strip() for one in maps.split(",")]
        return maps.strip() if isinstance(maps, str) else maps


class Counts(ApiRecord):
    """Number of frames at each stage."""

    map: int = Field(description="Number of searchable frames in the map.")
    passed: int = Field(description="Number of these that pass the filter; all without a filter.")
    compared: int = Field(description="Number of these whose distance was computed.")
    ranked: int
    selected: int
    validated: int
    accepted: int


class OfMap(ApiRecord):
    """The result of a query in one of several maps."""

    index_version: int = Field(description="0 where it was searched without an index of this node.")
    counts: Counts


class Answer(ApiRecord):
    """The answer to a query."""

    query_id: str
    status: AnswerStatus = Field(
        description="`found`: the confidence of one pose reaches that of the query; if no "
        "accepted match has a pose, at least one match is accepted. `ambiguous`: the evidence "
        "supports one or several poses, none with that confidence: never drive on it. "
        "`not_found`: the evidence supports no pose, see `cause`. `unvalidated`: validation was "
        "not requested, or the deadline passed before a match was accepted."
    )
    reason: str = Field(
        default="", description="The reason in a sentence; if `not_found`, with advice."
    )
    cause: Cause | None = Field(default=None, description="If `not_found`: the most likely cause.")
    matches: list[Match] = Field(
        description="The accepted matches, strong before weak, then the most precise first (for "
        "full-turn scans, the nearest first); then the other matches that were validated."
    )
    location: Location | None = Field(
        description="Pose of the query, if the answer is `found` and the matches have poses."
    )
    alternatives: list[Alternative] = Field(
        default=[],
        description="If `ambiguous`: the poses that the evidence supports, the best first.",
    )
    seed: int
    model: str
    index_version: int = Field(
        description="0 where the map was searched without an index of this node: a small one, "
        "one that PostgreSQL searched, or one whose model stores psi. Of several maps the least."
    )
    exact: bool = Field(description="Whether every frame that passes the filter was compared.")
    counts: Counts
    milliseconds: dict[str, float] = Field(
        description="`prepare` (signature and geometry of the query), `retrieve`, `diversify`, "
        "`validate`, `locate`, `explain` where it was asked for, `earlier` for the earlier frames "
        "of a sequence, `total`."
    )
    maps: list[str] = Field(default=[], description="The maps that were searched.")
    frame: FrameName | None = Field(
        default=None,
        description="The stored frame of the query; null for an upload. Transforms name its "
        "sensor by its id if only its own map was searched, and `query` otherwise.",
    )
    kind: Kind = Field(
        default="depth",
        description="Kind of the query's frame. Transforms name the sensor of a depth image "
        "`ID.optical` (x right, y down, z forward), and that of a cloud, which keeps its axes, "
        "`ID.sensor`.",
    )
    frames: int = Field(
        default=1,
        description="Number of frames in the query. With a sequence, `matches` are those of the "
        "last frame.",
    )
    per_map: dict[str, OfMap] | None = Field(
        default=None, description="Result of each map if several were searched; null for one."
    )
    deadline_reached: bool | None = Field(
        default=None,
        description="Whether candidates were omitted because of the deadline; null without a "
        "deadline.",
    )
    explanations: list[Explanation] | None = Field(
        default=None,
        description="With `explain`: explanations of all frames of the ranking, the nearest first.",
    )
    explained_frame: ExplainedFrame | None = Field(
        default=None, description="With `explain_frame`: the explanation of that frame."
    )


# Where a robot is, in one record.

LocalizationStatus = Literal["found", "ambiguous", "not_found"]


class Localization(ApiRecord):
    """The pose of the query, if it is known."""

    status: LocalizationStatus = Field(
        description="`found`: the confidence of one pose reaches that of the query. "
        "`ambiguous`: none does, see `alternatives`: move, and query again. `not_found`: no "
        "pose is supported, see `cause`, or the deadline passed before."
    )
    reason: str
    cause: Cause | None = Field(default=None, description="If `not_found`: the most likely cause.")
    map: str
    pose: Transform | None = Field(
        description="T_parent_query: the query's camera in the parent frame of its matches' "
        "poses. Null unless `found`, and if no accepted match has a pose: see `best`."
    )
    confidence: float | None = Field(
        default=None,
        description="Probability that `pose` is right, 0 to 1; if `ambiguous`, of the first of "
        "`alternatives`. Null without a pose, or if it was not compared with the map.",
    )
    evidence: EvidenceRecord | None = Field(
        default=None,
        description="The numbers from which `confidence` is computed; null if that is null.",
    )
    support: int = Field(
        description="Number of matches that agree on the pose; 1 is a single view, and 0 means "
        "that only the map confirms it."
    )
    votes: int = Field(description="Number of accepted matches, whatever pose they vote for.")
    spread_m: float | None = Field(description="Spread of the votes; null without a pose.")
    spread_deg: float | None
    uncertainty: Uncertainty | None = Field(default=None, description="Uncertainty of `pose`.")
    base: Transform | None = Field(
        default=None,
        description="`pose` for the robot's base, if the query has T_base_sensor.",
    )
    strength: Literal["strong", "weak"] | None = Field(
        description="`strong` if a strong match votes for the pose; null unless `found`."
    )
    verified_by: Verifier | None = Field(
        default=None,
        description="What decided the answer, as in `location`; null unless `found`.",
    )
    alternatives: list[Alternative] = Field(
        default=[],
        description="If `ambiguous`: the poses that the evidence supports, the best first.",
    )
    best: Match | None = Field(description="The best accepted match, with the transform to it.")
    matches: list[str] = Field(description="Ids of the accepted matches, the best first.")
    frames: int = Field(
        default=1, description="Number of frames in the query; those of a sequence count together."
    )
    query_id: str
    seed: int
    model: str
    deadline_reached: bool | None = None
    milliseconds: dict[str, float]
