"""What is remembered of uploads that are to take effect once, and what is told of them again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection, select

from sceneprint import errors
from sceneprint.errors import InvalidRequest, SceneprintError
from sceneprint.schemas import Added
from sceneprint.schemas.ingest import BatchItem, problem_of
from sceneprint.store.listing import jobs_of
from sceneprint.store.records import FrameRow, MapRow, frame_row
from sceneprint.store.tables import frames


@dataclass(frozen=True)
class Outcome:
    """What came of an upload.

    Parameters
    ----------
    added : the frame and its job; None where it was refused
    new : False where it was there already, and there is nothing to be done
    error : why it was refused
    """

    added: Added | None
    new: bool = False
    error: SceneprintError | None = None

    @property
    def taken(self) -> Added:
        """The frame and its job; raises `error` where there is none."""
        if self.added is None:
            raise self.error or ValueError("neither taken nor refused")
        return self.added


def item_of(outcome: Outcome) -> BatchItem:
    """What came of one upload of many."""
    if outcome.error is not None:
        problem = problem_of(outcome.error)
        return BatchItem(status=problem.status, frame=None, problem=problem)
    return BatchItem(status=202 if outcome.new else 200, frame=outcome.taken, problem=None)


def told(connection: Connection, frame: FrameRow) -> Added:
    """A frame as uploads are answered."""
    job = jobs_of(connection, [frame.number])[frame.number]
    return Added(frame_id=frame.id, job_id=job.id, state=frame.state, reason=frame.reason)


def kept_of(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """What came of uploads, as JSON that is remembered."""
    return {"frames": [_kept(one) for one in outcomes]}


def replayed(connection: Connection, row: MapRow, data: dict[str, Any]) -> list[Outcome] | None:
    """What came of uploads, as it is now; None where the map was deleted and made anew since."""
    found = []
    for one in data["frames"]:
        if "error" in one:
            found.append(Outcome(None, error=_error(one)))
            continue
        asked = select(frames).where(
            frames.c.id == one["frame_id"], frames.c.map_number == row.number
        )
        frame = connection.execute(asked).mappings().first()
        if frame is None:
            return None
        found.append(Outcome(told(connection, frame_row(frame)), one["new"]))
    return found


def _kept(outcome: Outcome) -> dict[str, Any]:
    if outcome.added is not None:
        return {"frame_id": outcome.added.frame_id, "new": outcome.new}
    error = outcome.error
    fields = error.fields if isinstance(error, InvalidRequest) else ()
    return {"error": type(error).__name__, "detail": str(error), "fields": fields}


def _error(kept: dict[str, Any]) -> SceneprintError:
    kind: type[SceneprintError] = getattr(errors, kept["error"])
    if issubclass(kind, InvalidRequest):
        return kind(kept["detail"], tuple((place, reason) for place, reason in kept["fields"]))
    return kind(kept["detail"])
