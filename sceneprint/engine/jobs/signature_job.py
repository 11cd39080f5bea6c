"""What a worker does: claim, sign, and store what came of it in one commit."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from sqlalchemy import Connection

from sceneprint import errors
from sceneprint.engine.ingest.frame_decoder import read_stored
from sceneprint.engine.jobs import lifecycle
from sceneprint.engine.jobs.tasks import LongJob
from sceneprint.engine.search.retrieval import Readers
from sceneprint.engine.signers import Signers
from sceneprint.engine.upkeep.garbage_collection import collect_blobs
from sceneprint.formats.artifact import write_geometry
from sceneprint.geometry.retrieval.ranking import Metric, distance_share, distances
from sceneprint.models import Model
from sceneprint.pipeline import prepare
from sceneprint.store import Database, Store, queue
from sceneprint.store.frames import set_state
from sceneprint.store.maps import find_map, frame_of, geometry_blobs, map_of
from sceneprint.store.reencoding_rows import REENCODE, enqueue_all, models_of
from sceneprint.store.signatures import (
    StoredSignature,
    changes_since,
    index_claimed_frame,
    index_frame,
    replace_signature,
)
from sceneprint.store.tables import FrameRow, MapRow
from sceneprint.types import Bytes
from sceneprint_client.api import FrameState, JobState

log = logging.getLogger(__name__)

#: Seconds that a result waits for a server that is away, and between two tries. Less than a worker
#: has that is told to stop.
AWAY_S, AGAIN_S = 12.0, 0.5


def claim(store: Store, worker: str, lease_s: float) -> lifecycle.Work | LongJob | None:
    """Take the next job, or None where there is none; gives up those that kill every worker.

    A job of no single frame comes as a LongJob. See also `queue.claim`.
    """
    with store.database.read() as connection:
        if not queue.has_due(connection):
            return None
        given_up = queue.is_given_up(connection)
    if given_up:  # jobs that kill every worker, and their frames
        with store.database.write() as connection:
            for job in queue.dead_letter(connection):
                if job.kind != REENCODE:
                    lifecycle.fail_frame(connection, job, job.error)
    with store.database.write(turn=False) as connection:
        held = queue.claim(connection, worker, lease_s)
        if held is None:
            return None
        if held.frame_number is None:
            number = held.map_number
            return LongJob(held, None if number is None else map_of(connection, number))
        frame = frame_of(connection, held.frame)
        if held.kind != REENCODE:
            set_state(connection, frame.number, FrameState.SIGNING)
        return lifecycle.Work(held, frame, map_of(connection, frame.map_number))


@dataclass(frozen=True)
class Made:
    """The signature of a frame, to be stored, and the artifact that it refers to."""

    signature: StoredSignature
    artifact: bytes


def run(
    store: Store, signers: Signers, readers: Readers, work: lifecycle.Work, lease_s: float,
    longest_s: float, broke: Callable[[], None] | None = None,
) -> JobState | None:  # fmt: skip
    """Sign a claimed frame.

    Parameters
    ----------
    work : of `claim`
    lease_s : seconds for which each renewal holds
    longest_s : seconds after which it is renewed no more: what takes so long does not end
    broke : told of an error that nobody raised on purpose, when what came of it is stored:
        whatever this process holds may be unsound from now on

    Returns
    -------
    state : of the job; queued where it broke down, or the map's model changed, and it will be
        tried again; None where the lease was lost, and with it the work
    """
    start = time.perf_counter()
    state: JobState | None
    made: Made | None = None
    gone: list[str] = []
    try:
        with lifecycle.renewed(store, work.job, lease_s, longest_s):
            made = _make(store, signers, work)
            gone = _store_patiently(store, signers, readers, work, made)
        state = JobState.SUCCEEDED
    except errors.LostLease as error:
        log.warning("lease lost", extra=lifecycle.about(work, error=str(error)))
        state = None
    except lifecycle.Outdated:
        state = lifecycle.restart_jobs(store, work)
    except errors.FrameError as error:
        state = lifecycle.reject(store, work, error)
    except errors.UnusableStore:  # a full disk is no fault of the frame's, and costs it no try
        with suppress(errors.UnusableStore):  # else its lease runs out
            # others go before it: it may be its own folder of blobs alone that cannot be written
            lifecycle.put_back(store, work, lifecycle.LEFT_S)
            if made is not None:
                collect_blobs(store, [made.signature.geometry])
        raise
    except Exception as error:
        state = lifecycle.break_down(store, work, error)
        if broke is not None and not isinstance(error, errors.SceneprintError):
            broke()
    if made is not None and state != JobState.SUCCEEDED:
        gone = [made.signature.geometry]  # nothing came to refer to it
    if gone:
        collect_blobs(store, gone)
    if state is None:
        return None
    milliseconds = round(1e3 * (time.perf_counter() - start), 1)
    about = lifecycle.about(work, state=state, milliseconds=milliseconds)
    log.info("job %s", state, extra=about)
    return state


def _make(store: Store, signers: Signers, work: lifecycle.Work) -> Made:
    """Sign a frame, and store its artifact."""
    if work.model_id not in models_of(work.map):
        raise lifecycle.Outdated
    signer = signers(work.model_id)
    frame = read_stored(store.blobs.get(work.frame.blob), work.frame, store.decoders)
    signature, geometry = prepare(frame, signer)
    artifact = write_geometry(geometry)
    blob = store.blobs.put(artifact)
    stored = StoredSignature(
        model_id=signature.model_id,
        vector=signature.vector.tobytes(),
        geometry=blob,
        n_patches=signature.n_patches,
        n_pairs=signature.n_pairs,
    )
    return Made(stored, artifact)


def _store_patiently(
    store: Store, signers: Signers, readers: Readers, work: lifecycle.Work, made: Made
) -> list[str]:
    """As `_store`, while another server takes the place of one that fell.

    Where the fall hid that it was committed, the lease is found to be over: it took effect once.
    """
    until = time.monotonic() + AWAY_S
    while True:
        try:
            return _store(store, signers, readers, work, made)
        except errors.StoreAway:
            if time.monotonic() > until:
                raise
            time.sleep(AGAIN_S)


def _store(
    store: Store, signers: Signers, readers: Readers, work: lifecycle.Work, result: Made
) -> list[str]:
    """Signature, artifact, state and end of the job in one commit.

    Returns
    -------
    blobs : that nothing refers to any more, of a frame that was not to be kept, as its map has the
        place
    """
    made = result.signature
    if work.again:
        return _replace_signature(store, work, made)
    if _index_alone(store, work, result):
        return []
    while True:
        seen, is_kept = None, work.frame.novelty is None
        if not is_kept:
            seen = look(store.database, readers, work.map, made)
        number = work.frame.map_number
        with (
            suppress(Stale),
            store.database.write(map_number=number) as connection,
        ):
            is_indexed = is_kept and index_claimed_frame(
                connection, work.job, work.frame, work.map.name, made
            )
            if not is_indexed:
                queue.finish(connection, work.job, JobState.SUCCEEDED)
            is_held = store.blobs.holds(made.geometry)
            if is_indexed and is_held:
                return []
            row = map_of(connection, number)
            if row.model_id != made.model_id:
                raise lifecycle.Outdated
            reason = None
            if seen is not None:
                reason = judge(connection, work.frame, made, seen, signers(made.model_id).model)
            if reason is not None:
                set_state(connection, work.frame.number, FrameState.REDUNDANT, reason)
                lifecycle.record_job_event(connection, "frame.redundant", work)
                return [work.frame.blob, made.geometry]
            if not is_held:  # nothing referred to it until now
                raise errors.DamagedBlob(
                    "A deletion elsewhere swept the artifact: it must be made again."
                )
            index_frame(connection, work.frame, made)
            if row.next_model_id is not None:
                enqueue_all(connection, row, [work.frame.number])
            lifecycle.record_job_event(connection, "frame.indexed", work)
            return []


def _index_alone(store: Store, work: lifecycle.Work, result: Made) -> bool:
    """Index a frame as most are, in one round trip to PostgreSQL; False, and nothing was written,
    where more has to be found out or written.
    """
    made = result.signature
    if store.database.is_sqlite or work.frame.novelty is not None:
        return False
    with store.database.write(map_number=work.frame.map_number, single=True) as connection:
        is_indexed = index_claimed_frame(connection, work.job, work.frame, work.map.name, made)
    if is_indexed:  # a deletion may have removed it before the commit: from now on none does
        store.blobs.ensure(made.geometry, result.artifact)
    return is_indexed


def _replace_signature(store: Store, work: lifecycle.Work, made: StoredSignature) -> list[str]:
    """Signature and artifact of an indexed frame, beside those of another model or in the place
    of damaged ones, and the end of the job in one commit.

    Returns
    -------
    blobs : that the frame refers to no more
    """
    number = work.frame.number
    with store.database.write(map_number=work.frame.map_number) as connection:
        queue.finish(connection, work.job, JobState.SUCCEEDED)
        row = map_of(connection, work.frame.map_number)
        indexed = frame_of(connection, number).state == FrameState.INDEXED
        if not indexed or made.model_id not in models_of(row):
            raise lifecycle.Outdated
        if not store.blobs.holds(made.geometry):
            raise errors.DamagedBlob(
                "A deletion elsewhere swept the artifact: it must be made again."
            )
        before = geometry_blobs(connection, [number], made.model_id).values()
        replace_signature(connection, work.frame, made)
        lifecycle.record_job_event(connection, "frame.reencoded", work)
        return [blob for blob in before if blob != made.geometry]


# Whether a map has the place of a frame already, as `if_novel` of an upload asks.
#
# signature  --look-->  Look, as of a revision  --judge, in the commit-->  Near, or None to keep it
#
# The search holds no lock. What was indexed between it and the commit is compared in the commit,
# so that of two frames of one place that are signed at once only one is kept.


@dataclass(frozen=True)
class Look:
    """The nearest frame of a map as of a revision, and its distance; None in an empty map."""

    revision: int
    nearest: tuple[int, int] | None


class Stale(Exception):
    """The nearest frame was deleted since the look, and nobody knows the next one."""


def look(database: Database, readers: Readers, row: MapRow, made: StoredSignature) -> Look | None:
    """Search a map for the nearest frame.

    Parameters
    ----------
    row : of the map, as it was

    Returns
    -------
    look : None where the map has come to have another model: nothing can be compared

    Raises
    ------
    LostLease : the map is gone, and the job with it.
    """
    with database.read() as connection:
        try:
            now = find_map(connection, row.name)
        except errors.UnknownMap as error:
            raise errors.LostLease(str(error)) from error
        if now.number != row.number or now.model_id != made.model_id:
            return None
        view = readers.view(connection, now)
    hits = view.search(_vector(made), 1, dead=view.dead)
    if len(hits) == 0:
        return Look(view.revision, None)
    return Look(view.revision, (int(hits.keys[0]), int(hits.distances[0])))


def judge(
    connection: Connection, frame: FrameRow, made: StoredSignature, seen: Look | None, model: Model
) -> str | None:
    """Why a frame is not kept, in the transaction that would index it; None where it is.

    Raises
    ------
    Stale : look again.
    """
    novelty = frame_of(connection, frame.number).novelty  # another upload may have loosened it
    row = map_of(connection, frame.map_number)
    if novelty is None or seen is None or row.model_id != made.model_id:
        return None
    nearest = _nearest_now(connection, row, _vector(made), seen, model.metric)
    if nearest is None:
        return None
    apart = np.array(nearest[1])
    share = float(distance_share(apart, model.unrelated_distance, model.metric))
    if share > novelty:
        return None
    there = frame_of(connection, nearest[0]).id
    return (
        f"the map already has this place: frame {there} is at {share:.3f} of the distance of "
        f"unrelated frames (required: more than {novelty:g})"
    )


def _nearest_now(
    connection: Connection, row: MapRow, vector: Bytes, seen: Look, metric: Metric
) -> tuple[int, int] | None:
    nearest = seen.nearest
    for block in changes_since(connection, row, seen.revision):
        for change in block:
            if nearest is not None and change.number == nearest[0]:
                raise Stale
            if change.vector is not None:
                stored = np.frombuffer(change.vector, np.uint8)
                distance = int(distances(vector, stored[None], metric)[0])
                if nearest is None or distance < nearest[1]:
                    nearest = change.number, distance
    return nearest


def _vector(made: StoredSignature) -> Bytes:
    return np.frombuffer(made.vector, np.uint8)
