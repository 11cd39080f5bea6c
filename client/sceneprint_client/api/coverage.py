"""Localisation coverage of a map as JSON: where a robot would be found, and where it would not."""

from __future__ import annotations

from typing import Literal, get_args

from pydantic import Field, model_validator

from sceneprint_client.api.admin import Product
from sceneprint_client.api.base import ApiRecord, Given, Label, Vector
from sceneprint_client.api.query import Cause

#: Most frames that one coverage job queries.
MOST_QUERIED = 5000
#: What became of a frame that was queried.
CoverageOutcome = Literal["found", "wrong", "ambiguous", "not_found", "unchecked"]
COVERAGE_OUTCOMES: tuple[CoverageOutcome, ...] = get_args(CoverageOutcome)
#: Whence the up axis of a plan comes.
UpSource = Literal["map", "frames", "cameras"]
#: How a cell compares with an earlier result.
CellTrend = Literal["better", "worse", "same", "new", "gone"]
CELL_TRENDS: tuple[CellTrend, ...] = ("better", "worse", "same", "new", "gone")


class NewMapCoverage(Given):
    """Frames of a map to query against the others, and tolerances for a right answer."""

    session: Label | None = Field(
        default=None, description="Query only frames of this session; default: all."
    )
    robot: Label | None = Field(default=None, description="Query only frames of this robot.")
    every: int = Field(
        default=1,
        ge=1,
        le=1_000_000,
        description="Query every n-th frame, in the order of session, robot and time.",
    )
    most: int = Field(
        default=1000,
        ge=1,
        le=MOST_QUERIED,
        description="Maximum number of queried frames, evenly spaced.",
    )
    not_within_s: float = Field(
        default=10.0,
        ge=0.0,
        le=1e9,
        description="Exclude frames of the queried frame's own session within this many seconds "
        "of it; 0 excludes only the frame itself, as for frames without a session or time.",
    )
    other_sessions: bool = Field(
        default=False,
        description="Exclude all frames of the queried frame's own session and robot, as if the "
        "robot came back on another day.",
    )
    tolerance_m: float = Field(
        default=0.5,
        gt=0.0,
        le=100.0,
        description="Maximum distance from the frame's own pose at which a found pose is right.",
    )
    tolerance_deg: float = Field(
        default=15.0, gt=0.0, le=180.0, description="Maximum rotation from the frame's own pose."
    )
    cell_m: float | None = Field(
        default=None,
        ge=0.1,
        le=1000.0,
        description="Width of the plan's cells; default: 0.25, 0.5, 1, 2, 5 m and so on, with "
        "about 20 along the longer side. Two results can be compared only if their cells have "
        "the same width.",
    )
    seed: int = Field(default=0, ge=0, lt=2**32, description="Seed of the queries' random choices.")

    @model_validator(mode="after")
    def _sensible(self) -> NewMapCoverage:
        if self.other_sessions and "not_within_s" in self.model_fields_set:
            raise ValueError("not_within_s: other_sessions leaves out the whole session already")
        return self


class OutcomeCounts(ApiRecord):
    """How many queried frames had each outcome."""

    found: int = Field(description="Number of frames that were found at the right pose.")
    wrong: int = Field(description="Number of frames that were found at a wrong pose.")
    ambiguous: int
    not_found: int
    unchecked: int = Field(
        default=0,
        description="Number of frames that were found but cannot be checked, as frame and "
        "answer have no poses in one parent frame. Exclude them from percentages.",
    )


class CoverageResult(OutcomeCounts):
    """Summary of a coverage job's result."""

    frames: int = Field(description="Number of queried frames.")
    skipped: int = Field(
        description="Number of frames that could not be queried: deleted, damaged or edited "
        "meanwhile."
    )
    model: str = Field(description="Model of the signatures.")
    revision: int = Field(
        description="Revision of the map when the job started. It increases with each frame "
        "that is indexed or deleted."
    )
    last_revision: int = Field(
        description="Revision of the map when the job ended; if it differs, frames were added "
        "or deleted meanwhile."
    )
    map_frames: int = Field(description="Number of indexed frames of the map when the job ended.")
    cell_m: float = Field(description="Width of the cells.")


class CoverageCell(OutcomeCounts):
    """A square of a plan."""

    column: int = Field(
        description="The cell extends from `column` times `cell_m` to `column` + 1 times along "
        "`x_axis`."
    )
    row: int = Field(description="The same along `y_axis`.")
    frames: int = Field(
        description="Number of the map's indexed frames that were taken in the cell."
    )


class CoveragePlan(ApiRecord):
    """The cells of one parent frame, seen from above."""

    parent_frame: str
    x_axis: list[float] = Field(
        min_length=3, max_length=3, description="Unit vector to the right, in the parent frame."
    )
    y_axis: list[float] = Field(
        min_length=3, max_length=3, description="Unit vector to the top of the plan."
    )
    up_from: UpSource = Field(
        description="Source of the vertical. `map`: the map's `up`. `frames`: the `up` of its "
        "frames. `cameras`: estimated, the axis nearest to the upright of the cameras."
    )
    cells: list[CoverageCell] = Field(
        description="The cells in which frames were taken, by row, then by column."
    )


class MapCoverage(Product):
    """A coverage job of a map and its result. Its steps are queried frames."""

    noun, collection, request_type = "coverage", "coverage", NewMapCoverage

    map: str
    request: NewMapCoverage
    result: CoverageResult | None = Field(description="The result of a job that has succeeded.")
    plans: list[CoveragePlan] | None = Field(
        default=None,
        description="One plan for each parent frame, that with most queried frames first; null "
        "in lists, and until the job has succeeded.",
    )


class CoverageFrame(ApiRecord):
    """A queried frame and its result."""

    number: int = Field(description="Number from 0 in the order of the queries.")
    frame_id: str
    robot: str | None
    session: str | None
    outcome: CoverageOutcome
    reason: str = Field(description="Reason of the answer, in a sentence.")
    cause: Cause | None = Field(description="If `not_found`: the most likely cause.")
    parent_frame: str | None = Field(
        description="Parent frame of its own pose; null without a pose."
    )
    position: Vector | None = Field(
        description="Position of its sensor in the parent frame when it was queried."
    )
    error_m: float | None = Field(
        description="Distance of the found pose from the frame's own; null if nothing was "
        "found, or it cannot be checked."
    )
    error_deg: float | None
    look_alikes: list[str] = Field(
        description="Ids of frames that it is confused with: if `ambiguous`, the match for each "
        "pose but its own; if `wrong`, the match at the found pose."
    )


class CellChange(ApiRecord):
    """The results of a cell in two coverage jobs."""

    column: int
    row: int
    trend: CellTrend = Field(
        description="Change of the mean over the cell's queried frames: 1 for found, -1 for "
        "wrong, 0 otherwise. `new` and `gone`: only one of the results has queried frames in "
        "the cell."
    )
    before: CoverageCell | None = Field(description="Null if the cell had no frames.")
    after: CoverageCell | None


class PlanChanges(ApiRecord):
    """The cells of one parent frame that have queried frames in either result."""

    parent_frame: str
    cells: list[CellChange] = Field(description="By row, then by column.")


class CoverageChanges(ApiRecord):
    """The cells in which a map improved or degraded between two results."""

    before: str = Field(description="Ids of the earlier and the later result:")
    after: str
    cell_m: float
    trends: dict[CellTrend, int] = Field(description="Number of cells with each trend.")
    result_before: CoverageResult
    result_after: CoverageResult
    plans: list[PlanChanges]
