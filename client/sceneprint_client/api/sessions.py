"""Records of associations, pose graphs and differences of sessions."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Literal

from pydantic import Field, model_validator

from sceneprint_client.api.admin import Product
from sceneprint_client.api.base import ApiRecord, Given, Label, Transform
from sceneprint_client.api.listing import Filter
from sceneprint_client.api.query import ValidationOptions

#: Default minimum number of frames between the two frames of a loop closure.
APART = 100
#: File formats of a pose graph.
GraphFormat = Literal["g2o", "tum", "json"]


class NewAssociation(Given):
    """Sessions of a map to associate, frame by frame."""

    sessions: Annotated[list[Label], Field(min_length=1, max_length=2)] = Field(
        description="If there are two sessions, each frame of the first is queried against the "
        "second. If there is one session, each frame is queried against earlier frames, to find "
        "loop closures."
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
        description="For one session: minimum number of frames between the two frames of an edge, "
        f"in chronological order; default: {APART}, or 1 with `not_within_s`.",
    )
    not_within_s: float | None = Field(
        default=None,
        gt=0,
        description="For one session: minimum time between the two frames of an edge, seconds. "
        "Frames without a capture time are skipped.",
    )
    k: int = Field(
        default=3, ge=1, le=10, description="Maximum number of accepted edges for each frame."
    )
    candidates: int = Field(
        default=10,
        ge=1,
        le=100,
        description="Maximum number of frames of each ranking that are selected and validated, "
        "at approximately 20 ms per frame. Validation ends when `k` frames are accepted.",
    )
    join: bool = Field(
        default=True,
        description="For two sessions: whether to move all poses of the map into one parent frame "
        "if the join is strong.",
    )
    seed: int = Field(default=0, ge=0, lt=2**32, description="Seed for the random choices.")
    min_overlap: float = Field(
        default=0.0, ge=0.0, le=1.0, description="Minimum overlap of an edge."
    )
    validation: ValidationOptions | None = Field(
        default=None, description="Requirements on accepted edges."
    )

    @model_validator(mode="after")
    def _reject_conflicts(self) -> NewAssociation:
        if self.robots is not None and len(self.robots) != len(self.sessions):
            raise ValueError("robots: list one robot for each session, in the same order")
        if len(self.sessions) == 2:
            robots = self.robots or ["", ""]
            if self.sessions[0] == self.sessions[1] and robots[0] == robots[1]:
                raise ValueError("sessions: list the session once to search it for loop closures")
            if self.apart is not None or self.not_within_s is not None:
                raise ValueError("apart, not_within_s: allowed only for one session")
        if self.filter is not None and self.filter.not_within_s is not None:
            raise ValueError("filter.not_within_s: use not_within_s outside of the filter")
        return self


class Edge(ApiRecord):
    """Two frames that seem to show the same place, and the transform between them.

    A single edge shows only that two places look alike. Use edges only if `consistent` is true.
    """

    number: int = Field(description="Index in the order of discovery, starting at 0.")
    from_frame: str = Field(description="Frame that was queried.")
    to_frame: str = Field(description="Frame that the query found.")
    from_session: str | None
    to_session: str | None
    from_robot: str | None
    to_robot: str | None
    transform: Transform = Field(
        description="Transform between the frames of the two sensors, with x_to = matrix @ x_from."
    )
    information: list[float] | None = Field(
        description="Inverse covariance of the error, as 36 numbers, row by row in the order x y z "
        "rx ry rz, metres and radians. The error is along the axes of `from_frame`, with T_true = "
        "matrix @ exp(error)."
    )
    overlap: float = Field(description="Share of the points of both frames that agree.")
    residual_m: float = Field(
        description="Distance between the transforms of the two search directions, metres; 0 if "
        "they agree."
    )
    residual_deg: float = Field(
        description="Angle between the transforms of the two search directions, degrees."
    )
    strength: Literal["strong", "weak"]
    inliers: int = Field(description="Number of points of both frames that agree.")
    ambiguity: float = Field(
        description="Share of the points that the best alternative transform explains."
    )
    similarity: float = Field(description="Similarity of the signatures, 0 to 1.")
    from_pose: Transform | None = Field(
        default=None, description="Pose of `from_frame` in its current parent frame."
    )
    to_pose: Transform | None = Field(
        default=None, description="Pose of `to_frame` in its current parent frame."
    )
    from_name: str | None = Field(default=None, description="Name of the file of `from_frame`.")
    to_name: str | None = Field(default=None, description="Name of the file of `to_frame`.")
    consistent: bool | None = Field(
        description="Whether other evidence supports the edge. `true`: the edge and a nearby edge "
        "from another viewpoint form a consistent loop, or the edge agrees with the join of the "
        "sessions. `false`: the edge was outvoted and is omitted from graphs and joins. Null: no "
        "edge from another viewpoint can check this edge, there are no poses, or the association "
        "has not ended."
    )
    loops: int | None = Field(
        description="Number of nearby edges that were compared with this edge."
    )
    closed: int | None = Field(description="Number of nearby edges that agree with this edge.")


class Join(ApiRecord):
    """Transform between the parent frames of two sessions, on which the edges agree."""

    from_session: str
    to_session: str
    from_robot: str | None
    to_robot: str | None
    from_parent: str = Field(description="Parent frame of the poses of `from_session`.")
    to_parent: str
    transform: Transform | None = Field(
        description="Transform between the parent frames, with x_to = matrix @ x_from; null if the "
        "edges do not agree."
    )
    strength: Literal["strong", "weak"] | None = Field(
        description="`strong` if many edges of several frames agree and extend over more than a "
        "metre; null if there is no transform."
    )
    support: int = Field(description="Number of edges that agree with the transform.")
    votes: int = Field(
        description="Number of edges between the two parent frames that were not outvoted."
    )
    rival: int = Field(description="Number of edges that agree on the best alternative transform.")
    spread_m: float | None = Field(
        description="Root mean square deviation of the agreeing edges from the transform, at the "
        "positions of their frames, metres."
    )
    spread_deg: float | None = Field(
        description="Root mean square angle between the agreeing edges and the transform, degrees."
    )
    reason: str
    root: str | None = Field(
        default=None,
        description="Parent frame of all poses after the join (the parent frame of the session "
        "that was uploaded first); null if no pose was moved or the join was undone.",
    )
    undone: bool = Field(
        default=False,
        description="Whether the join moved poses and was undone. Graphs and automatic "
        "associations do not join these parent frames again.",
    )


class AssociationResult(ApiRecord):
    """The result of an association."""

    frames: int = Field(description="Number of queried frames.")
    skipped: int = Field(
        description="Number of frames that were skipped because they were deleted in the meantime."
    )
    validated: int = Field(description="Number of pairs of frames that were validated.")
    edges: int = Field(
        description="Number of accepted pairs of frames that look alike. Treat only `consistent` "
        "edges as showing the same place."
    )
    consistent: int = Field(
        description="Number of edges that are supported by a second edge from another viewpoint or "
        "by a join."
    )
    inconsistent: int = Field(description="Number of edges that were outvoted.")
    unchecked: int = Field(
        description="Number of edges that no nearby edge confirms or contradicts."
    )
    joins: list[Join] = Field(
        description="Joins of the sessions; for a single session, only if its frames have several "
        "parent frames."
    )


class Association(Product):
    """An association job and its result. Its progress counts frames."""

    noun, collection, request_type = "association", "associations", NewAssociation

    map: str
    request: NewAssociation
    result: AssociationResult | None = Field(description="The result of a job that has succeeded.")


class Vertex(ApiRecord):
    """A frame in a pose graph."""

    vertex: int = Field(description="Number of the vertex in g2o.")
    frame_id: str
    robot: str | None
    session: str | None
    captured_at: datetime | None
    name: str | None = Field(default=None, description="Name of the original file or message.")
    sequence: int | None = Field(default=None, description="Index in the session.")
    pose: Transform | None = Field(
        description="Pose in `frame` of the graph if the sessions are joined, otherwise in the "
        "frame's own parent frame. Null if the frame has no pose, unless edges connect it to a "
        "frame with a pose."
    )


class GraphEdge(ApiRecord):
    """A constraint between two vertices, as in g2o."""

    kind: Literal["association", "odometry"]
    first: int
    second: int
    matrix: list[list[float]] = Field(description="T_first_second, a 4 x 4 matrix.")
    information: list[float] = Field(
        description="Inverse covariance of the error along the axes of `second`, as 36 numbers, "
        "row by row in the order x y z rx ry rz, metres and radians."
    )


class Graph(ApiRecord):
    """A pose graph for an optimiser: poses of frames, and transforms between them."""

    frame: str | None = Field(
        description="Parent frame of joined poses; null if no frame has a pose."
    )
    vertices: list[Vertex]
    edges: list[GraphEdge]


# Differences between two sessions of a map.

#: Maximum number of frames of each session in a comparison.
MOST_COMPARED = 500
#: Classes of the points of a difference; `SurfacePoints.patches` contains them.
SAME, GONE, NEW, UNSEEN_AFTER, UNSEEN_BEFORE = 0, 1, 2, 3, 4


class NewDifference(Given):
    """The two sessions of a map to compare."""

    before: Label = Field(description="The earlier session.")
    after: Label = Field(description="The later session.")
    parent_frame: Label | None = Field(
        default=None,
        description="Parent frame of the compared poses; default: the parent frame with the most "
        "frames of both sessions.",
    )

    @model_validator(mode="after")
    def _require_two(self) -> NewDifference:
        if self.before == self.after:
            raise ValueError("after: must differ from before. Specify two sessions")
        return self


class DifferenceResult(ApiRecord):
    """Number of cells of two sessions in each class."""

    same: int = Field(description="Number of cells of `after` that are also in `before`.")
    gone: int = Field(description="Number of cells of `before` that frames of `after` saw through.")
    new: int = Field(description="Number of cells of `after` that frames of `before` saw through.")
    unseen_after: int = Field(
        description="Number of cells of `before` that `after` does not show, because they are "
        "hidden or out of view."
    )
    unseen_before: int = Field(
        description="Number of cells of `after` that `before` does not show."
    )
    cell_m: float = Field(description="Width of a cell, metres.")
    parent_frame: str = Field(description="Parent frame of all points.")
    up: list[float] = Field(
        min_length=3, max_length=3, description="Unit vector that points up, in the parent frame."
    )
    frames_before: int = Field(description="Number of frames of `before` that were compared.")
    frames_after: int = Field(description="Number of frames of `after` that were compared.")
    skipped: int = Field(
        description="Number of frames that were skipped because they are damaged or were deleted "
        "in the meantime."
    )


class Difference(Product):
    """A comparison of two sessions and its result. Its progress counts every frame twice."""

    noun, collection, request_type = "difference", "differences", NewDifference

    map: str
    request: NewDifference
    result: DifferenceResult | None = Field(description="The result of a job that has succeeded.")
