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
    """Which frames of a map to query against the rest of it, and what counts as right."""

    session: Label | None = Field(
        default=None, description="Query only frames of this session; default: of all."
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
        description="Query at most so many frames: of more, evenly spaced ones.",
    )
    not_within_s: float = Field(
        default=10.0,
        ge=0.0,
        le=1e9,
        description="Leave out frames of the queried frame's own session captured within so many "
        "seconds of it; 0 leaves out only the frame itself. Of a frame without a session or a time "
        "only the frame itself is left out.",
    )
    other_sessions: bool = Field(
        default=False,
        description="Leave out all frames of the queried frame's own session, of the same robot: "
        "as if the robot came back on another day.",
    )
    tolerance_m: float = Field(
        default=0.5,
        gt=0.0,
        le=100.0,
        description="A pose that was found is right within this distance of the frame's own pose.",
    )
    tolerance_deg: float = Field(
        default=15.0, gt=0.0, le=180.0, description="And within this rotation."
    )
    cell_m: float | None = Field(
        default=None,
        ge=0.1,
        le=1000.0,
        description="Width of a plan's cells; default: 0.25, 0.5, 1, 2, 5 m and so on, about 20 "
        "along the longer side. Two results are compared only if their cells are equally wide.",
    )
    seed: int = Field(default=0, ge=0, lt=2**32, description="Of the queries' random choices.")

    @model_validator(mode="after")
    def _sensible(self) -> NewMapCoverage:
        if self.other_sessions and "not_within_s" in self.model_fields_set:
            raise ValueError("not_within_s: other_sessions leaves out the whole session already")
        return self


class OutcomeCounts(ApiRecord):
    """How many queried frames had each outcome."""

    found: int = Field(description="Found, and right.")
    wrong: int = Field(description="Found, but not at the frame's own pose.")
    ambiguous: int
    not_found: int
    unchecked: int = Field(
        default=0,
        description="Found, and nothing says whether that is right, as frame and answer have no "
        "poses in one parent frame. Of a share that is found, leave these out.",
    )


class CoverageResult(OutcomeCounts):
    """What a coverage job found, in short."""

    frames: int = Field(description="Frames that were queried.")
    skipped: int = Field(
        description="Frames that could not be queried: deleted, damaged or edited meanwhile."
    )
    model: str = Field(description="Of the signatures.")
    revision: int = Field(
        description="Of the map when the job began. It rises with each frame that is indexed or "
        "deleted."
    )
    last_revision: int = Field(
        description="Of the map when the job ended; if it differs, frames came or went meanwhile."
    )
    map_frames: int = Field(description="Indexed frames of the map when the job ended.")
    cell_m: float = Field(description="Width of the plans' cells.")


class CoverageCell(OutcomeCounts):
    """A square of a plan."""

    column: int = Field(
        description="It reaches from `column` times `cell_m` to `column` + 1 times along `x_axis`."
    )
    row: int = Field(description="The same along `y_axis`.")
    frames: int = Field(description="Indexed frames of the map that were taken in it.")


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
        description="How the vertical is known. `map`: the map's `up`. `frames`: the `up` of its "
        "frames. `cameras`: guessed, the axis nearest to the cameras' upright."
    )
    cells: list[CoverageCell] = Field(
        description="Those in which any frame was taken, by row, then by column."
    )


class MapCoverage(Product):
    """A coverage job of a map and its result. Its steps are queried frames."""

    noun, collection, request_type = "coverage", "coverage", NewMapCoverage

    map: str
    request: NewMapCoverage
    result: CoverageResult | None = Field(description="When it has succeeded.")
    plans: list[CoveragePlan] | None = Field(
        default=None,
        description="One for each parent frame, that of most queried frames first; null in lists, "
        "and until it has succeeded.",
    )


class CoverageFrame(ApiRecord):
    """A queried frame, and what became of it."""

    number: int = Field(description="From 0, in the order in which frames were queried.")
    frame_id: str
    robot: str | None
    session: str | None
    outcome: CoverageOutcome
    reason: str = Field(description="Of the answer, in a sentence.")
    cause: Cause | None = Field(description="Of `not_found`: the likeliest.")
    parent_frame: str | None = Field(description="Of its own pose; null without one.")
    position: Vector | None = Field(description="Of its sensor there when it was queried.")
    error_m: float | None = Field(
        description="Distance of the pose that was found from its own; null where nothing was "
        "found, or where that cannot be checked."
    )
    error_deg: float | None
    look_alikes: list[str] = Field(
        description="Ids of frames that it is mistaken for: of `ambiguous`, the match for each "
        "pose but its own; of `wrong`, the match at the pose that was found."
    )


class CellChange(ApiRecord):
    """A cell in two results."""

    column: int
    row: int
    trend: CellTrend = Field(
        description="By the mean over its queried frames: 1 for found, -1 for wrong, 0 otherwise. "
        "`new` and `gone`: it has queried frames in one of the results only."
    )
    before: CoverageCell | None = Field(description="Null where it had no frames.")
    after: CoverageCell | None


class PlanChanges(ApiRecord):
    """The cells of one parent frame that have queried frames in either result."""

    parent_frame: str
    cells: list[CellChange] = Field(description="By row, then by column.")


class CoverageChanges(ApiRecord):
    """Where a map became better or worse between two results."""

    before: str = Field(description="Id of the earlier result, and of the later one:")
    after: str
    cell_m: float
    trends: dict[CellTrend, int] = Field(description="How many cells have each trend.")
    result_before: CoverageResult
    result_after: CoverageResult
    plans: list[PlanChanges]
