"""Why a query found what it found, and not another frame, as JSON."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from sceneprint.schemas.base import Told
from sceneprint.schemas.matches import Validation
from sceneprint.schemas.options import Stage
from sceneprint.schemas.transforms import Transform

Outcome = Literal["accepted", "ambiguous", "rejected", "skipped", "not_selected", "ranked"]
Lost = Literal[
    "state", "query", "filter", "shortlist", "ranking", "selection", "turn", "deadline",
    "validation",
]  # fmt: skip


class Explanation(Told):
    """How far a frame of the ranking came."""

    frame_id: str
    map: str
    rank: int = Field(description="Place in the ranking R, from 1.")
    distance: int
    similarity: float
    stage: Stage = Field(description="The furthest that it came to.")
    outcome: Outcome = Field(
        description="`skipped`: a candidate that was not validated; `not_selected`: not a "
        "candidate; `ranked`: nothing but the ranking was asked for."
    )
    reason: str


class ExplainedFrame(Told):
    """Why one frame is, or is not, among the matches."""

    frame_id: str
    map: str
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
        "before it; `query`: it is the query itself."
    )
    reason: str
