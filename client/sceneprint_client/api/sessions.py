"""Sessions associated and compared, as JSON: edges, joins, graphs; what is gone, what is new."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Literal

from pydantic import Field, model_validator

from sceneprint_client.api.admin import Product
from sceneprint_client.api.base import ApiRecord, Given, Label, Transform
from sceneprint_client.api.listing import Filter
from sceneprint_client.api.query import ValidationOptions

#: Frames apart that loop closures are looked for from, unless told otherwise.
APART = 100
#: Files that a graph comes as.
GraphFormat = Literal["g2o", "tum", "json"]


class NewAssociation(Given):
    """Sessions of a map that are to be associated, frame by frame."""

    sessions: Annotated[list[Label], Field(min_length=1, max_length=2)] = Field(
        description="Two sessions: each frame of the first is looked up in the second. One "
        "session: loop closures; each frame is looked up among those taken before it."
    )
    robots: Annotated[list[Label], Field(min_length=1, max_length=2)] | None = Field(
        default=None,
        description="Robot of each session, in the same order; required if several robots use "
        "the same session name.",
    )
    filter: Filter | None = Field(
        default=None, description="Conditions on the frames of both sessions."
    )
    apart: int | None = Field(
        default=None,
        ge=1,
        le=1_000_000,
        description="For one session: minimum number of frames in between, in order of time; "
        f"default: {APART}, or 1 with `not_within_s`.",
    )
    not_within_s: float | None = Field(
        default=None,
        gt=0,
        description="For one session: minimum time in between, seconds; frames without a time "
        "are omitted.",
    )
    k: int = Field(
        default=3, ge=1, le=10, description="Number of accepted edges wanted for each frame."
    )
    candidates: int = Field(
        default=10,
        ge=1,
        le=100,
        description="Number of frames of each ranking that are selected and validated until `k` "
        "are accepted, some 20 ms each.",
    )
    join: bool = Field(
        default=True,
        description="For two sessions: if the join of their parent frames is strong, move all "
        "poses of the map into one of them.",
    )
    seed: int = Field(default=0, ge=0, lt=2**32, description="Seed of the random choices.")
    min_overlap: float = Field(
        default=0.0, ge=0.0, le=1.0, description="Minimum overlap of an edge."
    )
    validation: ValidationOptions | None = Field(
        default=None, description="Requirements on accepted edges."
    )

    @model_validator(mode="after")
    def _sensible(self) -> NewAssociation:
        if self.robots is not None and len(self.robots) != len(self.sessions):
            raise ValueError("robots: name one for each session, in the same order")
        if len(self.sessions) == 2:
            robots = self.robots or ["", ""]
            if self.sessions[0] == self.sessions[1] and robots[0] == robots[1]:
                raise ValueError("sessions: name it once to look for loop closures within it")
            if self.apart is not None or self.not_within_s is not None:
                raise ValueError("apart, not_within_s: they are for loop closures in one session")
        if self.filter is not None and self.filter.not_within_s is not None:
            raise ValueError("filter.not_within_s: give not_within_s beside the filter instead")
        return self


class Edge(ApiRecord):
    """Two frames that seem to see one place, and how they lie to each other.

    An edge alone is evidence that two places look alike, not that they are one: take it only where
    `consistent` is true.
    """

    number: int = Field(description="Number from 0 in the order in which edges were found.")
    from_frame: str = Field(description="The frame that was looked up.")
    to_frame: str = Field(description="The frame that was found.")
    from_session: str | None
    to_session: str | None
    from_robot: str | None
    to_robot: str | None
    transform: Transform = Field(description="x_to = matrix @ x_from, between the sensors' frames.")
    information: list[float] | None = Field(
        description="36 numbers, row by row in the order x y z rx ry rz, metres and radians: "
        "the inverse covariance of an error that follows the transform, along the axes of "
        "`from_frame`: T_true = matrix @ exp(error)."
    )
    overlap: float = Field(description="Share of both frames' points that agree.")
    residual_m: float = Field(
        description="Translation of both directions composed: 0 if they agree."
    )
    residual_deg: float
    strength: Literal["strong", "weak"]
    inliers: int = Field(description="Number of points of both frames that agree.")
    ambiguity: float = Field(
        description="Share of the points that the best other transform explains."
    )
    similarity: float = Field(description="Similarity of the signatures, 0 to 1.")
    from_pose: Transform | None = Field(
        default=None, description="Pose of `from_frame`, in its present parent frame."
    )
    to_pose: Transform | None = Field(default=None, description="Pose of `to_frame`.")
    from_name: str | None = Field(default=None, description="Name of its file.")
    to_name: str | None = None
    consistent: bool | None = Field(
        description="Whether a second edge supports it. `true`: a loop with a nearby edge from "
        "another viewpoint closes, or the edge agrees with the join. `false`: it was outvoted, "
        "and is omitted from graphs and joins. Null: nothing from another viewpoint checks it, "
        "there are no poses, or the association has not ended."
    )
    loops: int | None = Field(description="Number of nearby edges that it was compared with.")
    closed: int | None = Field(description="Number of these that agree with it.")


class Join(ApiRecord):
    """The relative pose of the parent frames of two sessions, by consensus of the edges."""

    from_session: str
    to_session: str
    from_robot: str | None
    to_robot: str | None
    from_parent: str = Field(description="Parent frame of the poses of `from_session`.")
    to_parent: str
    transform: Transform | None = Field(
        description="x_to = matrix @ x_from, between the parent frames; null if the edges do "
        "not agree on one."
    )
    strength: Literal["strong", "weak"] | None = Field(
        description="`strong` if many edges of several frames agree that extend over more than "
        "a metre; null without a transform."
    )
    support: int = Field(description="Number of edges that agree with it.")
    votes: int = Field(
        description="Number of edges between the two parent frames that were not outvoted."
    )
    rival: int = Field(description="Number of edges that agree on the best other transform.")
    spread_m: float | None = Field(
        description="Root mean square of the differences of the agreeing edges, at their frames."
    )
    spread_deg: float | None
    reason: str
    root: str | None = Field(
        default=None,
        description="Parent frame that the poses of both are in after the join, the one whose "
        "frames came first; null if no pose was moved, or the join was undone.",
    )
    undone: bool = Field(
        default=False,
        description="Whether poses were moved and moved back: no graph and no automatic "
        "association joins these parent frames.",
    )


class AssociationResult(ApiRecord):
    """The result of an association."""

    frames: int = Field(description="Number of frames that were looked up.")
    skipped: int = Field(
        description="Number of frames that were skipped because they were deleted meanwhile."
    )
    validated: int = Field(description="Number of pairs of frames that were validated.")
    edges: int = Field(
        description="Number of accepted pairs: places that look alike. Treat only those that "
        "are `consistent` as the same place."
    )
    consistent: int = Field(
        description="Number of edges that a second edge from another viewpoint, or a join, "
        "supports."
    )
    inconsistent: int = Field(description="Number of edges that were outvoted.")
    unchecked: int = Field(
        description="Number of edges that no nearby edge confirms or contradicts."
    )
    joins: list[Join] = Field(
        description="Relative poses of the sessions; of a single session, only if its frames "
        "have several parent frames."
    )


class Association(Product):
    """An association of sessions: a job with its result. Its steps are frames."""

    noun, collection, request_type = "association", "associations", NewAssociation

    map: str
    request: NewAssociation
    result: AssociationResult | None = Field(description="The result of a job that has succeeded.")


class Vertex(ApiRecord):
    """A frame in a graph."""

    vertex: int = Field(description="Its number in g2o.")
    frame_id: str
    robot: str | None
    session: str | None
    captured_at: datetime | None
    name: str | None = Field(default=None, description="Name of the original file or message.")
    sequence: int | None = Field(default=None, description="Position in the session.")
    pose: Transform | None = Field(
        description="In `frame` of the graph if the sessions are joined, else in its own parent "
        "frame. Null if it has none and no edge leads to a frame with one."
    )


class GraphEdge(ApiRecord):
    """A constraint between two vertices, as g2o has it."""

    kind: Literal["association", "odometry"]
    first: int
    second: int
    matrix: list[list[float]] = Field(description="T_first_second, 4 x 4.")
    information: list[float] = Field(
        description="36 numbers, row by row in the order x y z rx ry rz, metres and radians, "
        "along the axes of `second`."
    )


class Graph(ApiRecord):
    """A pose graph for an optimiser: poses of frames, and relative poses between them."""

    frame: str | None = Field(
        description="Parent frame of joined poses; null if no frame has a pose."
    )
    vertices: list[Vertex]
    edges: list[GraphEdge]


# Two sessions of a map compared: what is gone and what is new.

#: Frames of each session that a comparison uses, at most.
MOST_COMPARED = 500
#: What the points of a difference are, by their patch index.
SAME, GONE, NEW, UNSEEN_AFTER, UNSEEN_BEFORE = 0, 1, 2, 3, 4


class NewDifference(Given):
    """The two sessions of a map to compare."""

    before: Label = Field(description="The earlier session.")
    after: Label = Field(description="The later session.")
    parent_frame: Label | None = Field(
        default=None,
        description="Compare frames with poses in this parent frame; default: the one that most "
        "frames of both sessions share.",
    )

    @model_validator(mode="after")
    def _sensible(self) -> NewDifference:
        if self.before == self.after:
            raise ValueError("after: is the same session as before. Name two sessions")
        return self


class DifferenceResult(ApiRecord):
    """Number of cells that both sessions have, and that one of them has."""

    same: int = Field(description="Number of cells of `after` that `before` has as well.")
    gone: int = Field(description="Number of cells of `before` that frames of `after` saw through.")
    new: int = Field(description="Number of cells of `after` that frames of `before` saw through.")
    unseen_after: int = Field(
        description="Number of cells of `before` that `after` does not show: hidden, or out of "
        "view."
    )
    unseen_before: int = Field(
        description="Number of cells of `after` that `before` does not show."
    )
    cell_m: float = Field(description="Width of a cell.")
    parent_frame: str = Field(description="Parent frame of all points.")
    up: list[float] = Field(
        min_length=3, max_length=3, description="Unit vector upwards, in the parent frame."
    )
    frames_before: int = Field(description="Number of frames of `before` that were compared.")
    frames_after: int = Field(description="Number of frames of `after` that were compared.")
    skipped: int = Field(description="Number of frames that were deleted meanwhile or are damaged.")


class Difference(Product):
    """A comparison of two sessions and its result. Its steps are frames; each is used twice."""

    noun, collection, request_type = "difference", "differences", NewDifference

    map: str
    request: NewDifference
    result: DifferenceResult | None = Field(description="The result of a job that has succeeded.")
