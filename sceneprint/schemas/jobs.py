"""Jobs as JSON."""

from __future__ import annotations

from datetime import datetime
from typing import Any

from pydantic import Field

from sceneprint.schemas.base import Told
from sceneprint.schemas.states import JobState


class Progress(Told):
    """How far a long job has come."""

    done: int = Field(description="Steps that are over: frames, members of an archive.")
    total: int | None = Field(default=None, description="Of so many, where that is known.")


class Job(Told):
    """A piece of work in the queue."""

    job_id: str
    kind: str = Field(
        description="`sign`, `import`, `associate`, `reconstruct`, `snapshot`, or `reencode`: that "
        "one signs an indexed frame once more, with the model to come or as what was made of it "
        "is damaged."
    )
    state: JobState
    map: str | None = Field(description="That it is about; null for `snapshot`.")
    frame_id: str | None = Field(description="That it signs; null where it is of no single one.")
    priority: int = Field(description="Jobs of a greater one are done first.")
    attempts: int
    created_at: datetime
    started_at: datetime | None = Field(default=None, description="Of the latest try.")
    finished_at: datetime | None
    error: str | None
    traceback: str | None
    progress: Progress | None = Field(
        default=None, description="Of a long job, which is done in parts; null until it has begun."
    )
    result: dict[str, Any] | None = Field(
        default=None, description="What a long job came to, in short, when it has succeeded."
    )
    followed_by: str | None = Field(
        default=None,
        description="The latest job of the same frame that does the same; null: it is this one. "
        "What was tried again is followed by the try.",
    )
