"""Two sessions of a map compared, as JSON: what is gone and what is new."""

from __future__ import annotations

from datetime import datetime

from pydantic import Field, model_validator

from sceneprint_client.api.admin import Progress
from sceneprint_client.api.base import ApiRecord, Given, JobState, Label

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


class Difference(ApiRecord):
    """A comparison of two sessions and its result."""

    difference_id: str = Field(description="Also the id of its job: GET /v1/jobs/{job_id}.")
    map: str
    asked: NewDifference
    state: JobState
    progress: Progress | None = Field(description="In frames; each is used twice.")
    result: DifferenceResult | None = Field(description="When it has succeeded.")
    error: str | None
    created_at: datetime
    finished_at: datetime | None
