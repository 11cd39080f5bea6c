"""The demo's map, filled and asked over HTTP."""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

from tqdm import tqdm

from sceneprint.cli.choosing import Choice, Chosen
from sceneprint.client import Client, meta_of
from sceneprint.engine.validating import CANDIDATES
from sceneprint.errors import DatasetError, FrameConflict, FrameError, ServiceError
from sceneprint.schemas import Added, Answer, JobState

MAP = "demo"
#: Uploads in flight.
PARALLEL = 4
#: What is wrong with one frame, and says nothing of the next.
_OF_FRAME = (FrameError, FrameConflict)


@dataclass(frozen=True, eq=False)
class Asked:
    """A query and its answers: of VR and of VDR, and what the latter took, seconds."""

    chosen: Chosen
    ranked: Answer
    diverse: Answer
    seconds: float


def fill(client: Client, model: str, choice: Choice) -> dict[str, Chosen]:
    """Upload the database and wait until it is signed.

    Returns
    -------
    known : the frames that are indexed, by their ids

    Raises
    ------
    DatasetError : none could be.
    ServiceError : some were not signed in time.
    """
    client.create_map(MAP, model=model)
    known: dict[str, Chosen] = {}
    jobs = []
    start = time.perf_counter()
    pool = ThreadPoolExecutor(PARALLEL)
    try:
        uploads = [(one, pool.submit(_upload, client, one)) for one in choice.database]
        for one, upload in tqdm(uploads, desc="upload", unit="frame", disable=None):
            try:
                added = upload.result()
            except _OF_FRAME as error:
                tqdm.write(f"left out: {one.reference.name}: {error}")
                continue
            known[added.frame_id] = one
            jobs.append(added.job_id)
    finally:  # where something ends it, what is not in flight is not begun
        pool.shutdown(cancel_futures=True)
    with tqdm(total=len(jobs), desc="sign", unit="frame", disable=None) as bar:

        def progress(over: int, _total: int) -> None:
            bar.update(over - bar.n)

        done = client.wait(jobs, progress=progress)
    late = sum(not job.state.over for job in done)
    if late:  # they would be found later, and be of no frame that is known
        raise ServiceError(
            f"{late} of {len(done)} frames of the map were not signed in time. "
            "Run the demo with more --workers, or with a shorter --dataset."
        )
    for job in done:
        if job.state != JobState.SUCCEEDED and job.frame_id in known:
            print(f"left out: {known.pop(job.frame_id).reference.name}: {job.error}")
    if not known:
        raise DatasetError("No frame of the map could be signed; the lines above say why.")
    seconds = time.perf_counter() - start
    print(
        f"map: {len(known)} of {len(choice.database)} frames uploaded, signed and indexed in "
        f"{seconds:.1f} s, {len(known) / seconds:.1f} a second"
    )
    return known


def ask(client: Client, choice: Choice) -> list[Asked]:
    """Look every query up, without and with diversification."""
    asked = []
    for one in tqdm(choice.queries, desc="query", unit="frame", disable=None):
        meta = meta_of(one.reference, with_pose=False)  # a lost robot knows none
        path = one.reference.path
        try:
            # all that are validated, as `sceneprint evaluate` does
            ranked = client.query(MAP, path, meta, k=CANDIDATES, stages=("retrieve", "validate"))
            start = time.perf_counter()
            diverse = client.query(MAP, path, meta, k=CANDIDATES)
        except FrameError as error:
            tqdm.write(f"left out: {one.reference.name}: {error}")
            continue
        asked.append(Asked(one, ranked, diverse, time.perf_counter() - start))
    return asked


def _upload(client: Client, one: Chosen) -> Added:
    meta = meta_of(one.reference, session=one.session, parent_frame=one.parent)
    return client.upload(MAP, one.reference.path, meta)
