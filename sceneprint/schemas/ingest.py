"""Uploads of many frames as JSON: batches, and imports of archives."""

from __future__ import annotations

import re
from typing import Annotated

from pydantic import Field, StringConstraints

from sceneprint.errors import (
    Conflict,
    InvalidRequest,
    QuotaExceeded,
    SceneprintError,
    kebab_case,
)
from sceneprint.schemas.base import Given, Label, Problem, Told
from sceneprint.schemas.frames import MOST_PRIORITY, Added, GivenBase

#: What a frame may be called by who sends it.
FRAME_ID = r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}"
#: Frames of one batch.
MOST_OF_BATCH = 64
#: Statuses of frames that are refused; of any other reason, 422.
_STATUSES: dict[type[SceneprintError], int] = {Conflict: 409, QuotaExceeded: 403}


#: As a folder may be called.
FolderName = Annotated[
    str,
    StringConstraints(
        min_length=1, max_length=64, pattern=r"^[^/\\\x00-\x1f\x7f.][^/\\\x00-\x1f\x7f]*$"
    ),
]


class BatchItem(Told):
    """What came of one frame of a batch."""

    status: int = Field(
        description="As if it had been sent alone: 202 received, 200 the map has it already, 403 "
        "beyond the map's quota, 409 or 422 refused."
    )
    frame: Added | None = Field(description="Null where it was refused.")
    problem: Problem | None = Field(description="Why it was refused, or null.")


class Batch(Told):
    """What came of a batch; the frames that were taken are safe."""

    items: list[BatchItem] = Field(description="In the order in which the frames were sent.")


class ImportOptions(Given):
    """What is said of all frames of an archive."""

    name: FolderName = Field(
        default="import",
        description="Names what lies at the top of the archive, outside of any folder.",
    )
    robot: Label | None = Field(
        default=None, description="Who took the frames, and whose the poses' frame is."
    )
    session: Label | None = Field(
        default=None, description="In which run; default: the name of each sequence."
    )
    tags: list[Label] = Field(default=[], max_length=32)
    parent_frame: Label | None = Field(
        default=None,
        description="What all poses lead to; default: the scene's name, after ROBOT/ if given.",
    )
    with_poses: bool = Field(default=True, description="Take the poses that are in the archive.")
    every: int = Field(default=1, ge=1, description="Take every Nth frame of a sequence.")
    T_base_sensor: GivenBase | None = Field(
        default=None, description="Where the sensor sits on the robot."
    )
    priority: int = Field(
        default=0, ge=-MOST_PRIORITY, le=MOST_PRIORITY, description="Of the frames' jobs."
    )
    if_novel: float | None = Field(
        default=None, gt=0, le=1, description="As of an upload, for each frame."
    )


class ImportItem(Told):
    """What came of one frame of an archive, or of a member that is none."""

    name: str = Field(description="Of the member, as the archive has it, or of a sequence.")
    status: int = Field(description="As of an item of a batch.")
    frame_id: str | None = Field(description="Null where it was refused.")
    job_id: str | None = Field(description="The job that signs it.")
    problem: Problem | None = Field(description="Why it was refused, or null.")


def problem_of(error: SceneprintError) -> Problem:
    """Why one of many frames was refused, as if it had been sent alone."""
    name = kebab_case(type(error).__name__)
    fields = error.fields if isinstance(error, InvalidRequest) else ()
    listed = [{"field": place, "reason": reason} for place, reason in fields]
    told: dict[str, object] = {
        "type": f"/problems/{name}",
        "title": name.replace("-", " ").capitalize(),
        "status": next((n for kind, n in _STATUSES.items() if isinstance(error, kind)), 422),
        "detail": str(error),
    }
    return Problem.model_validate({**told, "errors": listed} if listed else told)


def check_frame_id(frame_id: str) -> None:
    """See that a frame may be called so.

    Raises
    ------
    InvalidRequest : it would not stay one part of a path.
    """
    if not re.fullmatch(FRAME_ID, frame_id):
        raise InvalidRequest(
            f"The frame id {frame_id!r:.80} is none. Take up to 64 letters, digits, dots, "
            "hyphens and underscores, of which the first is a letter or digit.",
            (("frame_id", "not as it should be"),),
        )
