"""The main job of workers: claim a frame, sign it, and store the results in one commit."""

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
from sceneprint.store.maps import find_map, frame_of, geometry_blobs, map_of_number
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

#: Maximum seconds to retry storing a result while the database is unreachable, and seconds between
#: attempts. A worker has more time than this to stop.
AWAY_S, AGAIN_S = 12.0, 0.5


def claim(store: Store, worker: str, lease_s: float) -> lifecycle.Work | LongJob | None:
    """Claim the next job for `lease_s` seconds; return None if no job is due.

    Before that, mark jobs that killed too many workers as dead, and their frames as failed. A job
    without a frame becomes a LongJob. See also `queue.claim`.
    """
    with store.database.read() as connection:
        if not queue.has_due(connection):
            return None
        is_exhausted = queue.has_exhausted(connection)
    if is_exhausted:
        with store.database.write() as connection:
            for job in queue.dead_letter(connection):
                if job.kind != REENCODE:
                    lifecycle.fail_frame(connection, job, job.error)
    with store.database.write(turn=False) as connection:
        claimed = queue.claim(connection, worker, lease_s)
        if claimed is None:
            return None
        if claimed.frame_number is None:
            number = claimed.map_number
            return LongJob(claimed, None if number is None else map_of_number(connection, number))
        frame = frame_of(connection, claimed.frame)
        if claimed.kind != REENCODE:
            set_state(connection, frame.number, FrameState.SIGNING)
        return lifecycle.Work(claimed, frame, map_of_number(connection, frame.map_number))


@dataclass(frozen=True)
class SigningResult:
    """The signature of a frame, and the artifact that it refers to, as bytes."""

    signature: StoredSignature
    artifact: bytes


def run(
    store: Store, signers: Signers, readers: Readers, work: lifecycle.Work, lease_s: float,
    longest_s: float, broke: Callable[[], None] | None = None,
) -> JobState | None:  # fmt: skip
    """Run a claimed job: sign its frame, and store the result.

    Parameters
    ----------
    lease_s : duration of the lease after each renewal, seconds
    longest_s : seconds after which the lease is no longer renewed, in case signing hangs
    broke : function to call after an unexpected error, which may have damaged this process

    Returns
    -------
    state : new state of the job: queued if it will be retried; None if the lease was lost and the
        result discarded

    Raises
    ------
    UnusableStore : If the store cannot be used; the job was returned to the queue, if possible.
    """
    start = time.perf_counter()
    state: JobState | None
    result: SigningResult | None = None
    unused: list[str] = []
    try:
        with lifecycle.renewed(store, work.job, lease_s, longest_s):
            result = _sign(store, signers, work)
            unused = _store_patiently(store, signers, readers, work, result)
        state = JobState.SUCCEEDED
    except errors.LostLease as error:
        log.warning("lease lost", extra=lifecycle.about(work, error=str(error)))
        state = None
    except lifecycle.Outdated:
        state = lifecycle.restart_job(store, work)
    except errors.FrameError as error:
        state = lifecycle.reject(store, work, error)
    except errors.UnusableStore:  # a full disk does not count as a failure of the frame
        with suppress(errors.UnusableStore):  # otherwise, the lease expires
            # with a delay, so that a worker with a free disk can claim the job
            lifecycle.put_back(store, work, lifecycle.DELAY_S)
            if result is not None:
                collect_blobs(store, [result.signature.geometry])
        raise
    except Exception as error:
        state = lifecycle.break_down(store, work, error)
        if broke is not None and not isinstance(error, errors.SceneprintError):
            broke()
    if result is not None and state != JobState.SUCCEEDED:
        unused = [result.signature.geometry]
    if unused:
        collect_blobs(store, unused)
    if state is None:
        return None
    milliseconds = round(1e3 * (time.perf_counter() - start), 1)
    about = lifecycle.about(work, state=state, milliseconds=milliseconds)
    log.info("job %s", state, extra=about)
    return state


def _sign(store: Store, signers: Signers, work: lifecycle.Work) -> SigningResult:
    """Sign a frame, and store its artifact; raise Outdated if the model is no longer in use."""
    if work.model_id not in models_of(work.map):
        raise lifecycle.Outdated
    signer = signers(work.model_id)
    frame = read_stored(store.blobs.get(work.frame.blob), work.frame, store.decoders)
    signature, geometry = prepare(frame, signer)
    artifact = write_geometry(geometry)
    stored = StoredSignature(
        model_id=signature.model_id, vector=signature.vector.tobytes(),
        geometry=store.blobs.put(artifact), n_patches=signature.n_patches,
        n_pairs=signature.n_pairs,
    )  # fmt: skip
    return SigningResult(stored, artifact)


def _store_patiently(
    store: Store, signers: Signers, readers: Readers, work: lifecycle.Work, result: SigningResult
) -> list[str]:
    """Store a result, and return blobs, as `_store` does; retry for AWAY_S seconds if necessary.

    If an earlier attempt was committed after all, a retry raises LostLease.
    """
    until = time.monotonic() + AWAY_S
    while True:
        try:
            return _store(store, signers, readers, work, result)
        except errors.StoreAway:
            if time.monotonic() > until:
                raise
            time.sleep(AGAIN_S)


def _store(
    store: Store, signers: Signers, readers: Readers, work: lifecycle.Work, result: SigningResult
) -> list[str]:
    """Store the signature and the new states of frame and job in one commit.

    Returns
    -------
    blobs : blobs that may be unreferenced now, such as those of a redundant frame

    Raises
    ------
    LostLease, Outdated : If another worker took the job, or the map has switched its model.
    DamagedBlob : If a deletion removed the artifact.
    """
    signature = result.signature
    if work.again:
        return _replace_signature(store, work, signature)
    if _index_alone(store, work, result):
        return []
    while True:
        nearest, is_kept = None, work.frame.novelty is None
        if not is_kept:
            nearest = find_nearest(store.database, readers, work.map, signature)
        number = work.frame.map_number
        with suppress(Stale), store.database.write(map_number=number) as connection:
            is_indexed = is_kept and index_claimed_frame(
                connection, work.job, work.frame, work.map.name, signature
            )
            if not is_indexed:
                queue.finish(connection, work.job, JobState.SUCCEEDED)
            is_held = store.blobs.holds(signature.geometry)
            if is_indexed and is_held:
                return []
            row = map_of_number(connection, number)
            if row.model_id != signature.model_id:
                raise lifecycle.Outdated
            reason = None
            if nearest is not None:
                model = signers(signature.model_id).model
                reason = why_redundant(connection, work.frame, signature, nearest, model)
            if reason is not None:
                set_state(connection, work.frame.number, FrameState.REDUNDANT, reason)
                lifecycle.record_job_event(connection, "frame.redundant", work)
                return [work.frame.blob, signature.geometry]
            if not is_held:
                raise errors.DamagedBlob(_SWEPT)
            index_frame(connection, work.frame, signature)
            if row.next_model_id is not None:
                enqueue_all(connection, row, [work.frame.number])
            lifecycle.record_job_event(connection, "frame.indexed", work)
            return []


_SWEPT = "A deletion removed the artifact, so the frame is signed again."


def _index_alone(store: Store, work: lifecycle.Work, result: SigningResult) -> bool:
    """Index a new frame with a single statement, if possible; return whether it was indexed.

    It is possible on PostgreSQL, for a frame without `if_novel`.
    """
    signature = result.signature
    if store.database.is_sqlite or work.frame.novelty is not None:
        return False
    with store.database.write(map_number=work.frame.map_number, single=True) as connection:
        is_indexed = index_claimed_frame(connection, work.job, work.frame, work.map.name, signature)
    if is_indexed:  # write the artifact again if a deletion removed it before the commit
        store.blobs.ensure(signature.geometry, result.artifact)
    return is_indexed


def _replace_signature(store: Store, work: lifecycle.Work, signature: StoredSignature) -> list[str]:
    """Replace or add a signature of an indexed frame, and end the job, in one commit.

    Returns
    -------
    blobs : blobs of the replaced signature
    """
    number = work.frame.number
    with store.database.write(map_number=work.frame.map_number) as connection:
        queue.finish(connection, work.job, JobState.SUCCEEDED)
        row = map_of_number(connection, work.frame.map_number)
        indexed = frame_of(connection, number).state == FrameState.INDEXED
        if not indexed or signature.model_id not in models_of(row):
            raise lifecycle.Outdated
        if not store.blobs.holds(signature.geometry):
            raise errors.DamagedBlob(_SWEPT)
        before = geometry_blobs(connection, [number], signature.model_id).values()
        replace_signature(connection, work.frame, signature)
        lifecycle.record_job_event(connection, "frame.reencoded", work)
        return [blob for blob in before if blob != signature.geometry]


# Novelty: with `if_novel`, a frame of a place that the map already covers becomes redundant.
#
# signature  --find_nearest-->  Nearest, at a revision  --why_redundant, in the commit-->  reason
#
# The search holds no lock. The commit also compares frames that were indexed after the search, so
# only one of two simultaneous frames of the same place is stored.


@dataclass(frozen=True)
class Nearest:
    """Number and distance of the nearest frame at a revision of the map; None in an empty map."""

    revision: int
    nearest: tuple[int, int] | None


class Stale(Exception):
    """The nearest frame changed after the search, so the search must be repeated."""


def find_nearest(
    database: Database, readers: Readers, row: MapRow, signature: StoredSignature
) -> Nearest | None:
    """Search a map for the frame nearest to a signature.

    Parameters
    ----------
    row : row of the map, as last read

    Returns
    -------
    nearest : nearest frame; None if the map uses another model than the signature

    Raises
    ------
    LostLease : If the map was deleted together with the job.
    """
    with database.read() as connection:
        try:
            now = find_map(connection, row.name)
        except errors.UnknownMap as error:
            raise errors.LostLease(str(error)) from error
        if now.number != row.number or now.model_id != signature.model_id:
            return None
        view = readers.view(connection, now)
    hits = view.search(_vector(signature), 1, dead=view.dead)
    if len(hits) == 0:
        return Nearest(view.revision, None)
    return Nearest(view.revision, (int(hits.keys[0]), int(hits.distances[0])))


def why_redundant(
    connection: Connection, frame: FrameRow, signature: StoredSignature,
    search_result: Nearest | None, model: Model,
) -> str | None:  # fmt: skip
    """Return the reason why a frame is redundant; None if it is novel.

    Call this in the transaction that indexes the frame.

    Parameters
    ----------
    search_result : result of `find_nearest`

    Raises
    ------
    Stale : If the nearest frame has changed since the search.
    """
    novelty = frame_of(connection, frame.number).novelty  # it may have been relaxed since the claim
    row = map_of_number(connection, frame.map_number)
    if novelty is None or search_result is None or row.model_id != signature.model_id:
        return None
    nearest = _nearest_now(connection, row, _vector(signature), search_result, model.metric)
    if nearest is None:
        return None
    distance = np.array(nearest[1])
    share = float(distance_share(distance, model.unrelated_distance, model.metric))
    if share > novelty:
        return None
    other = frame_of(connection, nearest[0]).id
    return (
        f"the map already covers this place: the distance to frame {other} is {share:.3f} of the "
        f"distance between unrelated frames, but `if_novel` requires more than {novelty:g}"
    )


def _nearest_now(
    connection: Connection, row: MapRow, vector: Bytes, search_result: Nearest, metric: Metric
) -> tuple[int, int] | None:
    nearest = search_result.nearest
    for block in changes_since(connection, row, search_result.revision):
        for change in block:
            if nearest is not None and change.number == nearest[0]:
                raise Stale
            if change.vector is not None:
                stored = np.frombuffer(change.vector, np.uint8)
                distance = int(distances(vector, stored[None], metric)[0])
                if nearest is None or distance < nearest[1]:
                    nearest = change.number, distance
    return nearest


def _vector(signature: StoredSignature) -> Bytes:
    return np.frombuffer(signature.vector, np.uint8)
