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
    """A stored frame that is asked about."""

    map: Named = Field(description="The map it is in.")
    frame_id: Named


class FrameName(ApiRecord):
    """A stored frame that was asked about."""

    map: str
    frame_id: str


class Diversity(Given):
    """The scales of the determinantal point process, Eq. 3 of the paper."""

    sigma: float = Field(
        default=1.0,
        ge=0.01,
        le=100.0,
        description="Times the median distance within the ranking: greater makes more frames "
        "count as alike.",
    )
    omega: float = Field(
        default=4.0,
        ge=0.01,
        le=1000.0,
        description="Times the ranking's span of distances: greater lets diversity outweigh rank.",
    )


class ValidationOptions(Given):
    """What a match must stand to be accepted.

    What is left out is as the map's model has it; the defaults told are those of `depth`.
    """

    mode: Literal["full", "paper"] = Field(
        default="full",
        description="`paper`: the residual of the two directions alone decides, and more wrong "
        "matches are accepted.",
    )
    residual_m: float = Field(
        default=0.08, gt=0, le=1.0, description="Most that both directions may disagree."
    )
    residual_deg: float = Field(default=5.0, gt=0, le=45.0, description="The same, of the turn.")
    evidence: Share = Field(
        default=0.2,
        description="Least `overlap` - `violation_weight` x `free_space_violations`. The default "
        "lets half of it pass, as a weak match, where little is shared and all of it agrees.",
    )
    violation_weight: float = Field(default=5.0, ge=0.0, le=100.0)
    plane_overlap: Share = Field(default=0.15, description="Least, every plane counting alike.")
    strong: Share = Field(
        default=0.3, description="Evidence below which an accepted match is weak."
    )
    weak: Share = Field(
        default=0.05, description="`ambiguity` from which on an accepted match is weak."
    )
    ambiguous: Share = Field(
        default=0.14, description="`ambiguity` from which on nothing is accepted."
    )
    ambiguous_share: float = Field(
        default=0.5,
        ge=0.0,
        le=10.0,
        description="Nor from this share of `plane_overlap` on.",
    )


# Matches of a query.

ValidationStatus = Literal["accepted", "rejected", "ambiguous", "skipped"]


class Residual(ApiRecord):
    """Both directions composed: the identity if they agreed."""

    translation_m: float
    rotation_deg: float


class Validation(ApiRecord):
    """What came of aligning the query with a match.

    An accepted pair is evidence that two frames look alike, not that they are of one place: the
    answer's `status` weighs it against the map.
    """

    status: ValidationStatus = Field(
        description="`skipped`: it was not tried, and `reason` says why."
    )
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
        default=None,
        description="Share that lies where the other frame saw through; null where neither frame "
        "has a viewpoint, so that nothing is known of free space.",
    )
    planes: float | None = Field(
        default=None, description="Distinct planes that agree, the mean of both frames."
    )
    plane_violations: float | None = Field(
        default=None, description="`free_space_violations` with every plane counting alike."
    )
    inliers: int | None = Field(default=None, description="Points of both frames that agree.")
    ambiguity: float | None = Field(
        default=None,
        description="Share that the best rival explains.",
    )
    search: Literal["correspondences", "plans", "guided"] | None = Field(
        default=None,
        description="What proposed the transform: patches with alike surroundings, or the plans of "
        "two scans laid on each other. `guided`: other matches and the map's poses; it was refined "
        "and checked, but not searched for, so it is no vote of its own.",
    )
    directions: list[Literal["query_to_match", "match_to_query"]] = Field(
        default=[],
        description="Directions of the search in which it was found. One alone makes an accepted "
        "match weak.",
    )
    tilt_deg: float | None = Field(
        default=None,
        description="By how much the transform tilts the query's `up` against the match's; null "
        "where either is not known.",
    )


class FreeDirection(ApiRecord):
    """A direction in which a transform is hardly held, as along a corridor.

    Both parts together are of length 1: the error's metres and radians along it.
    """

    translation: Vector
    rotation: Vector
    deviation: float = Field(
        description="Standard deviation along it: metres where it shifts, radians where it turns; "
        "at most 10, for what nothing holds."
    )


class Uncertainty(ApiRecord):
    """How far a transform is likely off, if it is not wrong altogether.

    Of errors (x, y, z, rx, ry, rz): metres along the axes of the transform's parent frame, by which
    the child's origin is off, then the rotation vector, radians about the parent's axes, that the
    rotation lacks on its left. This is how ROS orders and means PoseWithCovariance.
    """

    covariance: list[float] = Field(
        min_length=36, max_length=36, description="6 x 6, row by row, in that order."
    )
    method: Literal["information-scaled", "votes-and-spread"] = Field(
        description="`information-scaled`: of one match, the inverse information of its "
        "refinement, scaled to the errors of synthetic rooms. `votes-and-spread`: of several "
        "matches, from theirs and how far they lie apart. What they are worth: docs/uncertainty.md."
    )
    degenerate: list[FreeDirection] = Field(
        description="Directions at least 30 times as uncertain as the best held, the freest first."
    )


class Match(ApiRecord):
    """A database frame returned for a query."""

    frame_id: str
    map: str
    robot: str | None
    session: str | None
    name: str | None = Field(default=None, description="Of the original file or message.")
    sequence: int | None = Field(default=None, description="Place within the session.")
    rank: int = Field(description="Place in the ranking R, from 1.")
    distance: int = Field(description="L1 distance of the stored signatures.")
    similarity: float = Field(description="1 - distance / that of unrelated frames, 0 to 1.")
    selected: bool | None = Field(
        description="In the diverse selection C; null without that stage. False: a frame of "
        "another place, validated as it looks like the query too."
    )
    diversity_gain: float | None = Field(description="1 for the first; near 0 for a duplicate.")
    validation: Validation
    transform: Transform | None = Field(description="Query to match; believe it where accepted.")
    predicted: Transform | None = Field(
        default=None,
        description="Of a guided match: `transform` as the map's poses predict it from the matches "
        "before, up to 15 cm and 6 deg off.",
    )
    parent_frame: str | None = Field(
        default=None,
        description="Parent frame that the pose of the frame was sent in; null without a pose. "
        "Where the map joined it to another, `pose_in_map` is in that.",
    )
    pose_in_map: Transform | None = Field(
        description="The query in the parent frame of the match's pose, where that is known and "
        "the match is not rejected."
    )
    uncertainty: Uncertainty | None = Field(
        default=None, description="Of `transform`, where the match is accepted."
    )
    base_in_map: Transform | None = Field(
        default=None,
        description="As `pose_in_map`, of the robot's base: where the query has T_base_sensor.",
    )


#: What decided on a pose.
Verifier = Literal["matches", "map", "prior"]


class EvidenceRecord(ApiRecord):
    """What speaks for and against a pose; its `confidence` is computed from these numbers."""

    score: float = Field(
        description="How well the map's frames bear the pose out: `share`, less for what they saw "
        "through; at most 1."
    )
    share: float = Field(
        description="Share of the query's surface that the map shows there, every plane counting "
        "the same."
    )
    planes: float = Field(description="Distinct planes of the query that agree with the map.")
    frames: int = Field(description="Frames of the map that agree.")
    viewpoints: int = Field(description="Different viewpoints of these frames.")
    excess: float = Field(
        description="Share of what should be in sight and is missing, in the query or in the map, "
        "beyond what the map's own frames miss among themselves."
    )
    weight: float = Field(
        description="Of the matches that vote for the pose, one for each viewpoint: 1 of a strong "
        "match, 0.4 of a weak or an ambiguous one."
    )
    strong: int = Field(description="Different viewpoints of strong matches that vote for it.")
    accepted: int = Field(
        description="Different viewpoints of accepted matches that lead to it, guided or not."
    )
    suggested: int = Field(
        description="Different viewpoints of candidates that suggest it, accepted or not."
    )
    similarity: float = Field(
        description="Of the signatures of the query and of the nearest of these candidates, 0 to 1."
    )
    rival: float = Field(
        description="Score of the best pose at another place, as a share of `score`; 0 where there "
        "is none. Where the prior decided, of the places that it expects."
    )
    rival_weight: float = Field(
        description="Largest weight of the matches that vote for another place."
    )
    rendered: bool = Field(
        default=False,
        description="Whether most of these frames are views rendered from a surface that was "
        "imported as a map. The same numbers then give another confidence.",
    )


_CONFIDENCE = "Probability that the pose is right, 0 to 1. Null where the map was not asked."


class Alternative(ApiRecord):
    """A pose of the query that the evidence supports; of several, one is right at most."""

    pose: Transform
    confidence: float | None = Field(default=None, description=_CONFIDENCE)
    evidence: EvidenceRecord | None = Field(
        default=None, description="What `confidence` was computed from; null likewise."
    )
    map: str | None = Field(default=None, description="Whose parent frame it is given in.")
    support: int = Field(
        description="Matches from different viewpoints that vote for it; 0 where the map alone "
        "suggests it."
    )


class Location(ApiRecord):
    """The query's pose averaged over the accepted matches that agree on it."""

    pose: Transform
    confidence: float | None = Field(default=None, description=_CONFIDENCE)
    evidence: EvidenceRecord | None = Field(
        default=None, description="What `confidence` was computed from; null likewise."
    )
    map: str | None = Field(default=None, description="Whose frames it is averaged over.")
    support: int = Field(
        description="Matches that agree on it; 0 where the map alone confirms it, and 1 is one "
        "view."
    )
    guided: int = Field(
        default=0,
        description="How many of these were guided by the others: they make the pose more precise, "
        "and are no evidence of their own.",
    )
    votes: int = Field(description="Accepted matches, whatever pose they vote for.")
    strength: Literal["strong", "weak"] = Field(
        default="strong", description="`strong` where a match that votes for it is."
    )
    verified_by: Verifier = Field(
        default="matches",
        description="`matches`: a strong match votes for the pose. `map`: no strong one does, and "
        "the map's frames bear it out. `prior`: they bear several poses out, and this is the one "
        "that the prior expects.",
    )
    spread_m: float
    spread_deg: float
    uncertainty: Uncertainty | None = Field(default=None, description="Of `pose`.")
    base: Transform | None = Field(
        default=None,
        description="As `pose`, of the robot's base: where the query has T_base_sensor.",
    )


# Why a query found what it found, and not another frame, as JSON.

Outcome = Literal["accepted", "ambiguous", "rejected", "skipped", "not_selected", "ranked"]
Lost = Literal[
    "state", "query", "filter", "shortlist", "ranking", "selection", "turn", "deadline",
    "validation",
]  # fmt: skip


class Explanation(ApiRecord):
    """How far a frame of the ranking came."""

    frame_id: str
    map: str
    name: str | None = Field(default=None, description="Of the original file or message.")
    rank: int = Field(description="Place in the ranking R, from 1.")
    distance: int
    similarity: float
    stage: Stage = Field(description="The furthest that it came to.")
    outcome: Outcome = Field(
        description="`skipped`: a candidate that was not validated; `not_selected`: not a "
        "candidate; `ranked`: nothing but the ranking was asked for."
    )
    reason: str


class ExplainedFrame(ApiRecord):
    """Why one frame is, or is not, among the matches."""

    frame_id: str
    map: str
    name: str | None = Field(default=None, description="Of the original file or message.")
    state: str = Field(description="Of the frame; only indexed ones are searched.")
    passes_filter: bool | None = Field(description="Null where it is not searched at all.")
    distance: int | None = Field(description="Exact, whether or not the query compared it.")
    similarity: float | None
    rank: int | None = Field(
        description="From 1 among all frames that pass the filter, each compared exactly: where "
        "the frame itself does not pass, the rank it would have."
    )
    of: int | None = Field(description="How many frames pass the filter.")
    shortlisted: bool | None = Field(
        description="False where an approximate index missed a frame that is near enough to be "
        "ranked."
    )
    ranked: bool | None = Field(description="It is in the ranking R.")
    selected: bool | None = Field(
        description="It is a candidate: in the selection C, or without that stage of the first "
        "of R."
    )
    validation: Validation | None = Field(
        description="Of the alignment with it, made for this even if the query never came to it; "
        "null where validation was not asked for."
    )
    transform: Transform | None = Field(description="Query to the frame, of that alignment.")
    lost_at: Lost | None = Field(
        description="Where it was lost; null where it is a match. `turn`: enough were accepted "
        "before it, or `k` others are listed before it; `query`: it is the query itself."
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
        description="`found`: the confidence of one pose reaches that of the query; where no "
        "accepted match has a pose, a match is accepted. `ambiguous`: the evidence supports one "
        "pose or several, and none with that confidence: never drive on it. `not_found`: nothing "
        "is supported, "
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
        description="`found`: the confidence of one pose reaches that of the query. `ambiguous`: "
        "none does, see `alternatives`: move on and ask again. `not_found`: no pose is supported, "
        "see `cause`, or the deadline came before."
    )
    reason: str
    cause: Cause | None = Field(default=None, description="The likeliest of `not_found`.")
    map: str
    pose: Transform | None = Field(
        description="T_parent_query: the query's camera in the parent frame of its matches' "
        "poses. Null unless `found`, and where no accepted match has a pose: see `best`."
    )
    confidence: float | None = Field(
        default=None,
        description="Probability that `pose` is right, 0 to 1; of `ambiguous`, that the first of "
        "`alternatives` is. Null where there is no pose, or the map was not asked.",
    )
    evidence: EvidenceRecord | None = Field(
        default=None, description="What `confidence` was computed from; null likewise."
    )
    support: int = Field(
        description="Matches that agree on the pose; 1 is one view, and 0 the map alone."
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
    alternatives: list[Alternative] = Field(
        default=[],
        description="Of `ambiguous`: the poses that the evidence supports, the best first.",
    )
    best: Match | None = Field(
        description="The accepted match to believe first, with the transform to it."
    )
    matches: list[str] = Field(description="Ids of the accepted matches, in the order of belief.")
    frames: int = Field(default=1, description="Of the query, those of a sequence together.")
    query_id: str
    seed: int
    model: str
    deadline_reached: bool | None = None
    milliseconds: dict[str, float]
