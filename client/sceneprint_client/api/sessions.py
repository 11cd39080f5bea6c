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
    """Which sessions of a map to associate, frame by frame."""

    sessions: Annotated[list[Label], Field(min_length=1, max_length=2)] = Field(
        description="Two: each frame of the first is looked up among those of the second. One: "
        "loop closures, each frame is looked up among those taken before it."
    )
    robots: Annotated[list[Label], Field(min_length=1, max_length=2)] | None = Field(
        default=None,
        description="Who took each of the sessions, in their order; needed where several robots "
        "call their sessions alike.",
    )
    filter: Filter | None = Field(
        default=None, description="Only frames that pass it are taken, of either session."
    )
    apart: int | None = Field(
        default=None,
        ge=1,
        le=1_000_000,
        description="Of one session: frames that come between, in the order of time; default: "
        f"{APART}, or 1 where `not_within_s` is given.",
    )
    not_within_s: float | None = Field(
        default=None,
        gt=0,
        description="Of one session: seconds that come between; frames without a time are left "
        "out.",
    )
    k: int = Field(default=3, ge=1, le=10, description="Accepted edges wanted of each frame.")
    candidates: int = Field(
        default=10,
        ge=1,
        le=100,
        description="How many of a frame's ranking are selected and validated until `k` are "
        "accepted, some 20 ms each.",
    )
    join: bool = Field(
        default=True,
        description="Of two sessions: where the join between their parent frames is strong, let "
        "all poses of the map in these frames lead to one of them.",
    )
    seed: int = Field(default=0, ge=0, lt=2**32, description="Of the random choices.")
    min_overlap: float = Field(
        default=0.0, ge=0.0, le=1.0, description="Least overlap of an edge that is kept."
    )
    validation: ValidationOptions | None = Field(
        default=None, description="What an edge must stand to be accepted."
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

    number: int = Field(description="From 0, in the order in which edges were found.")
    from_frame: str = Field(description="The frame that was looked up.")
    to_frame: str = Field(description="The frame that was found.")
    from_session: str | None
    to_session: str | None
    from_robot: str | None
    to_robot: str | None
    transform: Transform = Field(description="x_to = matrix @ x_from, between the sensors' frames.")
    information: list[float] | None = Field(
        description="36 numbers, row by row in the order x y z rx ry rz, metres and radians: the "
        "inverse of the covariance of an error that comes after the transform, along the axes of "
        "`from_frame`: T_true = matrix @ exp(error)."
    )
    overlap: float = Field(description="Share of both frames' points that agree.")
    residual_m: float = Field(description="Both directions composed: 0 if they agreed.")
    residual_deg: float
    strength: Literal["strong", "weak"]
    inliers: int = Field(description="Points of both frames that agree.")
    ambiguity: float = Field(description="Share that the best other transform explains.")
    similarity: float = Field(description="Of the signatures, 0 to 1.")
    from_pose: Transform | None = Field(
        default=None, description="Of `from_frame`, in the parent frame that its pose is in now."
    )
    to_pose: Transform | None = Field(default=None, description="Of `to_frame`.")
    from_name: str | None = Field(default=None, description="What the file was called.")
    to_name: str | None = None
    consistent: bool | None = Field(
        description="Whether a second edge supports it. `true`: a loop with an edge near by of "
        "another viewpoint closes, or it agrees with the join. `false`: it was outvoted, and is "
        "left out of graphs and joins. null: nothing from another viewpoint checks it, or there "
        "are no poses, or the association is not over."
    )
    loops: int | None = Field(description="Edges near by that it was compared with.")
    closed: int | None = Field(description="Of them those that agree with it.")


class Join(ApiRecord):
    """How the parent frames of two sessions lie to each other, by consensus of the edges."""

    from_session: str
    to_session: str
    from_robot: str | None
    to_robot: str | None
    from_parent: str = Field(description="Parent frame of the poses of `from_session`.")
    to_parent: str
    transform: Transform | None = Field(
        description="x_to = matrix @ x_from, between the parent frames; null where the edges do "
        "not agree on one."
    )
    strength: Literal["strong", "weak"] | None = Field(
        description="`strong` where many edges of several frames agree that reach over a metre; "
        "null without a transform."
    )
    support: int = Field(description="Edges that agree with it.")
    votes: int = Field(description="Edges between the two parent frames that were not outvoted.")
    rival: int = Field(description="Edges that agree on the best other transform.")
    spread_m: float | None = Field(
        description="Root mean square of what edges that agree differ by, where their frames are."
    )
    spread_deg: float | None
    reason: str
    root: str | None = Field(
        default=None,
        description="Parent frame that the poses of both are in from then on, the one whose "
        "frames came first; null where nothing was moved, or where that was undone.",
    )
    undone: bool = Field(
        default=False,
        description="Whether poses were moved and are back: no graph and no automatic association "
        "joins these parent frames.",
    )


class AssociationResult(ApiRecord):
    """What an association came to."""

    frames: int = Field(description="Frames that were looked up.")
    skipped: int = Field(description="Frames that could not be, as they were deleted meanwhile.")
    validated: int = Field(description="Pairs of frames that were validated.")
    edges: int = Field(
        description="Of them accepted: places that look alike, of which those that are "
        "`consistent` may be taken for one."
    )
    consistent: int = Field(
        description="Edges that another one of another viewpoint, or a join, supports."
    )
    inconsistent: int = Field(description="Edges that were outvoted.")
    unchecked: int = Field(description="Edges that nothing near by confirms or denies.")
    joins: list[Join] = Field(
        description="How the sessions lie to each other; of one session only where its frames "
        "have several parent frames."
    )


class Association(Product):
    """An association of sessions: a job and what it came to. Its steps are frames."""

    noun, collection, request_type = "association", "associations", NewAssociation

    map: str
    request: NewAssociation
    result: AssociationResult | None = Field(description="When it has succeeded.")


class Vertex(ApiRecord):
    """A frame in a graph."""

    vertex: int = Field(description="Its number in g2o.")
    frame_id: str
    robot: str | None
    session: str | None
    captured_at: datetime | None
    name: str | None = Field(default=None, description="Of the original file or message.")
    sequence: int | None = Field(default=None, description="Place within the session.")
    pose: Transform | None = Field(
        description="In `frame` of the graph where the sessions are joined; else in its own "
        "parent frame. null where it has none and no edge leads to one that has."
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
    """What an optimiser needs: where frames are, and how they lie to each other."""

    frame: str | None = Field(description="That joined poses are in; null where none has a pose.")
    vertices: list[Vertex]
    edges: list[GraphEdge]


# Two sessions of a map compared: what is gone and what is new.

#: Frames of each session that a comparison uses, at most.
MOST_COMPARED = 500
#: What the points of a difference are, by their patch index.
SAME, GONE, NEW, UNSEEN_AFTER, UNSEEN_BEFORE = 0, 1, 2, 3, 4


class NewDifference(Given):
    """Which two sessions of a map to compare."""

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
    """How many cells are in both sessions, and how many in one."""

    same: int = Field(description="Cells of `after` that `before` has too.")
    gone: int = Field(description="Cells of `before` that frames of `after` saw through.")
    new: int = Field(description="Cells of `after` that frames of `before` saw through.")
    unseen_after: int = Field(
        description="Cells of `before` of which `after` shows nothing: hidden, or not looked at."
    )
    unseen_before: int = Field(description="Cells of `after` of which `before` shows nothing.")
    cell_m: float = Field(description="Width of a cell.")
    parent_frame: str = Field(description="Of all points.")
    up: list[float] = Field(
        min_length=3, max_length=3, description="Unit vector upwards, in the parent frame."
    )
    frames_before: int = Field(description="Frames of `before` that were compared.")
    frames_after: int = Field(description="Frames of `after` that were compared.")
    skipped: int = Field(description="Frames that were deleted meanwhile, or are damaged.")


class Difference(Product):
    """A comparison of two sessions and its result. Its steps are frames; each is used twice."""

    noun, collection, request_type = "difference", "differences", NewDifference

    map: str
    request: NewDifference
    result: DifferenceResult | None = Field(description="When it has succeeded.")
