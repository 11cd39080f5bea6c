"""What a worker does: claim, sign, and store what came of it in one commit."""

from __future__ import annotations

import logging
import threading
import time
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass

from sceneprint.artifacts import write_geometry
from sceneprint.engine.frames import read_stored
from sceneprint.engine.signers import Signers
from sceneprint.engine.uploads import sweep
from sceneprint.errors import DamagedBlob, FrameError, LostLease, SceneprintError
from sceneprint.pipeline import prepare
from sceneprint.schemas import FrameState, JobState
from sceneprint.store import Store, queue
from sceneprint.store.events import tell
from sceneprint.store.frames import frame_of, set_state
from sceneprint.store.maps import map_of
from sceneprint.store.records import FrameRow, MapRow
from sceneprint.store.signatures import StoredSignature, index_frame

log = logging.getLogger(__name__)

#: Seconds after which a lease is renewed no more: nothing that ends takes so long.
LONGEST_S = 600.0


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


def claim(store: Store, worker: str, lease_s: float) -> Work | None:
    """Take the next job, or None where there is none; gives up those that kill every worker.

    Parameters
    ----------
    store : see Store
    worker : who asks
    lease_s : seconds until the lease must be renewed
    """
    with store.database.read() as connection:
        if not queue.has_due(connection):
            return None
    with store.database.write() as connection:
        for job in queue.bury(connection):
            frame = frame_of(connection, job.frame_number)
            set_state(connection, frame.number, FrameState.FAILED, job.error)
            name = map_of(connection, frame.map_number).name
            tell(connection, "frame.failed", name, frame.id, job.id)
        held = queue.claim(connection, worker, lease_s)
        if held is None:
            return None
        frame = frame_of(connection, held.job.frame_number)
        set_state(connection, frame.number, FrameState.SIGNING)
        return Work(held, frame, map_of(connection, frame.map_number))


def run(store: Store, signers: Signers, work: Work, lease_s: float) -> JobState | None:
    """Sign a claimed frame.

    Parameters
    ----------
    store, signers : see there
    work : of `claim`
    lease_s : seconds for which each renewal holds

    Returns
    -------
    state : of the job; queued where it broke down and will be tried again; None where the lease
        was lost, and with it the work
    """
    start = time.perf_counter()
    state: JobState | None
    made: StoredSignature | None = None
    try:
        with _renewed(store, work.claim, lease_s):
            made = _sign(store, signers, work)
        _store(store, work, made)
        state = JobState.SUCCEEDED
    except LostLease as error:
        log.warning("lease lost", extra=_about(work, error=str(error)))
        state = None
    except FrameError as error:
        state = _reject(store, work, error)
    except Exception as error:
        state = _break(store, work, error)
    if made is not None and state != JobState.SUCCEEDED:
        sweep(store, [made.geometry])  # nothing came to refer to it
    if state is None:
        return None
    milliseconds = round(1e3 * (time.perf_counter() - start), 1)
    log.info("job %s", state, extra=_about(work, state=state, milliseconds=milliseconds))
    return state


def put_back(store: Store, work: Work) -> None:
    """Queue again what was claimed and not begun, as when a worker is told to stop."""
    with suppress(LostLease), store.database.write() as connection:
        queue.give_back(connection, work.claim)
        set_state(connection, work.frame.number, FrameState.RECEIVED)


def _sign(store: Store, signers: Signers, work: Work) -> StoredSignature:
    frame = read_stored(store.blobs.get(work.frame.blob), work.frame)
    signature, geometry = prepare(frame, signers(work.map.model_id))
    return StoredSignature(
        model_id=signature.model_id,
        vector=signature.vector.tobytes(),
        geometry=store.blobs.put(write_geometry(geometry)),
        n_patches=signature.n_patches,
        n_pairs=signature.n_pairs,
    )


def _store(store: Store, work: Work, made: StoredSignature) -> None:
    """Signature, artifact, state and end of the job in one commit."""
    with store.database.write() as connection:
        queue.finish(connection, work.claim, JobState.SUCCEEDED)
        if not store.blobs.holds(made.geometry):  # nothing referred to it until now
            raise DamagedBlob("A deletion elsewhere swept the artifact: it must be made again.")
        index_frame(connection, work.frame, made)
        tell(connection, "frame.indexed", work.map.name, work.frame.id, work.claim.job.id)


def _reject(store: Store, work: Work, error: FrameError) -> JobState | None:
    """A frame that holds nothing to sign: it would hold nothing the next time either."""
    reason = str(error).removeprefix(f"{work.frame.id}: ")
    try:
        with store.database.write() as connection:
            queue.finish(connection, work.claim, JobState.FAILED, reason)
            set_state(connection, work.frame.number, FrameState.REJECTED, reason)
            tell(connection, "frame.rejected", work.map.name, work.frame.id, work.claim.job.id)
    except LostLease:
        return None
    return JobState.FAILED


def _break(store: Store, work: Work, error: Exception) -> JobState | None:
    reason = (
        str(error) if isinstance(error, SceneprintError) else f"{type(error).__name__}: {error}"
    )
    trace = "".join(traceback.format_exception(error))
    log.error("job broke down", extra=_about(work, error=reason, traceback=trace))
    try:
        with store.database.write() as connection:
            state = queue.fail(connection, work.claim, reason, trace)
            dead = state == JobState.DEAD
            after = FrameState.FAILED if dead else FrameState.RECEIVED
            set_state(connection, work.frame.number, after, reason if dead else None)
            if dead:
                tell(connection, "frame.failed", work.map.name, work.frame.id, work.claim.job.id)
    except LostLease:
        return None
    return state


@contextmanager
def _renewed(store: Store, claim: queue.Claim, lease_s: float) -> Iterator[None]:
    """Renew a lease from a thread of its own while the work goes on."""
    done = threading.Event()

    def renew() -> None:
        until = time.monotonic() + LONGEST_S
        while not done.wait(lease_s / 3) and time.monotonic() < until:
            try:
                with store.database.write() as connection:
                    queue.renew(connection, claim, lease_s)
            except LostLease:
                return  # the end of the work will learn of it
            except SceneprintError as error:  # the database may be back before the lease is over
                log.warning("lease not renewed", extra={"error": str(error)})

    thread = threading.Thread(target=renew, name="lease", daemon=True)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()


def _about(work: Work, **more: object) -> dict[str, object]:
    return {
        "job_id": work.claim.job.id,
        "frame_id": work.frame.id,
        "map": work.map.name,
        "attempt": work.claim.job.attempts,
        **more,
    }
