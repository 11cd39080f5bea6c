"""The ends a job can come to, other than the good one, and the job while it is in hand."""

from __future__ import annotations

import logging
import traceback
from contextlib import suppress
from dataclasses import dataclass

from sqlalchemy import Connection

from sceneprint.engine.sweeping import sweep
from sceneprint.errors import FrameError, LostLease, SceneprintError, UnusableStore
from sceneprint.schemas import FrameState, JobState
from sceneprint.store import Store, queue
from sceneprint.store.events import tell
from sceneprint.store.frames import set_state
from sceneprint.store.maps import map_of
from sceneprint.store.records import FrameRow, MapRow
from sceneprint.store.reencoding import REENCODE
from sceneprint.store.signatures import StoredSignature

log = logging.getLogger(__name__)

#: Seconds until a job is tried again whose result could not be stored.
LEFT_S = 5.0


@dataclass(frozen=True, eq=False)
class Work:
    """A job in hand.

    Parameters
    ----------
    claim : on the job
    frame, map : that it is about
    """

    claim: queue.Claim
    frame: FrameRow
    map: MapRow

    @property
    def again(self) -> bool:
        """Whether the frame is indexed, stays so all the while, and is signed once more."""
        return self.claim.job.kind == REENCODE

    @property
    def model_id(self) -> str:
        """Of the model to sign with."""
        return self.claim.job.model_id or self.map.model_id


class Outdated(Exception):
    """The map has come to have another model since the job was claimed."""


def put_back(store: Store, work: Work, after_s: float = 0.0) -> None:
    """Queue again what was claimed and not begun, as when a worker is told to stop."""
    with suppress(LostLease), store.database.write() as connection:
        queue.give_back(connection, work.claim, after_s)
        if not work.again:
            set_state(connection, work.frame.number, FrameState.RECEIVED)


def leave(store: Store, work: Work, made: StoredSignature | None) -> None:
    """Give a job back, as far as the store lets us; else its lease runs out.

    Others go before it: it may be its own folder of blobs alone that cannot be written.
    """
    with suppress(UnusableStore):
        put_back(store, work, LEFT_S)
        if made is not None:
            sweep(store, [made.geometry])


def begin_anew(store: Store, work: Work) -> JobState | None:
    """What was signed with a model that the map no longer has, or will not have, is of no use."""
    if not work.again:
        put_back(store, work)
        return JobState.QUEUED
    try:
        with store.database.write() as connection:
            queue.finish(connection, work.claim, JobState.CANCELLED)
    except LostLease:
        return None
    return JobState.CANCELLED


def tell_of(connection: Connection, kind: str, work: Work) -> None:
    """Note what has become of a job."""
    tell(connection, kind, work.map.name, work.frame.id, work.claim.job.id)


def reject(store: Store, work: Work, error: FrameError) -> JobState | None:
    """A frame that holds nothing to sign: it would hold nothing the next time either."""
    reason = str(error).removeprefix(f"{work.frame.id}: ")
    try:
        with store.database.write() as connection:
            queue.finish(connection, work.claim, JobState.FAILED, reason)
            if not work.again:
                if map_of(connection, work.frame.map_number).model_id != work.model_id:
                    raise Outdated
                set_state(connection, work.frame.number, FrameState.REJECTED, reason)
                tell_of(connection, "frame.rejected", work)
    except LostLease:
        return None
    except Outdated:
        return begin_anew(store, work)
    return JobState.FAILED


def break_down(store: Store, work: Work, error: Exception) -> JobState | None:
    """Queue a job again over which something went wrong, or let it be dead."""
    reason = (
        str(error) if isinstance(error, SceneprintError) else f"{type(error).__name__}: {error}"
    )
    trace = "".join(traceback.format_exception(error))
    log.error("job broke down", extra=about(work, error=reason, traceback=trace))
    try:
        with store.database.write() as connection:
            state = queue.fail(connection, work.claim, reason, trace)
            if work.again:
                return state
            dead = state == JobState.DEAD
            after = FrameState.FAILED if dead else FrameState.RECEIVED
            set_state(connection, work.frame.number, after, reason if dead else None)
            if dead:
                tell(connection, "frame.failed", work.map.name, work.frame.id, work.claim.job.id)
    except LostLease:
        return None
    return state


def about(work: Work, **more: object) -> dict[str, object]:
    """What a line of the log says of a job."""
    return {
        "job_id": work.claim.job.id,
        "frame_id": work.frame.id,
        "map": work.map.name,
        "attempt": work.claim.job.attempts,
        **more,
    }
