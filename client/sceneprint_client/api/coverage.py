"""Records of the localisation coverage of a map."""

from __future__ import annotations

from typing import Literal, get_args

from pydantic import Field, model_validator

from sceneprint_client.api.admin import Product
from sceneprint_client.api.base import ApiRecord, Given, Label, Vector
from sceneprint_client.api.query import Cause

#: Maximum number of frames that one coverage job queries.
MOST_QUERIED = 5000
#: Outcome of querying a frame.
CoverageOutcome = Literal["found", "wrong", "ambiguous", "not_found", "unchecked"]
COVERAGE_OUTCOMES: tuple[CoverageOutcome, ...] = get_args(CoverageOutcome)
#: Source of the up axis of a plan.
UpSource = Literal["map", "frames", "cameras"]
#: Change of a cell since an earlier result.
CellTrend = Literal["better", "worse", "same", "new", "gone"]
CELL_TRENDS: tuple[CellTrend, ...] = ("better", "worse", "same", "new", "gone")


class NewMapCoverage(Given):
    """Frames of a map to query against the other frames, and tolerances for a correct pose."""

    session: Label | None = Field(
        default=None, description="Query only frames of this session; default: all sessions."
    )
    robot: Label | None = Field(default=None, description="Query only frames of this robot.")
    every: int = Field(
        default=1,
        ge=1,
        le=1_000_000,
        description="Query every n-th frame, ordered by session, robot and time.",
    )
    most: int = Field(
        default=1000,
        ge=1,
        le=MOST_QUERIED,
        description="Maximum number of queried frames, which are evenly spaced.",
    )
    not_within_s: float = Field(
        default=10.0,
        ge=0.0,
        le=1e9,
        description="Exclude frames of the same session that were taken within this number of "
        "seconds of the queried frame. If this number is 0, or if the queried frame has no session "
        "or time, only the frame itself is excluded.",
    )
    other_sessions: bool = Field(
        default=False,
        description="Exclude all frames with the session and robot of the queried frame, as if the "
        "robot came back on another day.",
    )
    tolerance_m: float = Field(
        default=0.5,
        gt=0.0,
        le=100.0,
        description="Maximum distance of a correct pose from the frame's own pose, metres.",
    )
    tolerance_deg: float = Field(
        default=15.0,
        gt=0.0,
        le=180.0,
        description="Maximum angle between a correct pose and the frame's own pose, degrees.",
    )
    cell_m: float | None = Field(
        default=None,
        ge=0.1,
        le=1000.0,
        description="Width of the plan's cells, metres; default: the width from the series 0.25, "
        "0.5, 1, 2, 5 m and so on that gives approximately 20 cells along the longer side. Only "
        "results with the same cell width can be compared.",
    )
    seed: int = Field(
        default=0, ge=0, lt=2**32, description="Seed for the random choices of the queries."
    )

    @model_validator(mode="after")
    def _reject_conflict(self) -> NewMapCoverage:
        if self.other_sessions and "not_within_s" in self.model_fields_set:
            raise ValueError("not_within_s: other_sessions already excludes the whole session")
        return self


class OutcomeCounts(ApiRecord):
    """Number of queried frames with each outcome."""

    found: int = Field(description="Number of frames that were found at the correct pose.")
    wrong: int = Field(description="Number of frames that were found at a wrong pose.")
    ambiguous: int
    not_found: int
    unchecked: int = Field(
        default=0,
        description="Number of frames that were found but cannot be checked, because the frame and "
        "its answer do not both have a pose in the same parent frame. Exclude these frames from "
        "percentages.",
    )


class CoverageResult(OutcomeCounts):
    """Summary of the result of a coverage job."""

    frames: int = Field(description="Number of queried frames.")
    skipped: int = Field(
        description="Number of frames that could not be queried because they were deleted, damaged "
        "or edited in the meantime."
    )
    model: str = Field(description="Model of the signatures.")
    revision: int = Field(
        description="Revision of the map when the job started. It increases with each frame "
        "that is indexed or deleted."
    )
    last_revision: int = Field(
        description="Revision of the map when the job ended. If it differs from `revision`, frames "
        "were indexed or deleted in the meantime."
    )
    map_frames: int = Field(description="Number of indexed frames of the map when the job ended.")
    cell_m: float = Field(description="Width of the cells, metres.")


class CoverageCell(OutcomeCounts):
    """A square cell of a plan."""

    column: int = Field(
        description="Index along `x_axis`. The cell extends from `column` * `cell_m` to (`column` "
        "+ 1) * `cell_m`."
    )
    row: int = Field(description="Index along `y_axis`; see `column`.")
    frames: int = Field(
        description="Number of the map's indexed frames whose sensor was in the cell."
    )


class CoveragePlan(ApiRecord):
    """The cells of one parent frame, seen from above."""

    parent_frame: str
    x_axis: list[float] = Field(
        min_length=3,
        max_length=3,
        description="Unit vector in the parent frame that points right in the plan.",
    )
    y_axis: list[float] = Field(
        min_length=3,
        max_length=3,
        description="Unit vector in the parent frame that points to the top of the plan.",
    )
    up_from: UpSource = Field(
        description="Source of the up direction. `map`: the map's `up`. `frames`: the `up` of its "
        "frames. `cameras`: an estimate, namely the axis nearest to the vertical of the camera "
        "images."
    )
    cells: list[CoverageCell] = Field(
        description="The cells in which frames were taken, by row, then by column."
    )


class MapCoverage(Product):
    """A coverage job of a map and its result. Its progress counts queried frames."""

    noun, collection, request_type = "coverage", "coverage", NewMapCoverage

    map: str
    request: NewMapCoverage
    result: CoverageResult | None = Field(description="The result of a job that has succeeded.")
    plans: list[CoveragePlan] | None = Field(
        default=None,
        description="One plan for each parent frame, sorted by number of queried frames; null in "
        "lists and until the job has succeeded.",
    )


class CoverageFrame(ApiRecord):
    """A queried frame and its outcome."""

    number: int = Field(description="Index in the order of the queries, starting at 0.")
    frame_id: str
    robot: str | None
    session: str | None
    outcome: CoverageOutcome
    reason: str = Field(description="Explanation of the answer in one sentence.")
    cause: Cause | None = Field(description="Most likely cause if the outcome is `not_found`.")
    parent_frame: str | None = Field(
        description="Parent frame of the frame's own pose; null if the frame has no pose."
    )
    position: Vector | None = Field(
        description="Position of the frame's sensor in the parent frame at the time of the query."
    )
    error_m: float | None = Field(
        description="Distance of the found pose from the frame's own pose, metres; null if nothing "
        "was found or the pose cannot be checked."
    )
    error_deg: float | None = Field(description="Angle between the two poses, degrees.")
    look_alikes: list[str] = Field(
        description="Ids of frames of places that look alike. If the outcome is `ambiguous`, the "
        "match for each wrong pose; if it is `wrong`, the match at the found pose."
    )


class CellChange(ApiRecord):
    """Change of a cell between two coverage jobs."""

    column: int
    row: int
    trend: CellTrend = Field(
        description="Change of the mean score of the cell's queried frames (1 for found, -1 for "
        "wrong, 0 otherwise). `new`: only the later job queried frames in the cell. `gone`: only "
        "the earlier job did."
    )
    before: CoverageCell | None = Field(
        description="Counts of the earlier job; null if the cell has no frames."
    )
    after: CoverageCell | None = Field(
        description="Counts of the later job; null if the cell has no frames."
    )


class PlanChanges(ApiRecord):
    """The cells of one parent frame that have queried frames in either result."""

    parent_frame: str
    cells: list[CellChange] = Field(description="Cells by row, then by column.")


class CoverageChanges(ApiRecord):
    """Changes of a map's coverage between two jobs."""

    before: str = Field(description="Id of the earlier job.")
    after: str = Field(description="Id of the later job.")
    cell_m: float
    trends: dict[CellTrend, int] = Field(description="Number of cells with each trend.")
    result_before: CoverageResult
    result_after: CoverageResult
    plans: list[PlanChanges]
